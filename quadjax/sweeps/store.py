"""A sweep's trials: a queue of a fixed number of slots in an Optuna study.

Every trial of the budget waits in the study from the start; a worker takes one by changing its
state, which the store does for one worker only. A trial whose worker died is failed, and its slot
gets one more trial of the same parameters.
"""

import contextlib
import dataclasses
import os
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.sweeps import locks
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.schema import Sweep, difference
from quadjax.sweeps.search import JOURNAL_NAME, make_pruner, make_sampler, open_storage, suggest
from quadjax.sweeps.space import Params

State = optuna.trial.TrialState
DONE = (State.COMPLETE, State.PRUNED)
RETRIES = 1  # of a trial whose worker died
SILENT_BEATS = 6  # heartbeats without a change after which a worker elsewhere is dead


@dataclasses.dataclass(frozen=True)
class Claim:
    """A trial that this worker runs."""

    trial: optuna.trial.Trial
    trial_id: int
    slot: int
    attempt: int
    params: Params


@dataclasses.dataclass(frozen=True)
class Counts:
    """How many slots are where."""

    done: int  # complete or pruned
    running: int
    waiting: int
    failed: int  # for good
    best: float | None

    @property
    def open(self) -> int:
        """Slots that still have something to come."""
        return self.running + self.waiting


class Store:
    """A study and the folder beside it."""

    def __init__(self, sweep: Sweep, directory: Path) -> None:
        """Open the study, and make it and its slots where they are not there.

        Raises:
            InputError: the study is of another sweep, or the database cannot be reached.
        """
        self.sweep, self.directory = sweep, directory
        directory.mkdir(parents=True, exist_ok=True)
        self._lock = locks.FileLock(directory / ".sweep.lock")
        self._heard: dict[int, tuple[object, float]] = {}
        self._engine = None
        with self._lock:
            self.storage, self._engine = open_storage(sweep, directory)
        with self.exclusive():
            self.study_id = self._open_study()
            self._add_slots()

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Nobody else claims, fails or adds a trial meanwhile, on any machine."""
        if self._engine is None:
            with self._lock:
                yield
        else:
            with locks.database_lock(self._engine, self.sweep.file.name):
                yield

    def study(self, slot: int = 0) -> optuna.Study:
        """Optuna's study, with the sampler of a slot.

        The sampler draws from a seed of its own for every slot, so that a trial's parameters do
        not depend on which worker runs it, nor on whether one was killed while drawing them.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return optuna.load_study(
                study_name=self.sweep.file.name,
                storage=self.storage,
                sampler=make_sampler(self.sweep, slot),
                pruner=make_pruner(self.sweep),
            )

    def trials(self) -> list[optuna.trial.FrozenTrial]:
        """All trials, failed ones too."""
        return self.storage.get_all_trials(self.study_id, deepcopy=False)

    def _open_study(self) -> int:
        wanted, name = self.sweep.definition(), self.sweep.file.name
        try:
            study_id = self.storage.get_study_id_from_name(name)
        except KeyError:
            study_id = self.storage.create_new_study([optuna.study.StudyDirection.MINIMIZE], name)
            self.storage.set_study_user_attr(study_id, "definition", wanted)
        found = self.storage.get_study_user_attrs(study_id).get("definition")
        if found is None:  # killed between the two lines above
            self.storage.set_study_user_attr(study_id, "definition", wanted)
        elif found != wanted:
            raise InputError(
                f"the study {name} was begun with another sweep: {difference(found, wanted)}; "
                "choose another name=NAME, or begin anew with --overwrite"
            )
        return study_id

    def _add_slots(self) -> None:
        """Fill the queue up to the budget."""
        there = {trial.user_attrs.get("slot") for trial in self.trials()}
        for slot in range(self.sweep.trials):
            if slot not in there:
                fixed = slot == 0 and self.sweep.first
                self._queue(slot, 0, {"fixed_params": fixed} if fixed else None)

    def _queue(self, slot: int, attempt: int, system: dict | None = None) -> None:
        """Add a waiting trial."""
        trial = optuna.trial.create_trial(
            state=State.WAITING,
            user_attrs={"slot": slot, "attempt": attempt},
            system_attrs=system or {},
        )
        self.storage.create_new_trial(self.study_id, template_trial=trial)

    def has_run(self, pid: int) -> bool:
        """Whether a worker that this process started has taken a trial."""
        own = {"pid": pid, "session": os.getpid()}
        workers = [trial.user_attrs.get("worker", {}) for trial in self.trials()]
        return any(own.items() <= worker.items() for worker in workers)

    def claim(self, worker: locks.Worker) -> Claim | None:
        """Take a waiting trial and draw its parameters; None where none waits."""
        with self.exclusive():
            waiting = self.storage.get_all_trials(
                self.study_id, deepcopy=False, states=(State.WAITING,)
            )
            for found in waiting:
                trial_id = self.storage.get_trial_id_from_study_id_trial_number(
                    self.study_id, found.number
                )
                if self.storage.set_trial_state_values(trial_id, State.RUNNING):
                    self.storage.set_trial_user_attr(trial_id, "worker", worker.to_json())
                    break
            else:
                return None
            slot, attempt = found.user_attrs["slot"], found.user_attrs["attempt"]
            trial = optuna.trial.Trial(self.study(slot), trial_id)
            params = suggest(trial, self.sweep.dimensions)
        return Claim(trial, trial_id, slot, attempt, params)

    def beat(self, claim: Claim) -> None:
        """Say that the worker lives."""
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            self.storage.set_trial_user_attr(claim.trial_id, "beat", time.time())

    def note(self, claim: Claim, name: str, value: object) -> None:
        """Keep something beside the trial."""
        self.storage.set_trial_user_attr(claim.trial_id, name, value)

    def finish(self, claim: Claim, value: float, pruned: bool = False) -> bool:
        """Give a trial its value; false where it was failed meanwhile."""
        state = State.PRUNED if pruned else State.COMPLETE
        try:
            return self.storage.set_trial_state_values(claim.trial_id, state, [value])
        except optuna.exceptions.UpdateFinishedTrialError:
            return False

    def fail(self, claim: Claim, reason: str) -> None:
        """Give a trial up for a reason that another attempt would not mend."""
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            self.note(claim, "error", reason)
            self.storage.set_trial_state_values(claim.trial_id, State.FAIL)

    def hand_back(self, claim: Claim) -> None:
        """Put an interrupted trial back into the queue, as if it had not begun."""
        with self.exclusive():
            frozen = self.storage.get_trial(claim.trial_id)
            self._fail_and_queue(frozen, claim.trial_id, "interrupted", claim.attempt)

    def _fail_and_queue(
        self, trial: optuna.trial.FrozenTrial, trial_id: int, reason: str, attempt: int
    ) -> None:
        """Fail a running trial and queue its slot again, with the same parameters.

        The next attempt is queued first: a process killed between the two leaves a slot with two
        trials, of which ``tend`` drops one, rather than none.
        """
        system = {
            key: value
            for key, value in trial.system_attrs.items()
            if key in ("grid_id", "search_space", "fixed_params")
        }
        if len(trial.params) == len(self.sweep.dimensions):
            system["fixed_params"] = dict(trial.params)
        try:
            self.storage.set_trial_user_attr(trial_id, "error", reason)
        except optuna.exceptions.UpdateFinishedTrialError:
            return
        if attempt <= RETRIES:
            self._queue(trial.user_attrs["slot"], attempt, system)
        self.storage.set_trial_state_values(trial_id, State.FAIL)

    def tend(self, stopped: bool = False) -> Counts:
        """Fail the trials of dead workers, queue them once more, and count.

        Args:
            stopped: this process has ended its own workers: none of them died of its trial.
        """
        with self.exclusive():
            trials = self.trials()
            latest = {trial.user_attrs["slot"]: trial.number for trial in trials}
            for trial in trials:
                if trial.state != State.RUNNING:
                    continue
                trial_id = self.storage.get_trial_id_from_study_id_trial_number(
                    self.study_id, trial.number
                )
                reason = self._why_dead(trial, os.getpid() if stopped else None)
                if reason is None:
                    continue
                if latest[trial.user_attrs["slot"]] > trial.number:  # has been queued again
                    self.storage.set_trial_state_values(trial_id, State.FAIL)
                    continue
                attempt = trial.user_attrs["attempt"] + (reason == "worker died")
                self._fail_and_queue(trial, trial_id, reason, attempt)
            self._add_slots()
            return self.counts()

    def _why_dead(self, trial: optuna.trial.FrozenTrial, stopped: int | None) -> str | None:
        """Why nobody runs a running trial any more; None where somebody does.

        A worker that went with the process that had started it was stopped along with the sweep;
        one that died while the sweep lived on may have died of its trial.
        """
        own = trial.user_attrs.get("worker")
        if own is None:  # claims are exclusive: whoever took it is gone
            return "interrupted"
        worker = locks.Worker(**own)
        alive = locks.lives(worker)
        if alive is None:
            return self._silent(trial)
        if alive:
            return None
        with_session = worker.session == stopped or not locks.session_lives(worker)
        return "interrupted" if with_session else "worker died"

    def _silent(self, trial: optuna.trial.FrozenTrial) -> str | None:
        """Judge a worker of another machine by its heartbeats, without comparing clocks."""
        beat, now = trial.user_attrs.get("beat"), time.monotonic()
        known = self._heard.get(trial.number)
        if known is None or known[0] != beat:
            self._heard[trial.number] = (beat, now)
            return None
        limit = SILENT_BEATS * self.sweep.file.heartbeat_seconds
        return "worker died" if now - known[1] > limit else None

    def counts(self) -> Counts:
        """How the slots stand."""
        states: dict[int, set] = {}
        values = []
        for trial in self.trials():
            states.setdefault(trial.user_attrs["slot"], set()).add(trial.state)
            if trial.state == State.COMPLETE:
                values.append(trial.value)
        done = sum(bool(found & set(DONE)) for found in states.values())
        running = sum(State.RUNNING in found for found in states.values())
        waiting = sum(
            State.WAITING in found and State.RUNNING not in found for found in states.values()
        )
        failed = sum(found == {State.FAIL} for found in states.values())
        return Counts(done, running, waiting, failed, min(values, default=None))


def delete_study(sweep: Sweep, directory: Path) -> None:
    """Forget a sweep's trials."""
    if sweep.file.storage == "journal":
        (directory / JOURNAL_NAME).unlink(missing_ok=True)
        return
    storage, _ = open_storage(sweep, directory)
    with contextlib.suppress(KeyError):
        storage.delete_study(storage.get_study_id_from_name(sweep.file.name))
