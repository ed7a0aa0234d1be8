"""The rounds of learning from flights: fly, refit, fine-tune; each step once, also after a stop."""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json, write_text
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import FlightLog, read_log
from quadjax.fitting.report import PATTERNS as FIT_FILES
from quadjax.flights.files import save
from quadjax.plant.config import PlantConfig
from quadjax.policy.file import Policy
from quadjax.studies.improve.flights import Flown, fly_and_log
from quadjax.studies.improve.model import Model, Refit, check_speeds, refit
from quadjax.studies.improve.rounds import Round
from quadjax.studies.improve.states import margin_of, states_of_logs
from quadjax.studies.improve.training import tuning_config
from quadjax.training.build import initial_policy
from quadjax.training.result import is_finished, read_summary
from quadjax.training.run import train

KIND = "improvement"
FILES = (
    *("improve.json", "table.txt", "policy.npz", "round_*", "check_*.json", "reference"),
    *("plant_*", "plants.json", "plants.png"),  # of several plants
    *("model.json", "states.npz", "training", *FIT_FILES),  # of real logs
)
GATE = "hit a gate"
SHORT = 0.1  # s more than logs.min_seconds
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
        reference: also fine-tune the first policy on the plant's own numbers, for comparison.
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
    reference: bool = False

    def to_json(self) -> dict[str, Any]:
        """What a resumed command must have in common, without ``rounds``, checks and reference."""
        sections = {"race": self.race, "fit": self.fit, "plant": self.plant}
        own = {key: part and part.model_dump(mode="json") for key, part in sections.items()}
        names = ("flights", "laps", "steps", "seed")
        logs = [str(path) for path in self.logs]
        numbers = {name: getattr(self, name) for name in names}
        policy = hashlib.sha256(self.policy.read_bytes()).hexdigest()
        return {"policy": policy, "logs": logs, **numbers, **own}


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where the rounds are: the policy and the model that fly next, and all logs so far."""

    policy: Path
    model: Model
    margin: float
    logs: tuple[Path, ...] = ()


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
    first = Progress(setting.policy, Model.of(setting.race), 0.0)
    initial_policy(_tuning(setting, first, None))


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


def improve(setting: Setting, folder: Path, report: Report) -> list[Round]:
    """All rounds; steps whose results are in the folder are not repeated.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    margin = setting.race.reward.gate_edge_margin
    progress = Progress(setting.policy, Model.of(setting.race), margin)
    rounds: list[Round] = []
    for number in range(1, setting.rounds + 1):
        own = folder / f"round_{number}"
        progress, done = _round(setting, number, own, progress, report)
        rounds.append(done)
        Policy.load(progress.policy).save(folder / "policy.npz")
    return rounds


def learn(setting: Setting, folder: Path, report: Report) -> Refit:
    """Fit real logs, and fine-tune the policy on the model if it is accepted.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    present = Model.of(setting.race)
    path = folder / "model.json"
    logs = [read_log(file, setting.fit.logs) for file in setting.logs]
    if path.exists():
        found = Refit.load(path)
    else:
        check_speeds(logs, present, setting.fit.logs.max_scale_error)
        battery = setting.race.battery
        found = refit(setting.logs, setting.logs, setting.fit, present, folder, report, battery)
        found.save(path)
    if not found.refused:
        margin = setting.race.reward.gate_edge_margin
        own = Progress(setting.policy, found.model, margin, setting.logs)
        policy = tune(setting, own, logs, folder, report)
        Policy.load(policy).save(folder / "policy.npz")
    return found


def _round(
    setting: Setting, number: int, folder: Path, before: Progress, report: Report
) -> tuple[Progress, Round]:
    """One round: its flights, its model, its training."""

    def say(line: str) -> None:
        report(f"round {number}: {line}")

    folder.mkdir(exist_ok=True)
    flown, recent = _flown(setting, number, folder, before, say)
    known = (*before.logs, *recent)
    found, error = _refitted(setting, known, recent, before.model, folder, say)
    logs = [read_log(file, setting.fit.logs) for file in known]
    own = [log for log in logs if Path(log.path) in recent]
    hit = [f"round_{number}_{run}" for run, why in enumerate(flown.crashes) if why == GATE]
    race = setting.race.at("reward.gate_edge_margin", before.margin)
    margin = margin_of(race, own, hit, len(hit))
    model = found.model if found and not found.refused else before.model
    after = Progress(before.policy, model, margin, known)
    seconds = found.seconds if found else 0.0
    if model is not before.model or margin > before.margin:
        after = dataclasses.replace(after, policy=tune(setting, after, logs, folder, say))
        seconds += float(read_summary(folder / "training")["seconds"])
    return after, Round(flown, found, error, seconds, margin, len(recent))


def _flown(
    setting: Setting, number: int, folder: Path, before: Progress, report: Report
) -> tuple[Flown, list[Path]]:
    """The flights of a round, and the logs that a fit accepts: not those of early crashes."""
    assert setting.plant is not None
    path, logs, name = folder / "flights.json", folder / "logs", f"round_{number}"
    if not path.exists():
        report("flying")
        logs.mkdir(exist_ok=True)
        race, seed = before.model.race(setting.race), setting.seed + number
        options = (name, logs, setting.flights, setting.laps, seed, report)
        fly_and_log(race, setting.plant, before.policy, *options).save(path)
    flown = Flown.load(path)
    least = setting.fit.logs.min_seconds + SHORT
    files = [logs / f"{name}_{run}.csv" for run in range(len(flown.seconds))]
    long = [file for file, seconds in zip(files, flown.seconds, strict=True) if seconds > least]
    return flown, [file for file in long if _accepted(file, setting.fit)]


def _accepted(file: Path, fit: FitConfig) -> bool:
    """Whether the checks of a log accept it; columns of short logs may seem inconsistent."""
    try:
        read_log(file, fit.logs)
    except InputError:
        return False
    return True


def _refitted(
    setting: Setting,
    known: Sequence[Path],
    recent: Sequence[Path],
    present: Model,
    folder: Path,
    report: Report,
) -> tuple[Refit | None, str]:
    """The model of a round, or why the logs do not give one."""
    path, refused = folder / "model.json", folder / "no_model.txt"
    if path.exists():
        return Refit.load(path), ""
    if not refused.exists():
        try:
            if not recent:
                raise InputError(
                    "every log of the round is rejected or shorter than logs.min_seconds"
                )
            battery = setting.race.battery
            found = refit(known, recent, setting.fit, present, folder, report, battery)
            found.save(path)
            return found, ""
        except InputError as error:
            write_text(refused, f"{error}\n")
    return None, refused.read_text(encoding="utf-8").strip()


def _tuning(setting: Setting, progress: Progress, states: Path | None) -> Config:
    return tuning_config(
        setting.race, progress.model, progress.policy, states, progress.margin, setting.steps
    )


def tune(
    setting: Setting, progress: Progress, logs: Sequence[FlightLog], folder: Path, report: Report
) -> Path:
    """Fine-tune a policy in ``folder/training``; returns the file of its last parameters.

    Where these do not fly, it is the file of the best ones.
    """
    path = folder / "states.npz"
    if not path.exists():
        states = states_of_logs(logs, progress.model.race(setting.race))
        if states is not None:
            save([states], path)
    place = folder / "training"
    if not is_finished(place):
        report("fine-tuning")
        config = _tuning(setting, progress, path if path.exists() else None)
        if not train(config, place, resume=True, progress=False).finished:
            raise StoppedError
    # The best by lap time may pass closer to the edges than the margin asks for.
    flies = read_summary(place)["last_lap_total"] is not None
    return place / ("policy_last.npz" if flies else "policy.npz")
