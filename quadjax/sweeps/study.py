"""A sweep's Optuna study: its storage, the queue of its trials, and their states.

Every trial of the budget is queued from the start, with a user attribute ``index``. A trial whose
worker died is failed and queued again with its parameters and index, unless it has an ``error``. Of
several trials of an index, which two machines may queue at the same time, the first one counts.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import optuna
from optuna.storages.journal import JournalFileBackend

from quadjax.core.errors import InputError
from quadjax.sweeps.secrets import DATABASE, hide
from quadjax.sweeps.sweep import Sweep

JOURNAL, DRIVER = "study.journal", "postgresql+psycopg://"
HEARTBEAT = 15  # s, in a database
GRACE = 4  # missed heartbeats after which a trial of another machine is retried
ATTEMPTS = 10  # to open a database whose tables others create
State = optuna.trial.TrialState
OVER, OPEN = (State.COMPLETE, State.PRUNED), (State.RUNNING, State.WAITING)
Retry = optuna.storages.RetryHeartbeatStaleTrialCallback  # queues a failed trial again


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
    path, search = directory / JOURNAL, sweep.file.search
    if run and path.exists():  # a power failure leaves a line without an end
        with open(path, "rb+") as stream:
            stream.truncate(stream.read().rfind(b"\n") + 1)
    pruners = {
        "none": optuna.pruners.NopPruner(),
        "median": optuna.pruners.MedianPruner(n_startup_trials=search.pruner_startup),
        "halving": optuna.pruners.SuccessiveHalvingPruner(reduction_factor=2),
    }
    with storage_errors(sweep, directory):
        study = optuna.create_study(
            storage=_storage(sweep, path),
            study_name=sweep.file.name,
            # The constant liar keeps trials that run at the same time apart.
            sampler=optuna.samplers.TPESampler(
                seed=search.seed + slot,
                n_startup_trials=search.startup,
                multivariate=True,
                constant_liar=True,
            ),
            pruner=pruners[search.pruner],
            load_if_exists=True,
        )
        wanted = sweep.definition()
        before = study.user_attrs.get("definition", wanted)
        for key in [*before, *wanted]:
            if before.get(key) != wanted.get(key):
                change = f"{key} was {before.get(key)}, is {wanted.get(key)}"
                hint = "choose another name=NAME, or start over with --overwrite"
                raise InputError(
                    f"the study {study.study_name} is of another sweep: {change}; {hint}"
                )
        if "definition" not in study.user_attrs:
            study.set_user_attr("definition", wanted)
        if run:
            _fill(study, sweep)
    return study


def _storage(sweep: Sweep, journal: Path) -> optuna.storages.BaseStorage:
    if sweep.file.storage == "journal":
        return optuna.storages.JournalStorage(JournalFileBackend(str(journal)))
    from sqlalchemy.exc import IntegrityError

    for _ in range(ATTEMPTS):
        with contextlib.suppress(IntegrityError):  # another machine creates the tables now
            return optuna.storages.RDBStorage(
                sweep.file.storage.replace("postgresql://", DRIVER, 1),
                engine_kwargs={"pool_pre_ping": True},
                heartbeat_interval=HEARTBEAT,
                grace_period=GRACE * HEARTBEAT,
                heartbeat_stale_trial_callback=Retry(sweep.file.executor.retries),
            )
        time.sleep(0.2)
    raise InputError("storage: its tables cannot be created")


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


def delete_study(sweep: Sweep, directory: Path) -> None:
    """Delete a sweep's trials from a database; those of the journal are a file."""
    if sweep.file.storage != "journal":
        with storage_errors(sweep, directory), contextlib.suppress(KeyError):
            storage = _storage(sweep, directory / JOURNAL)
            optuna.delete_study(study_name=sweep.file.name, storage=storage)


def _fill(study: optuna.Study, sweep: Sweep) -> None:
    """Queue every trial of the budget that is not in the study, and the interrupted ones."""
    if sweep.file.storage == "journal":  # which only this command uses
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


def retry_running(study: optuna.Study, sweep: Sweep, reason: str, worker: str | None) -> None:
    """Fail the running trials of a worker that died, or of all (None), and queue them again.

    One that was retried ``executor.retries`` times is given up: ``reason`` is its ``error``.
    """
    retries = sweep.file.executor.retries
    for trial in study.get_trials(deepcopy=True, states=(State.RUNNING,)):
        if worker in (None, trial.user_attrs.get("worker")):
            if len(Retry.retry_history(trial)) >= retries:
                optuna.Trial(study, trial._trial_id).set_user_attr("error", reason)
            study.tell(trial.number, state=State.FAIL)
            Retry(retries)(study, trial)


def latest_trials(study: optuna.Study) -> dict[int, optuna.trial.FrozenTrial]:
    """The trial of each index: the first one that has not failed, else the last one."""
    latest: dict[int, optuna.trial.FrozenTrial] = {}
    for trial in study.get_trials(deepcopy=False):
        index = trial.user_attrs.get("index")
        if index is not None and (index not in latest or latest[index].state == State.FAIL):
            latest[index] = trial
    return latest


def count(study: optuna.Study) -> Counter[State]:
    """The number of trials in each state; failed ones are those that are not retried."""
    trials = latest_trials(study).values()
    return Counter(t.state for t in trials if t.state != State.FAIL or "error" in t.user_attrs)


def progress(study: optuna.Study) -> str:
    """Trials that are over, of all, and the shortest lap time of those that finished a flight."""
    counts, trials = count(study), latest_trials(study).values()
    flown = [t for t in trials if t.state == State.COMPLETE and t.user_attrs["finished"]]
    best = min((t.values[0] for t in flown), default=None)
    text = f"{sum(counts[state] for state in OVER)}/{counts.total()} trials, "
    text += "no flight finished yet" if best is None else f"best {best:.2f} s"
    return text + (f", {counts[State.FAIL]} failed" if counts[State.FAIL] else "")
