"""A policy that learns from flights: fly, refit the drone's model, fine-tune, repeat.

Flights are on the stand-in plant; with real logs nothing is flown. A step whose result is in the
folder is not repeated, so the same command resumes after a stop.
"""

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json, write_text
from quadjax.core.markdown import table
from quadjax.evaluation.evaluate import evaluate
from quadjax.evaluation.plants import write_logs
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.report import PATTERNS as FIT_FILES
from quadjax.flights.files import save
from quadjax.flights.flight import Flight
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import plan_logs
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.race.rules import HIT_A_GATE
from quadjax.refit import Model, changes, margin_of, refit, states_of_logs
from quadjax.training.build import initial_policy
from quadjax.training.fine_tuning import fine_tuning
from quadjax.training.result import is_finished, read_summary
from quadjax.training.run import train

KIND = "improvement"
FILES = (
    *("improve.json", "table.txt", "policy.npz", "round_*", "check_*.json"),
    *("model.json", "states.npz", "training", *FIT_FILES),  # of real logs
)
EVALUATIONS = 2  # of a fine-tuning
SHORT = 0.1  # s more than logs.min_seconds
CHECK_SEED = 10_000  # of flights that are learned from by no round
COLUMNS = (
    *("round", "finished", "time of all laps, s", "flight, s", "model", "error", "computing, s"),
)
Report = Callable[[str], None]
Flown = dict[str, list[Any]]  # of each flight: "seconds", "totals" (None: unfinished), "crashes"


class StoppedError(Exception):
    """The user stopped a training, which is saved."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a command asks for."""

    race: Config  # in which the policy was trained
    policy: Path  # its file
    fit: FitConfig  # how logs are fitted
    plant: PlantConfig | None  # the drone; None to learn from ``logs``
    logs: tuple[Path, ...] = ()  # files of real flights
    rounds: int = 3  # of flying and learning
    flights: int = 2  # in each round
    laps: int = 6  # of each flight
    steps: int = 1_000_000  # environment steps of each fine-tuning
    check: int = 10  # flights of the first and the last policy, which nothing is learned from
    seed: int = 0  # of batteries, gusts and sensors

    def to_json(self) -> dict[str, Any]:
        """What a resumed command must have in common: all but ``rounds`` and ``check``."""
        sections = {"race": self.race, "fit": self.fit, "plant": self.plant}
        parts = {key: part and part.model_dump(mode="json") for key, part in sections.items()}
        numbers = {name: getattr(self, name) for name in ("flights", "laps", "steps", "seed")}
        policy = hashlib.sha256(self.policy.read_bytes()).hexdigest()
        return {"policy": policy, "logs": [str(path) for path in self.logs], **numbers, **parts}

    def check_policy(self) -> None:
        """Refuse a policy or a race that cannot be improved, before anything is written.

        Raises:
            InputError: in one line.
        """
        if self.race.vehicle.model != "motor":
            raise InputError(
                f"vehicle.model is {self.race.vehicle.model}, allowed: motor, whose constants logs "
                "give"
            )
        if self.race.observation.critic_constants:
            raise InputError(
                "observation.critic_constants is true, allowed: false; such a critic is not in the "
                "policy's file, and fine-tuning needs it"
            )
        initial_policy(tuning_config(self.race, Round.first(self), None, 1))
        if Policy.load(self.policy).value is None:
            raise InputError(
                f"{self.policy} has no critic, which fine-tuning needs; allowed: files of quadjax "
                "train with observation.critic_constants false"
            )

    def start(self, folder: Path) -> None:
        """Write the setting, or compare it with that of the command that is resumed.

        Raises:
            InputError: a folder of another setting, naming the key.
        """
        path = folder / "improve.json"
        before = _once(path, self.to_json)
        for key, value in self.to_json().items():
            if before.get(key) != value:
                raise InputError(
                    f"{path} has another {key}: give the same, replace the results "
                    "(overwrite=True) or choose another folder"
                )


@dataclasses.dataclass(frozen=True)
class Round:
    """The state after a round: the policy and the model that fly next, and what the round did."""

    policy: Path  # its file
    model: Model  # of the drone
    margin: float  # m, inside the gates' edges, of the training
    logs: tuple[Path, ...] = ()  # of all rounds so far that are fitted
    flown: Flown = dataclasses.field(default_factory=dict)  # its flights
    refitted: Model | None = None  # its model
    computing: float = 0.0  # s
    fitted: int = 0  # number of its logs that are fitted

    @classmethod
    def first(cls, setting: Setting) -> "Round":
        """The state before the first round."""
        margin = setting.race.reward.gate_edge_margin
        return cls(setting.policy, Model.of(setting.race), margin)


def _once(path: Path, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The JSON of a step, which is computed where its file does not exist."""
    if not path.exists():
        write_json(path, compute())
    return read_json(path)


def improve(setting: Setting, folder: Path, report: Report) -> str:
    """All rounds, or the fit of real logs; returns the text that ``table.txt`` has.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    if setting.logs:
        model = learn(setting, folder, report)
        result = f"rejected: {model.rejection}" if model.rejection else "accepted; policy.npz"
        text = f"{changes(Model.of(setting.race), model)}\n\n{result}"
    else:
        rounds = fly_rounds(setting, folder, report)
        check = checked(setting, len(rounds), folder, report) if setting.check else {}
        text = rounds_table(rounds, check)
    write_text(folder / "table.txt", text + "\n")
    return text


def learn(setting: Setting, folder: Path, report: Report) -> Model:
    """Fit real logs, and fine-tune the policy on the model if it is accepted.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    before = Round.first(setting)
    logs = [read_log(file, setting.fit.logs) for file in setting.logs]
    model = _refitted(setting, before, setting.logs, folder, report)
    if not model.rejection:
        after = dataclasses.replace(before, model=model)
        Policy.load(tune(setting, after, logs, folder, report)).save(folder / "policy.npz")
    return model


def fly_rounds(setting: Setting, folder: Path, report: Report) -> list[Round]:
    """The rounds on the plant; errors as of ``improve``."""
    rounds, state = [], Round.first(setting)
    for number in range(1, setting.rounds + 1):
        place = folder / f"round_{number}"
        place.mkdir(exist_ok=True)

        def say(line: str, name: str = f"round {number}") -> None:
            report(f"{name}: {line}")

        state = _round(setting, number, place, state, say)
        rounds.append(state)
        Policy.load(state.policy).save(folder / "policy.npz")
    return rounds


def _round(setting: Setting, number: int, folder: Path, before: Round, report: Report) -> Round:
    """One round: its flights, its model, its training."""
    name, places = f"round_{number}", folder / "logs"

    def fly() -> Flown:
        report("flying")
        places.mkdir(exist_ok=True)
        return fly_and_log(setting, before, name, places, setting.seed + number, report)

    flown = _once(folder / "flights.json", fly)
    recent = {}  # logs that pass the checks; columns of short ones may seem inconsistent
    for run, seconds in enumerate(flown["seconds"]):
        if seconds > setting.fit.logs.min_seconds + SHORT:
            file = places / f"{name}_{run}.csv"
            with contextlib.suppress(InputError):
                recent[file] = read_log(file, setting.fit.logs)
    refitted = _refitted(setting, before, tuple(recent), folder, report)
    hit = [f"{name}_{run}" for run, why in enumerate(flown["crashes"]) if why == HIT_A_GATE]
    race = setting.race.at("reward.gate_edge_margin", before.margin)
    margin = margin_of(race, list(recent.values()), hit)
    after = dataclasses.replace(
        before,
        model=before.model if refitted.rejection else refitted,
        margin=margin,
        logs=(*before.logs, *recent),
        flown=flown,
        refitted=refitted,
        computing=refitted.seconds,
        fitted=len(recent),
    )
    if not refitted.rejection or margin > before.margin:
        logs = [read_log(file, setting.fit.logs) for file in before.logs] + [*recent.values()]
        policy = tune(setting, after, logs, folder, report)
        seconds = float(read_summary(folder / "training")["seconds"])
        after = dataclasses.replace(after, policy=policy, computing=refitted.seconds + seconds)
    return after


def fly_and_log(
    setting: Setting, state: Round, name: str, folder: Path, seed: int, report: Report
) -> Flown:
    """Fly a policy's mean action on the plant and write the logs ``folder/NAME_RUN.csv``."""
    assert setting.plant is not None
    race = state.model.race(setting.race)
    plan = plan_logs(race, setting.plant, state.policy, setting.flights, setting.laps)
    return _results(write_logs(plan, name, folder, seed, report)[1])


def fly_checks(setting: Setting, policy: Path) -> Flown:
    """Results of ``setting.check`` flights of a policy, without logs."""
    flights = evaluate(
        Policy.load(policy),
        setting.race,
        plant=setting.plant,
        laps=setting.laps,
        runs=setting.check,
        seed=CHECK_SEED + setting.seed,
        deterministic=True,
        name=str(policy),
    )
    return _results(flights.laps)


def _results(laps: Laps) -> Flown:
    totals = [total if np.isfinite(total) else None for total in laps.totals.tolist()]
    return {"seconds": laps.seconds.tolist(), "totals": totals, "crashes": list(laps.crashes)}


def _refitted(
    setting: Setting, before: Round, recent: Sequence[Path], folder: Path, report: Report
) -> Model:
    """The model of ``folder/model.json``.

    Where the logs of a round do not give one, it is the present one, without errors and rejected.
    """

    def compute() -> dict[str, Any]:
        present, battery = before.model, setting.race.battery
        try:
            if not recent:
                raise InputError(
                    "every log of the round is rejected or shorter than logs.min_seconds"
                )
            files = (*before.logs, *recent)
            model = refit(files, recent, setting.fit, present, folder, report, battery)
        except InputError as error:
            if setting.logs:
                raise
            nothing: dict[str, float] = {}
            model = dataclasses.replace(present, before=nothing, after=nothing, seconds=0.0)
            model = dataclasses.replace(model, rejection=str(error))
        return dataclasses.asdict(model)

    path = folder / "model.json"
    return Model.from_json(_once(path, compute), path)


def tuning_config(config: Config, state: Round, states: Path | None, steps: int) -> Config:
    """The training of one round.

    Args:
        config: of the race in which the policy was trained.
        state: whose policy is trained on its model with its margin.
        states: file of the states in which a part of the episodes starts; None for none.
        steps: environment steps.
    """
    tuned = state.model.race(fine_tuning(config, state.policy))
    if tuned.reward.gate_edge > 0:
        tuned = tuned.at("reward.gate_edge_margin", state.margin)
    run: dict[str, Any] = {"steps": steps, "evaluate_every": max(1, steps // EVALUATIONS)}
    run |= {"start_states": None if states is None else str(states)}
    if states is None:
        run["start_states_part"] = type(tuned.run)().start_states_part
    return tuned.replace(run=tuned.run.replace(**run))


def tune(
    setting: Setting, state: Round, logs: Sequence[Flight], folder: Path, report: Report
) -> Path:
    """Fine-tune a policy in ``folder/training``; returns the file of its last parameters.

    Where these do not fly, it is the file of the best ones.
    """
    path, place = folder / "states.npz", folder / "training"
    states = None if path.exists() else states_of_logs(logs, state.model.race(setting.race))
    if states is not None:
        save([states], path)
    if not is_finished(place):
        report("fine-tuning")
        config = tuning_config(setting.race, state, path if path.exists() else None, setting.steps)
        if not train(config, place, resume=True, progress=False).finished:
            raise StoppedError
    # The best by lap time may pass closer to the edges than the margin asks for.
    flies = read_summary(place)[f"last_{setting.race.run.score_name}"] is not None
    return place / ("policy_last.npz" if flies else "policy.npz")


def checked(setting: Setting, rounds: int, folder: Path, report: Report) -> dict[str, Flown]:
    """Flights of the first and the last policy on the plant, which nothing is learned from."""
    policies = {"before": setting.policy, f"after_{rounds}": folder / "policy.npz"}
    results = {}
    for name, policy in policies.items():

        def fly(name: str = name, policy: Path = policy) -> Flown:
            report(f"checking the policy: {name}")
            return fly_checks(setting, policy)

        path = folder / f"check_{setting.check}_{name}.json"
        results[name.partition("_")[0]] = _once(path, fly)
    return results


def _cells(flown: Flown) -> tuple[str, str]:
    """How many flights finished, and the mean time of all laps of those."""
    done = [total for total in flown["totals"] if total is not None]
    return f"{len(done)} of {len(flown['totals'])}", f"{np.mean(done):.2f}" if done else "-"


def rounds_table(rounds: Sequence[Round], check: dict[str, Flown]) -> str:
    """The rounds as a Markdown table; seconds are summed over the rounds."""
    rows: list[Sequence[str]] = [COLUMNS]
    notes, flight, computing, crashes = [], 0.0, 0.0, 0
    for number, done in enumerate(rounds, start=1):
        flight, computing = flight + sum(done.flown["seconds"]), computing + done.computing
        crashes += sum(map(bool, done.flown["crashes"]))
        model, state, error = done.refitted, "none", "-"
        assert model is not None
        if model.before:
            state, error = "rejected" if model.rejection else "accepted", f"{model.change:+.0%}"
        cells = (f"{flight:.0f}", state, error, f"{computing:.0f}")
        rows.append((str(number), *_cells(done.flown), *cells))
        out = len(done.flown["totals"]) - done.fitted
        notes += [f"round {number}: {out} logs left out, too short or rejected"] * bool(out)
        notes += [f"round {number}: the model is rejected: {model.rejection}"] * bool(
            model.rejection
        )
    rows += [(f"check, {name}", *_cells(flown), "", "", "", "") for name, flown in check.items()]
    return "\n".join([table(rows), "", f"crashes in the rounds: {crashes}", *notes])
