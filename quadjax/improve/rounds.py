"""Fly, refit, fine-tune: rounds on the stand-in plant, or one on real logs.

A step whose result is in the folder is not repeated, so the same command resumes after a stop.
"""

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
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import FlightLog, read_log
from quadjax.fitting.report import PATTERNS as FIT_FILES
from quadjax.flights.files import save
from quadjax.improve.model import Model, Refit, check_speeds, constant_lines, error_lines, refit
from quadjax.improve.states import margin_of, states_of_logs
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import fly_plan
from quadjax.plant.logs import write_logs
from quadjax.plant.races import plan_race
from quadjax.policy.file import Policy
from quadjax.race.rules import HIT_A_GATE
from quadjax.training.build import initial_policy
from quadjax.training.fine_tuning import fine_tuning
from quadjax.training.result import is_finished, read_summary
from quadjax.training.run import train

KIND = "improvement"
FILES = (
    *("improve.json", "table.txt", "policy.npz", "round_*", "check_*.json"),
    *("model.json", "states.npz", "training", *FIT_FILES),  # of real logs
)
SHORT = 0.1  # s more than logs.min_seconds
EVALUATIONS = 2  # of a fine-tuning
CHECK_SEED = 10_000  # of flights that are learned from by no round
COLUMNS = (
    *("round", "finished", "time of all laps, s", "flight, s", "model", "error", "computing, s"),
)
Report = Callable[[str], None]


class StoppedError(Exception):
    """The user stopped a training, which is saved."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a command asks for.

    Attributes:
        race: in which the policy was trained.
        policy: its file.
        fit: how logs are fitted.
        plant: the drone; None to learn from ``logs``.
        logs: files of real flights.
        rounds: of flying and learning.
        flights: in each round.
        laps: of each flight.
        steps: environment steps of each fine-tuning.
        check: flights of the first and the last policy, which nothing is learned from.
        seed: of batteries, gusts and sensors.
    """

    race: Config
    policy: Path
    fit: FitConfig
    plant: PlantConfig | None
    logs: tuple[Path, ...] = ()
    rounds: int = 3
    flights: int = 2
    laps: int = 6
    steps: int = 1_000_000
    check: int = 10
    seed: int = 0

    def to_json(self) -> dict[str, Any]:
        """What a resumed command must have in common: all but ``rounds`` and ``check``."""
        sections = {"race": self.race, "fit": self.fit, "plant": self.plant}
        own = {key: part and part.model_dump(mode="json") for key, part in sections.items()}
        numbers = {name: getattr(self, name) for name in ("flights", "laps", "steps", "seed")}
        policy = hashlib.sha256(self.policy.read_bytes()).hexdigest()
        return {"policy": policy, "logs": [str(path) for path in self.logs], **numbers, **own}


@dataclasses.dataclass(frozen=True)
class Flown:
    """Results of flights, by the rules of the race.

    Attributes:
        seconds: of each flight, until its end.
        totals: s of all laps; None where a flight did not finish.
        crashes: the reason of an early end; "" for none.
    """

    seconds: list[float]
    totals: list[float | None]
    crashes: list[str]

    @property
    def cells(self) -> tuple[str, str]:
        """How many flights finished, and the mean time of all laps of those."""
        done = [total for total in self.totals if total is not None]
        return f"{len(done)} of {len(self.totals)}", f"{np.mean(done):.2f}" if done else "-"


@dataclasses.dataclass(frozen=True)
class Round:
    """The state after a round: the policy and the model that fly next, and what the round did.

    Attributes:
        policy: its file.
        model: of the drone.
        margin: m, inside the gates' edges, of the training.
        logs: of all rounds so far that are fitted.
        flown: its flights.
        found: its model; None: the logs could not be fitted.
        error: why not.
        computing: s.
        fitted: number of its logs that are fitted.
    """

    policy: Path
    model: Model
    margin: float
    logs: tuple[Path, ...] = ()
    flown: Flown | None = None
    found: Refit | None = None
    error: str = ""
    computing: float = 0.0
    fitted: int = 0


def check_setting(setting: Setting) -> None:
    """Refuse a policy or a race that cannot be improved, before anything is written.

    Raises:
        InputError: in one line.
    """
    name = setting.race.vehicle.model
    if name != "motor":
        raise InputError(f"vehicle.model is {name}, allowed: motor, whose constants logs give")
    policy = Policy.load(setting.policy)
    if policy.vehicle != name:
        raise InputError(
            f"{setting.policy}: a policy for the {policy.vehicle} vehicle; vehicle.model of the "
            f"config is {name}"
        )
    if setting.race.observation.critic_constants:
        raise InputError(
            "observation.critic_constants is true, allowed: false; such a critic is not in the "
            "policy's file, and fine-tuning needs it"
        )
    if policy.value is None:
        raise InputError(
            f"{setting.policy} has no critic, which fine-tuning needs; allowed: files of quadjax "
            "train with observation.critic_constants false"
        )
    first = start_of(setting)
    initial_policy(tuning_config(setting.race, first.model, first.policy, None, 0.0, 1))


def start(setting: Setting, folder: Path) -> None:
    """Write the setting, or compare it with that of the command that is resumed.

    Raises:
        InputError: a folder of another setting, naming the key.
    """
    path, now = folder / "improve.json", setting.to_json()
    if not path.exists():
        write_json(path, now)
        return
    before = read_json(path)
    for key, value in now.items():
        if before.get(key) != value:
            raise InputError(
                f"{path} has another {key}: give the same, replace the results (overwrite=True) or "
                "choose another folder"
            )


def start_of(setting: Setting) -> Round:
    """The state before the first round."""
    margin = setting.race.reward.gate_edge_margin
    return Round(setting.policy, Model.of(setting.race), margin)


def improve(setting: Setting, folder: Path, report: Report) -> str:
    """All rounds, or the fit of real logs; returns the text that ``table.txt`` has.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    if setting.logs:
        learned = learn(setting, folder, report)
        refused = learned.refused
        lines = [*constant_lines(Model.of(setting.race), learned.model), "", *error_lines(learned)]
        text = "\n".join(
            [*lines, "", f"rejected: {refused}" if refused else "accepted; policy.npz"]
        )
    else:
        rounds = fly_rounds(setting, folder, report)
        check = checked(setting, len(rounds), folder, report) if setting.check else {}
        text = rounds_table(rounds, check)
    write_text(folder / "table.txt", text + "\n")
    return text


def learn(setting: Setting, folder: Path, report: Report) -> Refit:
    """Fit real logs, and fine-tune the policy on the model if it is accepted.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    before, path = start_of(setting), folder / "model.json"
    logs = [read_log(file, setting.fit.logs) for file in setting.logs]
    if not path.exists():
        check_speeds(logs, before.model, setting.fit.logs.max_scale_error)
    found = _refit(setting, setting.logs, setting.logs, before.model, folder, report)
    if not found.refused:
        after = dataclasses.replace(before, model=found.model)
        Policy.load(tune(setting, after, logs, folder, report)).save(folder / "policy.npz")
    return found


def fly_rounds(setting: Setting, folder: Path, report: Report) -> list[Round]:
    """The rounds on the plant; errors as of ``improve``."""
    rounds, state = [], start_of(setting)
    for number in range(1, setting.rounds + 1):
        place = folder / f"round_{number}"
        place.mkdir(exist_ok=True)

        def say(line: str, number: int = number) -> None:
            report(f"round {number}: {line}")

        state = _round(setting, number, place, state, say)
        rounds.append(state)
        Policy.load(state.policy).save(folder / "policy.npz")
    return rounds


def _round(setting: Setting, number: int, folder: Path, before: Round, report: Report) -> Round:
    """One round: its flights, its model, its training."""
    name = f"round_{number}"
    flown, recent = _flights(setting, name, number, folder, before, report)
    files = (*before.logs, *recent)
    found, error = _model(setting, files, recent, before.model, folder, report)
    logs = [read_log(file, setting.fit.logs) for file in files]
    own = [log for log in logs if Path(log.path) in recent]
    hit = [f"{name}_{run}" for run, why in enumerate(flown.crashes) if why == HIT_A_GATE]
    race = setting.race.at("reward.gate_edge_margin", before.margin)
    margin = margin_of(race, own, hit, len(hit))
    accepted = found is not None and not found.refused
    model = found.model if found is not None and accepted else before.model
    seconds = found.seconds if found else 0.0
    after = Round(before.policy, model, margin, files, flown, found, error, seconds, len(recent))
    if accepted or margin > before.margin:
        policy = tune(setting, after, logs, folder, report)
        seconds += float(read_summary(folder / "training")["seconds"])
        after = dataclasses.replace(after, policy=policy, computing=seconds)
    return after


def _flights(
    setting: Setting, name: str, number: int, folder: Path, before: Round, report: Report
) -> tuple[Flown, list[Path]]:
    """The flights of a round, and the logs that a fit accepts: not those of early crashes."""
    path, logs = folder / "flights.json", folder / "logs"
    if not path.exists():
        report("flying")
        logs.mkdir(exist_ok=True)
        flown = fly_and_log(setting, before, name, logs, setting.seed + number, report)
        write_json(path, dataclasses.asdict(flown))
    flown = Flown(**read_json(path))
    shortest = setting.fit.logs.min_seconds + SHORT
    files = [logs / f"{name}_{run}.csv" for run in range(len(flown.seconds))]
    long = [file for file, s in zip(files, flown.seconds, strict=True) if s > shortest]
    return flown, [file for file in long if _is_accepted(file, setting.fit)]


def fly_and_log(
    setting: Setting, state: Round, name: str, folder: Path, seed: int, report: Report
) -> Flown:
    """Fly a policy's mean action on the plant and write the logs ``folder/NAME_RUN.csv``."""
    assert setting.plant is not None
    plant = setting.plant.replace(control_rate=setting.plant.sample_rate)
    race, policy = state.model.race(setting.race), Policy.load(state.policy)
    count = {"lap_count": setting.laps, "runs": setting.flights, "recorded": setting.flights}
    plan = plan_race(race, plant, policy, str(state.policy), **count)
    written = write_logs({name: plan}, folder, seed, report)
    totals = [log.total if np.isfinite(log.total) else None for log in written]
    return Flown([log.seconds for log in written], totals, [log.crash for log in written])


def _is_accepted(file: Path, fit: FitConfig) -> bool:
    """Whether the checks of a log accept it; columns of short logs may seem inconsistent."""
    try:
        read_log(file, fit.logs)
    except InputError:
        return False
    return True


def _model(
    setting: Setting,
    files: Sequence[Path],
    recent: Sequence[Path],
    present: Model,
    folder: Path,
    report: Report,
) -> tuple[Refit | None, str]:
    """The model of a round, or why the logs do not give one."""
    refused = folder / "no_model.txt"
    if not refused.exists():
        try:
            if not recent:
                raise InputError(
                    "every log of the round is rejected or shorter than logs.min_seconds"
                )
            return _refit(setting, files, recent, present, folder, report), ""
        except InputError as error:
            write_text(refused, f"{error}\n")
    return None, refused.read_text(encoding="utf-8").strip()


def _refit(
    setting: Setting,
    files: Sequence[Path],
    recent: Sequence[Path],
    present: Model,
    folder: Path,
    report: Report,
) -> Refit:
    """The refitted model of ``folder/model.json``, which is computed where it does not exist."""
    path = folder / "model.json"
    if not path.exists():
        battery = setting.race.battery
        refit(files, recent, setting.fit, present, folder, report, battery).save(path)
    return Refit.load(path)


def tune(
    setting: Setting, state: Round, logs: Sequence[FlightLog], folder: Path, report: Report
) -> Path:
    """Fine-tune a policy in ``folder/training``; returns the file of its last parameters.

    Where these do not fly, it is the file of the best ones.
    """
    path, place = folder / "states.npz", folder / "training"
    if not path.exists():
        states = states_of_logs(logs, state.model.race(setting.race))
        if states is not None:
            save([states], path)
    if not is_finished(place):
        report("fine-tuning")
        states_file = path if path.exists() else None
        config = tuning_config(
            setting.race, state.model, state.policy, states_file, state.margin, setting.steps
        )
        if not train(config, place, resume=True, progress=False).finished:
            raise StoppedError
    # The best by lap time may pass closer to the edges than the margin asks for.
    flies = read_summary(place)["last_lap_total"] is not None
    return place / ("policy_last.npz" if flies else "policy.npz")


def tuning_config(
    config: Config, model: Model, policy: Path, states: Path | None, margin: float, steps: int
) -> Config:
    """The training of one round.

    Args:
        config: of the race in which the policy was trained.
        model: of the drone.
        policy: its file.
        states: file of the states in which a part of the episodes starts; None for none.
        margin: ``reward.gate_edge_margin``, m.
        steps: environment steps.
    """
    tuned = model.race(fine_tuning(config, policy))
    if tuned.reward.gate_edge > 0:
        tuned = tuned.at("reward.gate_edge_margin", margin)
    run: dict[str, Any] = {"steps": steps, "evaluate_every": max(1, steps // EVALUATIONS)}
    run |= {"start_states": None if states is None else str(states)}
    if states is None:
        run["start_states_part"] = type(tuned.run)().start_states_part
    return tuned.replace(run=tuned.run.replace(**run))


def checked(setting: Setting, rounds: int, folder: Path, report: Report) -> dict[str, Flown]:
    """Flights of the first and the last policy on the plant, which nothing is learned from."""
    found = {}
    names = {"before": (setting.policy, "before")}
    names["after"] = (folder / "policy.npz", f"after_{rounds}")
    for name, (policy, label) in names.items():
        path = folder / f"check_{setting.check}_{label}.json"
        if not path.exists():
            report(f"checking the policy: {label}")
            write_json(path, dataclasses.asdict(fly_checks(setting, policy)))
        found[name] = Flown(**read_json(path))
    return found


def fly_checks(setting: Setting, policy: Path) -> Flown:
    """Results of ``setting.check`` flights of a policy, without logs."""
    assert setting.plant is not None
    count = {"lap_count": setting.laps, "runs": setting.check, "recorded": 1}
    plan = plan_race(setting.race, setting.plant, Policy.load(policy), str(policy), **count)
    laps = fly_plan(plan, CHECK_SEED + setting.seed).laps
    totals = [float(x) if np.isfinite(x) else None for x in laps.totals]
    return Flown([float(x) for x in np.asarray(laps.seconds)], totals, list(laps.crashes))


def rounds_table(rounds: Sequence[Round], check: dict[str, Flown]) -> str:
    """The rounds as a Markdown table; seconds are summed over the rounds."""
    rows: list[Sequence[str]] = [COLUMNS]
    notes, flight, computing, crashes = [], 0.0, 0.0, 0
    for number, done in enumerate(rounds, start=1):
        assert done.flown is not None
        flight, computing = flight + sum(done.flown.seconds), computing + done.computing
        crashes += sum(map(bool, done.flown.crashes))
        found, state, error = done.found, "none", "-"
        if found is not None:
            state = "rejected" if found.refused else "accepted"
            error = f"{100.0 * found.change:+.0f}%"
        cells = (f"{flight:.0f}", state, error, f"{computing:.0f}")
        rows.append((str(number), *done.flown.cells, *cells))
        out = len(done.flown.totals) - done.fitted
        notes += [f"round {number}: {out} logs left out, too short or rejected"] if out else []
        why = done.error or (found.refused if found else "")
        notes += [f"round {number}: the model is rejected: {why}"] if why else []
    rows += [(f"check, {name}", *flown.cells, "", "", "", "") for name, flown in check.items()]
    return "\n".join([table(rows), "", f"crashes in the rounds: {crashes}", *notes])
