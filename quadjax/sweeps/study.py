"""A sweep's Optuna study: its storage, and the states of its trials.

The study is in a journal that one command uses, or in a database that several machines share. A
trial that was interrupted, or whose worker died, fails, and Optuna's retry queues it again with its
parameters. Its folder has the number of its first attempt. Storages number trials without gaps or
repetition, so the first attempts that a budget permits are those with the lowest numbers, also
where workers begin trials at the same time.
"""

import contextlib
import itertools
import re
import socket
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import optuna
from optuna.samplers import RandomSampler, TPESampler
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial
from sqlalchemy.exc import SQLAlchemyError

from quadjax.core.errors import InputError
from quadjax.sweeps.schema import JOURNAL
from quadjax.sweeps.sweep import Sweep

FILE = "study.journal"
MAX_WORKERS = 4099  # of one study
CREATION_S, WAIT_S = 2.0, 0.25  # of a database by another process; between tries to open it
CREATED = re.compile("(?i)already exists|unique|duplicate|locked")  # by another process just now
BEYOND = "beyond"  # user attribute of a trial that no budget permits, which another worker used up
HEARTBEAT_S, GRACE_S = 15, 60  # in a database: a trial without one for GRACE_S counts as dead
State = optuna.trial.TrialState
OVER = (State.COMPLETE, State.PRUNED, State.FAIL)
Retry = optuna.storages.RetryHeartbeatStaleTrialCallback  # queues a failed trial again


def open_study(sweep: Sweep, directory: Path, slot: int | None = None) -> optuna.Study:
    """The study of a sweep.

    Args:
        sweep: the sweep.
        directory: of its results.
        slot: number of the worker that draws trials from it, which changes the sampler's seed.

    Raises:
        InputError: a storage that cannot be used, or a study of another sweep.
    """
    directory.mkdir(parents=True, exist_ok=True)
    search = sweep.file.search
    pruners = {
        "none": optuna.pruners.NopPruner(),
        "median": optuna.pruners.MedianPruner(n_startup_trials=search.pruner_startup),
        "halving": optuna.pruners.SuccessiveHalvingPruner(reduction_factor=2),
    }
    with storage_errors(sweep, directory):
        study = optuna.create_study(
            storage=_storage(sweep, directory),
            study_name=sweep.file.name,
            pruner=pruners[search.pruner],
            load_if_exists=True,
        )
        if slot is not None:  # another seed for each worker, and after each resumption
            seed = search.seed + slot + MAX_WORKERS * len(study.get_trials(deepcopy=False))
            if sweep.file.storage != JOURNAL:  # other machines may begin at the same time
                seed += zlib.crc32(socket.gethostname().encode()) % 2**30
            if search.method == "tpe":  # constant_liar keeps concurrent trials apart
                study.sampler = TPESampler(
                    seed=seed,
                    n_startup_trials=search.startup,
                    multivariate=True,
                    constant_liar=True,
                )
            else:
                study.sampler = RandomSampler(seed)
            if search.method == "grid":
                study.sampler = Grid(sweep)
        _check_definition(study, sweep)
        if "definition" not in study.user_attrs:
            study.set_user_attr("definition", sweep.definition())
            if search.base_first:
                study.enqueue_trial(sweep.base_params(), skip_if_exists=True)
    return study


def load_study(sweep: Sweep, directory: Path) -> optuna.Study:
    """The study of a sweep that was begun; nothing is written.

    Raises:
        InputError: no such study, or one of another sweep.
    """
    with storage_errors(sweep, directory):
        missing = InputError(f"{directory}: no trials of the sweep {sweep.file.name}; run it first")
        if sweep.file.storage == JOURNAL and not (directory / FILE).exists():
            raise missing
        try:
            study = optuna.load_study(
                study_name=sweep.file.name, storage=_storage(sweep, directory)
            )
        except KeyError:
            raise missing from None
        _check_definition(study, sweep)
    return study


def _check_definition(study: optuna.Study, sweep: Sweep) -> None:
    definition = sweep.definition()
    before = study.user_attrs.get("definition", definition)
    for key in [*before, *definition]:
        if before.get(key) != definition.get(key):
            change = f"{key} was {before.get(key)}, is {definition.get(key)}"
            hint = "choose another name=NAME, or start over with --overwrite"
            problem = f"the study {sweep.file.name} is of another sweep"
            raise InputError(f"{problem}: {change}; {hint}")


def _storage(sweep: Sweep, directory: Path) -> optuna.storages.BaseStorage:
    """The storage; a database that another process creates at the same time is tried again."""
    if sweep.file.storage == JOURNAL:
        return optuna.storages.JournalStorage(JournalFileBackend(str(directory / FILE)))
    retries, until = sweep.file.executor.retries, time.monotonic() + CREATION_S
    while True:
        try:
            return optuna.storages.RDBStorage(
                sweep.file.storage,
                engine_kwargs={"pool_pre_ping": True},
                heartbeat_interval=HEARTBEAT_S,
                grace_period=GRACE_S,
                heartbeat_stale_trial_callback=lambda study, trial: retry(study, trial, retries),
            )
        except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
            created = CREATED.search(f"{error} {error.__cause__}")
            if not created or time.monotonic() > until:
                raise
            time.sleep(WAIT_S)


def drop_partial_line(directory: Path) -> None:
    """Remove the last line of the journal if a power failure or a full disk left it without an end.

    No other process may use the journal.
    """
    if (path := directory / FILE).exists():
        with open(path, "rb+") as stream:
            stream.truncate(stream.read().rfind(b"\n") + 1)


@contextlib.contextmanager
def storage_errors(sweep: Sweep, directory: Path) -> Iterator[None]:
    """Turn errors of the storage in the block into one ``InputError``."""
    kinds: tuple[type[Exception], ...] = (
        *(ValueError, LookupError, TypeError, AttributeError, AssertionError),
    )
    where = f"{directory / FILE} is damaged, start over with --overwrite"
    if sweep.file.storage != JOURNAL:
        kinds = (SQLAlchemyError, optuna.exceptions.OptunaError, ImportError, ValueError)
        where = "storage cannot be used"
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        cause = getattr(error.__cause__ or error, "orig", None) or error.__cause__ or error
        reason = (str(cause).strip().splitlines() or [type(cause).__name__])[0]
        if isinstance(cause, ImportError):
            reason += "; install the driver that the storage URL names"
        raise InputError(f"{where} ({without_secrets(reason, sweep.file.storage)})") from None


def without_secrets(text: str, url: str) -> str:
    """The text without what a database's URL may hold of a password: whole, parsed or not.

    Parts of other words and numbers stay: of a password ``7/s3cret`` that ``127.0.0.1`` has.
    """
    user, at, _ = url.partition("://")[2].rpartition("@")
    password = user.partition(":")[2] if at else ""
    query = [entry.partition("=")[2] for entry in url.partition("?")[2].split("&")]
    parts = [password, *password.split("/"), *query]  # "/" in a password ends it for a parser
    secrets = {url, *parts, *map(unquote, parts)} - {""}
    for secret in sorted(secrets, key=len, reverse=True):
        text = re.sub(rf"(?<![\w.]){re.escape(secret)}(?!\w|\.\w)", "***", text)
    return text


def delete_study(sweep: Sweep, directory: Path) -> None:
    """Delete a sweep's trials from a database; those of the journal are a file."""
    if sweep.file.storage != JOURNAL:
        with storage_errors(sweep, directory), contextlib.suppress(KeyError):
            storage = _storage(sweep, directory)
            optuna.delete_study(study_name=sweep.file.name, storage=storage)


def retry_running(
    study: optuna.Study, max_retries: int | None = None, worker: str | None = None
) -> None:
    """Fail the running trials of a worker, or of all, and queue them again.

    The arguments are those of ``retry``.
    """
    for trial in study.get_trials(states=(State.RUNNING,)):
        if worker in (None, trial.user_attrs.get("worker")):
            study.tell(trial.number, state=State.FAIL)
            retry(study, trial, max_retries)


def retry(study: optuna.Study, trial: FrozenTrial, max_retries: int | None = None) -> None:
    """Queue a failed trial again.

    Args:
        study: of the trial.
        trial: which has failed.
        max_retries: of trials whose worker died, as this one did; None: it was interrupted, which
            does not count.
    """
    if max_retries is not None:
        study.set_user_attr(f"died {trial.number}", True)
    attempts = [*Retry.retry_history(trial), trial.number]
    deaths = sum(f"died {number}" in study.user_attrs for number in attempts)
    if max_retries is None or deaths <= max_retries:
        Retry()(study, trial)


def is_beyond(study: optuna.Study, number: int, budget: int) -> bool:
    """Whether a trial has just begun that others make superfluous.

    As many first attempts as the ``budget`` has began before, or another machine queued the same
    failed trial again.
    """
    history = Retry.retry_history(study.trials[number])
    if not history:
        return _first_attempts(study).index(number) >= budget
    return any(
        trial.number < number and Retry.retry_history(trial) == history
        for trial in study.get_trials(deepcopy=False)
        if BEYOND not in trial.user_attrs
    )


def _first_attempts(study: optuna.Study) -> list[int]:
    """The numbers of the trials of the budget, without their repetitions."""
    trials = study.get_trials(deepcopy=False)
    used = [trial for trial in trials if BEYOND not in trial.user_attrs]
    return [trial.number for trial in used if Retry.retried_trial_number(trial) is None]


class Grid(RandomSampler):
    """Every point of a sweep's grid once, in random order: each trial has that of its rank."""

    def __init__(self, sweep: Sweep) -> None:
        """The points of the grid, in the same order for every worker."""
        super().__init__(sweep.file.search.seed)
        points, self._names = list(itertools.product(*sweep.grid().values())), list(sweep.grid())
        order = np.random.default_rng(sweep.file.search.seed).permutation(len(points))
        self._points = [points[index] for index in order]

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: optuna.distributions.BaseDistribution,
    ) -> Any:
        """The value of a parameter at the trial's point."""
        rank = _first_attempts(study).index(number_of(trial))
        return self._points[rank][self._names.index(param_name)]


def number_of(trial: FrozenTrial) -> int:
    """The number of a trial's first attempt, which is that of its folder."""
    first = Retry.retried_trial_number(trial)
    return trial.number if first is None else first


def trials_over(study: optuna.Study) -> list[FrozenTrial]:
    """Complete and pruned trials, and those that failed and are not queued again."""
    trials = study.get_trials(deepcopy=False)
    again = {number for trial in trials for number in Retry.retry_history(trial)}
    again |= {trial.number for trial in trials if BEYOND in trial.user_attrs}
    return [t for t in trials if t.state in OVER and t.number not in again]


def trials_left(study: optuna.Study, sweep: Sweep) -> int:
    """The number of trials of the budget that no worker has begun."""
    running = study.get_trials(deepcopy=False, states=(State.RUNNING,))
    return max(0, sweep.trials - len(running) - len(trials_over(study)))


def progress(study: optuna.Study, sweep: Sweep) -> str:
    """How many trials are over, and the shortest lap time of those that finished a flight."""
    trials = trials_over(study)
    values = [t.values[0] for t in trials if t.values and t.user_attrs["finished"]]
    failed = sum(t.state == State.FAIL for t in trials)
    text = f"{len(trials) - failed}/{sweep.trials} trials, "
    text += f"best {min(values):.2f} s" if values else "no flight finished yet"
    return text + (f", {failed} failed" if failed else "")
