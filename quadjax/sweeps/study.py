"""A sweep's Optuna study: its storage, the queue of its trials, and their states.

Every trial of the budget is queued from the start, with a user attribute ``index``. A trial whose
worker died is failed and queued again with its parameters and index, unless it has an ``error``. Of
several trials of an index, which two machines may queue at the same time, the first one counts.
"""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from quadjax.core.errors import InputError
from quadjax.core.secrets import DATABASE, hide
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.sweep import Sweep

JOURNAL, DRIVER = "study.journal", "postgresql+psycopg://"
ATTEMPTS = 10  # to open a database whose tables others create
GRACE = 4  # missed heartbeats after which a trial of another machine is retried
State = optuna.trial.TrialState
OVER = (State.COMPLETE, State.PRUNED)
Retry = optuna.storages.RetryHeartbeatStaleTrialCallback  # queues a failed trial again


def is_journal(sweep: Sweep) -> bool:
    """Whether the study is in a file, which only this command uses."""
    return sweep.file.storage == "journal"


def open_study(sweep: Sweep, directory: Path, run: bool = True, slot: int = 0) -> optuna.Study:
    """The study of a sweep.

    Args:
        sweep: the sweep.
        directory: of its results.
        run: fill the queue with all trials that are not over; the folder is claimed.
        slot: number of the worker, which is added to the seed of the sampler.

    Raises:
        InputError: a storage that cannot be used, or a study of another sweep.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / JOURNAL
    if run and is_journal(sweep) and path.exists():  # a power failure leaves a line without an end
        with open(path, "rb+") as stream:
            stream.truncate(stream.read().rfind(b"\n") + 1)
    with storage_errors(sweep, directory):
        study = _create(sweep, _open_storage(sweep, directory), slot)
        if run:
            _fill(study, sweep)
    return study


def delete_study(sweep: Sweep, directory: Path) -> None:
    """Delete a sweep's trials from its storage."""
    if sweep.file.storage == "journal":
        (directory / JOURNAL).unlink(missing_ok=True)
        return
    with storage_errors(sweep, directory), contextlib.suppress(KeyError):
        optuna.delete_study(study_name=sweep.file.name, storage=_open_storage(sweep, directory))


def _open_storage(sweep: Sweep, directory: Path) -> optuna.storages.BaseStorage:
    if sweep.file.storage == "journal":
        from optuna.storages.journal import JournalFileBackend

        backend = JournalFileBackend(str(directory / JOURNAL))
        return optuna.storages.JournalStorage(backend)
    from sqlalchemy.exc import IntegrityError

    heartbeat = sweep.file.heartbeat_seconds
    for attempt in range(ATTEMPTS):
        try:
            return optuna.storages.RDBStorage(
                sweep.file.storage.replace("postgresql://", DRIVER, 1),
                engine_kwargs={"pool_pre_ping": True},
                heartbeat_interval=heartbeat,
                grace_period=GRACE * heartbeat,
                heartbeat_stale_trial_callback=Retry(sweep.file.executor.retries),
            )
        except IntegrityError:  # another machine creates the tables at the same time
            if attempt + 1 == ATTEMPTS:
                raise
            time.sleep(0.2)
    raise AssertionError


@contextlib.contextmanager
def storage_errors(sweep: Sweep, directory: Path) -> Iterator[None]:
    """Turn errors of the storage into one ``InputError``, without the password of a database."""
    kinds: tuple[type[Exception], ...] = (ValueError, LookupError, TypeError, AttributeError)
    where, url = (
        f"{directory / JOURNAL} is damaged, start over with --overwrite",
        sweep.file.storage,
    )
    if place := DATABASE.fullmatch(url):
        from sqlalchemy.exc import SQLAlchemyError

        kinds = (SQLAlchemyError, ImportError, ValueError, optuna.exceptions.OptunaError)
        where = f"storage: {place['place']} cannot be used"
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        cause = getattr(error.__cause__ or error, "orig", None) or error.__cause__ or error
        reason = (str(cause).strip().splitlines() or [type(cause).__name__])[0]
        if isinstance(cause, ImportError):
            reason += ": pip install 'quadjax[sweep-postgresql]'"
        raise InputError(f"{where} ({hide(reason, url)})") from None


def _create(sweep: Sweep, storage: optuna.storages.BaseStorage, slot: int) -> optuna.Study:
    search, name, wanted = sweep.file.search, sweep.file.name, sweep.definition()
    # Random and grid trials are all in the queue. The constant liar keeps trials that run at the
    # same time apart.
    sampler = optuna.samplers.TPESampler(
        seed=search.seed + slot,
        n_startup_trials=search.startup,
        multivariate=True,
        constant_liar=True,
    )
    pruner = {
        "none": optuna.pruners.NopPruner(),
        "median": optuna.pruners.MedianPruner(n_startup_trials=search.pruner_startup),
        "halving": optuna.pruners.SuccessiveHalvingPruner(reduction_factor=2),
    }[search.pruner]
    study = optuna.create_study(
        storage=storage, study_name=name, sampler=sampler, pruner=pruner, load_if_exists=True
    )
    found = study.user_attrs.get("definition")
    if found is None:
        study.set_user_attr("definition", wanted)
    elif found != wanted:
        key = next(k for k in [*found, *wanted] if found.get(k) != wanted.get(k))
        change = f"{key} was {found.get(key)}, is {wanted.get(key)}"
        hint = "choose another name=NAME, or start over with --overwrite"
        raise InputError(f"the study {name} is of another sweep: {change}; {hint}")
    return study


def _fill(study: optuna.Study, sweep: Sweep) -> None:
    """Queue every trial of the budget that is not in the study, and the interrupted ones."""
    if is_journal(sweep):
        for trial in study.get_trials(deepcopy=False, states=(State.RUNNING,)):
            study.tell(trial.number, state=State.FAIL)
    latest = latest_trials(study)
    if len(latest) > sweep.trials:
        had = f"the study {sweep.file.name} holds {len(latest)} trials"
        raise InputError(f"{had}, budget.trials is {sweep.trials}: a budget can only grow")
    for index, params in enumerate(sweep.queue()):
        if index not in latest:
            study.enqueue_trial(params, user_attrs={"index": index})
        elif latest[index].state == State.FAIL and "error" not in latest[index].user_attrs:
            study.enqueue_trial(latest[index].params or params, user_attrs={"index": index})


def fail_running(study: optuna.Study, sweep: Sweep, reason: str, worker: str | None = None) -> None:
    """Fail the running trials of a worker, or of all, and queue them again up to ``retries`` times.

    Args:
        study: of the sweep.
        sweep: the sweep.
        reason: why the worker died; "" if it was stopped: the next command queues its trial.
        worker: its name; None: of every worker.
    """
    for trial in study.get_trials(deepcopy=True, states=(State.RUNNING,)):
        if worker is not None and trial.user_attrs.get("worker") != worker:
            continue
        retries = sweep.file.executor.retries
        given_up = bool(reason) and len(Retry.retry_history(trial)) >= retries
        if given_up:
            optuna.Trial(study, trial._trial_id).set_user_attr("error", reason)
        study.tell(trial.number, state=State.FAIL)
        if reason and not given_up:
            Retry()(study, trial)


def is_duplicate(trial: optuna.Trial) -> bool:
    """Whether an earlier trial has the same index and has not failed."""
    index, earlier = trial.user_attrs["index"], trial.study.get_trials(deepcopy=False)
    return any(
        other.number < trial.number and other.state != State.FAIL
        for other in earlier
        if other.user_attrs.get("index") == index
    )


def latest_trials(study: optuna.Study) -> dict[int, optuna.trial.FrozenTrial]:
    """The trial of each index: the first one that has not failed, else the last one."""
    latest: dict[int, optuna.trial.FrozenTrial] = {}
    for trial in study.get_trials(deepcopy=False):
        index = trial.user_attrs.get("index")
        if index is not None and (index not in latest or latest[index].state == State.FAIL):
            latest[index] = trial
    return latest


class Counts(NamedTuple):
    """The number of trials in each state."""

    done: int  # complete or pruned
    running: int
    waiting: int
    failed: int  # not retried any more
    best: float | None  # of the complete trials with a finished flight


def count(study: optuna.Study) -> Counts:
    """The number of trials by state."""
    trials = latest_trials(study).values()
    states = [trial.state for trial in trials]
    failed = sum(t.state == State.FAIL and "error" in t.user_attrs for t in trials)
    complete = [t for t in trials if t.state == State.COMPLETE and t.user_attrs["finished"]]
    values = [t.value for t in complete if t.value is not None]
    done = sum(state in OVER for state in states)
    running, waiting = states.count(State.RUNNING), states.count(State.WAITING)
    return Counts(done, running, waiting, failed, min(values, default=None))
