"""What ``quadjax improve`` is asked for, and the state between its rounds."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.fitting.config import FitConfig
from quadjax.improve.model import Model, Refit
from quadjax.plant.config import PlantConfig
from quadjax.policy.file import Policy
from quadjax.training.build import initial_policy
from quadjax.training.fine_tuning import fine_tuning

EVALUATIONS = 2  # of a fine-tuning


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
