"""The state of a sweep, as its page shows it: from the journal of its folder, read-only."""

import contextlib
import shutil
import tempfile
from pathlib import Path
from typing import Any

from quadjax.core.errors import InputError

JOURNAL = "study.journal"


class SweepRun:
    """A sweep's folder."""

    kind = "sweep"

    def __init__(self, folder: Path) -> None:
        """Read nothing yet.

        Raises:
            InputError: no journal, or Optuna is not installed.
        """
        from quadjax.sweeps import extra  # noqa: F401

        self._folder = folder
        if not (folder / JOURNAL).exists():
            raise InputError(f"{folder}: no {JOURNAL}; sweeps in a database have no page")
        self._best: int | None = None

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._folder.resolve().name

    @property
    def finished(self) -> bool:
        """Never: the same command adds trials to a sweep."""
        return False

    @property
    def policy(self) -> Path:
        """The best trial's policy file."""
        return self._folder / "trials" / f"{self._best or 0:04d}" / "seed0" / "policy.npz"

    def state(self) -> dict[str, Any]:
        """Trials in the order in which they began, as JSON takes them."""
        trials = [trial for trial in self._trials() if trial["params"]]
        done = [t for t in trials if t["state"] == "complete" and t["value"] is not None]
        best = min(done, key=lambda trial: trial["value"], default=None)
        self._best = best["index"] if best else None
        return {"trials": trials, "best": self._best, "subtitle": f"{len(trials)} trials"}

    def _trials(self) -> list[dict[str, Any]]:
        import optuna
        from optuna.storages.journal import JournalFileBackend

        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / JOURNAL  # Optuna opens a journal for writing
            shutil.copyfile(self._folder / JOURNAL, copy)
            text = copy.read_bytes()
            copy.write_bytes(text[: text.rfind(b"\n") + 1])  # without a line that is being written
            backend = JournalFileBackend(str(copy))
            storage = optuna.storages.JournalStorage(backend)
            trials: list[dict[str, Any]] = []
            for study in storage.get_all_studies():
                for trial in storage.get_all_trials(study._study_id, deepcopy=False):
                    index = trial.user_attrs.get("index", trial.number)
                    value = trial.value if trial.state.is_finished() else _latest(trial)
                    params = {key: _plain(item) for key, item in trial.params.items()}
                    state = trial.state.name.lower()
                    row = {"index": index, "state": state, "value": value, "params": params}
                    trials.append(row)
            return trials


def _latest(trial: Any) -> float | None:
    """The value that a running trial reported last."""
    with contextlib.suppress(ValueError):
        return float(trial.intermediate_values[max(trial.intermediate_values)])
    return None


def _plain(value: object) -> float | str:
    """A parameter as a number, or as text."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return str(value)
