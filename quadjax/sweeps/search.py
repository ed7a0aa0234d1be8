"""What Optuna supplies: storages, samplers, pruners, and the parameters of a trial."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.locks import FileLock
from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.space import Dimension, Params

JOURNAL_NAME = "study.journal"


def open_storage(sweep: Sweep, directory: Path) -> tuple[optuna.storages.BaseStorage, object]:
    """The store of a sweep, and its database engine if it is a database.

    Raises:
        InputError: a database that cannot be reached, or a driver that is not installed.
    """
    if sweep.file.storage == "journal":
        return open_journal(directory / JOURNAL_NAME), None
    return _open_database(sweep.file.storage)


def open_journal(path: Path) -> optuna.storages.JournalStorage:
    """A journal whose lock goes with a killed worker, mended where a line was cut short."""
    lock = FileLock(f"{path}.lock")
    with lock:
        _mend(path)
    backend = optuna.storages.journal.JournalFileBackend(str(path), lock_obj=lock)
    return optuna.storages.JournalStorage(backend)


def _mend(path: Path) -> None:
    """Drop a last line that a machine going down left without its end."""
    if not path.exists():
        return
    with open(path, "rb+") as stream:
        text = stream.read()
        whole = text.rfind(b"\n") + 1
        if whole != len(text):
            stream.truncate(whole)
            os.fsync(stream.fileno())


def _open_database(url: str) -> tuple[optuna.storages.BaseStorage, object]:
    try:
        import psycopg  # noqa: F401
        import sqlalchemy
    except ImportError:
        raise InputError(
            "storage is a PostgreSQL database, but its driver is not installed: "
            "pip install -e '.[sweep-postgresql]'"
        ) from None
    full = url.replace("postgresql://", "postgresql+psycopg://", 1)
    shown = url.split("://")[-1].split("@")[-1]
    from quadjax.sweeps.locks import database_lock

    try:
        # A connection that the server dropped meanwhile is made anew.
        engine = sqlalchemy.create_engine(full, poolclass=sqlalchemy.pool.NullPool)
        with database_lock(engine, "quadjax tables"):
            storage = optuna.storages.RDBStorage(full, engine_kwargs={"pool_pre_ping": True})
    except sqlalchemy.exc.SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).strip().splitlines()
        raise InputError(f"storage: {shown}: {reason[0] if reason else 'failed'}") from error
    # As a study would wrap it: one cache for the study and for the queue.
    return optuna.storages.get_storage(storage), engine


def make_sampler(sweep: Sweep, slot: int) -> optuna.samplers.BaseSampler:
    """The sampler for the trials of one slot."""
    search = sweep.file.search
    seed = (search.seed * 1_000_003 + slot) % 2**32
    if search.method == "grid":
        return optuna.samplers.GridSampler(
            {d.key: d.grid() for d in sweep.dimensions}, seed=search.seed
        )
    if search.method == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.samplers.TPESampler(
            seed=seed,
            n_startup_trials=search.startup,
            multivariate=True,
            constant_liar=True,  # trials that still run count as bad: workers keep apart
        )


def make_pruner(sweep: Sweep) -> optuna.pruners.BasePruner:
    """What ends trials early."""
    search = sweep.file.search
    if search.pruner == "median":
        return optuna.pruners.MedianPruner(n_startup_trials=search.pruner_startup)
    if search.pruner == "halving":
        return optuna.pruners.SuccessiveHalvingPruner(reduction_factor=2)
    return optuna.pruners.NopPruner()


def distribution(d: Dimension) -> optuna.distributions.BaseDistribution:
    """A dimension as Optuna knows it."""
    if d.kind == "choices":
        return optuna.distributions.CategoricalDistribution(d.labels())
    if d.kind == "int":
        step = int(d.step or 1)
        return optuna.distributions.IntDistribution(int(d.low), int(d.high), d.log, step)
    return optuna.distributions.FloatDistribution(d.low, d.high, d.log, d.step)


def suggest(trial: optuna.trial.Trial, dimensions: Sequence[Dimension]) -> Params:
    """A trial's parameters, drawn and kept in the store."""
    params: Params = {}
    for d in dimensions:
        known = distribution(d)
        if d.kind == "choices":
            params[d.key] = trial.suggest_categorical(d.key, known.choices)
        elif d.kind == "int":
            params[d.key] = trial.suggest_int(
                d.key, known.low, known.high, step=known.step, log=d.log
            )
        else:
            params[d.key] = trial.suggest_float(
                d.key, known.low, known.high, step=known.step, log=d.log
            )
    return params
