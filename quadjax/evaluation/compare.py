"""E2E against INDI: flights in the simulator and on a plant, and by how much E2E is faster."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from quadjax.config.schema import Config
from quadjax.core.errors import InputError, InputWarning
from quadjax.core.provenance import file_record, provenance
from quadjax.core.resources import policy_file
from quadjax.evaluation.comparison import PLANT, SIMULATED, Comparison, world
from quadjax.evaluation.conditions import Condition, Conditions, read_conditions
from quadjax.evaluation.evaluate import evaluate
from quadjax.evaluation.rows import Row
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.plant.flights import race_config
from quadjax.policy.file import Policy
from quadjax.policy.race import differences, race_of_policy, warn_of_other_race
from quadjax.training.result import Run

Trained = Policy | Run | Path | str
Race = Config | Path | str | None
KINDS = {"e2e": "motor", "indi": "rate"}  # vehicle model of each contender's policies


class TrainedPolicy(NamedTuple):
    """A policy, and the race that it flies."""

    file: str
    policy: Policy
    race: Config  # its vehicle is the model on board


def compare(
    e2e: Trained | Sequence[Trained],
    indi: Trained | Sequence[Trained],
    *,
    plant: PlantConfig | Path | str | None = None,
    drones: int | None = None,
    runs: int = 100,
    laps: int = 6,
    deterministic: bool | None = None,
    seed: int = 0,
    race: Race = None,
    conditions: Conditions | Sequence[Condition] | Path | str | None = None,
    failed_after: float | None = None,
    names: tuple[str, str] = ("E2E", "INDI"),
    progress: Callable[[str], object] = lambda text: None,
) -> Comparison:
    """Fly E2E and INDI, each with the vehicle of its training, by ``evaluate``.

    Flights of one index have the same drone, battery and noise for every policy.

    Args:
        e2e: a policy of the vehicle model ``motor``: its file, the folder of its run, the name of a
            shipped one, a ``Policy`` or a ``Run``; or several, trainings with different seeds.
        indi: the same, of the vehicle model ``rate``.
        plant: config of the plant; None: the simulator only.
        drones: of the plant, which share the runs.
        runs: of each policy.
        laps: of a run.
        deterministic: apply the mean action; None: as the conditions say, otherwise samples.
        seed: of noise, batteries, gusts and sensors.
        race: the race of both; None: for each policy that of its training, which must have the same
            track and rules.
        conditions: a list as of ``evaluate``, flown on the plant or that of the list; without one,
            in the simulator.
        failed_after: total, s, that a flight that does not finish has in the score; None: twice the
            mean total of the flights that finish, as if the race were flown again.
        names: of the contenders, in tables and figures.
        progress: called with what is flown.

    Raises:
        InputError: a policy of another vehicle model, races with another track or other rules, or
            what ``evaluate`` refuses.
    """
    listed = None if conditions is None else read_conditions(conditions)
    plant = plant or (None if listed is None else listed.plant)
    plant = load_plant_config(plant) if isinstance(plant, Path | str) else plant
    both = [
        [_load_trained(argument, one, race) for one in ([x] if isinstance(x, Trained) else x)]
        for argument, x in (("e2e", e2e), ("indi", indi))
    ]
    _check_races([*both[0], *both[1]])
    how: dict[str, Any] = {"runs": runs, "laps": laps, "deterministic": deterministic, "seed": seed}
    how |= {"drones": drones, "conditions": listed, "progress": progress}
    places = [plant] if plant is None or listed is not None else [None, plant]
    flown = [[_fly(training, places, how) for training in trainings] for trainings in both]
    worlds = {
        label: world(label, names, [[x[label] for x in rows] for rows in flown], failed_after)
        for label in flown[0][0]
    }
    policies = {
        name: [file_record(x.file) | {"race": provenance(x.race)["config"]} for x in trainings]
        for name, trainings in zip(names, both, strict=True)
    }
    origin = provenance(plant, seed=seed) | {"policies": policies}
    return Comparison(names, worlds, listed is not None, origin)


def _load_trained(argument: str, given: Trained, race: Race) -> TrainedPolicy:
    """A policy of an argument of ``compare``, in the race of both or in its own."""
    if isinstance(given, Run):
        file, policy, race = str(given.folder), given.policy, race or given.config
    elif isinstance(given, Policy):
        file, policy = "policy", given
    else:
        file, policy = str(policy_file(given)), Policy.load(given, race)
    if policy.vehicle != KINDS[argument]:
        expected = f"expected {KINDS[argument]} for {argument}"
        raise InputError(f"{file}: a policy for the {policy.vehicle} vehicle, {expected}")
    flown, _ = race_of_policy(policy, file, race)
    warn_of_other_race(policy, flown, file)
    return TrainedPolicy(file, policy, flown)


def _check_races(trainings: Sequence[TrainedPolicy]) -> None:
    first = trainings[0]
    for other in trainings[1:]:
        for key, there, here in differences(first.race, other.race, ("track", "rules")):
            raise InputError(
                f"{key} is {there} in the race of {first.file}, {here} in that of {other.file}; "
                "allowed: policies of one race, or a race for both (race=CONFIG, --race CONFIG)"
            )


def _fly(
    training: TrainedPolicy, places: Sequence[PlantConfig | None], how: dict[str, Any]
) -> dict[str, Row]:
    """Flights in the simulator (None) or on a plant, by their labels or those of conditions."""
    file, policy, race = training
    flown: dict[str, Row] = {}
    for plant in places:
        config = race_config(race, policy) if plant is None else race
        options = how | {"drones": how["drones"] if plant is places[-1] else None}
        with warnings.catch_warnings():  # ``_load_trained`` warns of another race
            warnings.filterwarnings("ignore", ".*: trained in another race", InputWarning)
            rows = evaluate(policy, config, name=file, plant=plant, **options).rows
        label = SIMULATED if plant is None else PLANT
        flown |= {label if how["conditions"] is None else row.condition: row for row in rows}
    return flown
