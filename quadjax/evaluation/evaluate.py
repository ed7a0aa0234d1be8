"""Timed flights of a policy by the rules of a race, under one or several conditions."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.config.checks import with_body
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.precision import single_precision
from quadjax.core.provenance import provenance
from quadjax.evaluation.conditions import Condition, Conditions, Start, read_conditions
from quadjax.evaluation.plants import fly_plants
from quadjax.evaluation.result import Evaluation
from quadjax.evaluation.simulate import simulate
from quadjax.evaluation.table import counted
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy, warn_of_other_race
from quadjax.race.laps import Actor


@single_precision
def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str | None = None,
    *,
    runs: int | None = None,
    laps: int | None = None,
    gates: int | None = None,
    seconds: float | None = None,
    deterministic: bool | None = None,
    start: Start | None = None,
    seed: int = 0,
    conditions: Conditions | Sequence[Condition] | Path | str | None = None,
    plant: PlantConfig | Path | str | None = None,
    drones: int | None = None,
    tracks: bool | None = None,
    name: str | None = None,
    body_radius: float | None = None,
    actor: Actor = pilot.act,
    progress: Callable[[str], object] = lambda text: None,
) -> "Evaluation":
    """Time the flights of a policy by the rules of a race.

    An argument that is None has the value of the list of conditions, or else of the config.

    Args:
        policy: a policy, or the path of its file.
        config: the race: a config, a preset's name or a YAML file; None: the policy's own. There is
            an ``InputWarning`` where it differs from the race that the policy was trained in.
        runs: number of runs.
        laps: number of laps of a run.
        gates: number of gates of a run, in place of laps.
        seconds: duration of a run, in place of laps; a crash ends it earlier.
        deterministic: apply the mean action; samples otherwise.
        start: from hover before the first gate ("hover"), from hover around that place ("around"),
            from the random starts of training ("random"), or 1 m before a random gate
            ("before_gate").
        seed: seed of the noise, the disturbances and the starts.
        conditions: a list of conditions, its file, or a name in ``configs/conditions``.
        plant: config of the plant on which the policy flies; None: the simulator. On a
            plant, conditions that do not start from hover are left out.
        drones: number of drones of the plant, which share the runs: run ``i`` flies drone
            ``i % drones``; None: as many of its population as share them equally.
        tracks: fly each run on another random track, with the seeds after those of
            ``randomization.tracks``.
        name: name of the policy in messages, tables and JSON; its path if not given.
        body_radius: radius of the drone, m, in place of ``rules.body_radius``; a gate is then
            tested where the line between two samples crosses its plane (``rules.gate_test:
            interpolated``).
        actor: computes the actions; see ``quadjax.policy.pilot.act``.
        progress: called with the label of each condition before it is flown.

    Raises:
        InputError: a file that cannot be read, a policy for another vehicle model, or a number out
            of range.
    """
    race = config if config is None or isinstance(config, Config) else load_config(config)
    network = policy if isinstance(policy, Policy) else Policy.load(policy, race)
    name = name or ("policy" if isinstance(policy, Policy) else str(policy))
    config, _ = race_of_policy(network, name, race)
    warn_of_other_race(network, config, name)
    if body_radius is not None:
        config = with_body(config, body_radius)
    if config.run.compilation_cache:
        enable_compilation_cache()
    listed = read_conditions((Condition(label="-"),) if conditions is None else conditions)
    numbers = {"runs": runs, "laps": laps, "gates": gates, "seconds": seconds, "seed": seed}
    choices = {"deterministic": deterministic, "start": start, "tracks": tracks, "drones": drones}
    protocol = listed.resolve(config, **numbers, **choices)
    if not isinstance(plant, PlantConfig) and (plant := plant or protocol.plant) is not None:
        plant = load_plant_config(plant)
    if plant is None and protocol.drones is not None:
        raise InputError(f"drones is {protocol.drones}, allowed: null without a plant")
    if plant is not None and actor is not pilot.act:
        raise InputError("actor is not None, allowed: without a plant")
    flying = list(protocol.expand(config, plant))
    left_out = [c.label for c, _, drone in flying if plant is not None and drone is None]
    if len(left_out) == len(flying):
        raise InputError("plant: no condition starts from hover, allowed: start=hover")
    rows = []
    for condition, race, drone in flying:
        if condition.label in left_out:
            continue
        progress(name if conditions is None else f"{name}: {condition.label}")
        flown = protocol.apply(condition)
        if drone is None:
            row = simulate(network, name, (config, race), condition, flown, actor)
        else:
            row = fly_plants(network, name, race, drone, condition.label, flown)
        row = dataclasses.replace(row, policy=_label(name))
        if conditions is None and not flown.tracks:
            how = "deterministic" if flown.deterministic else "sampled"
            row = dataclasses.replace(row, condition=f"{how}, {counted(row.runs, 'run')}")
        rows.append(row)
    origin = provenance(config, name, protocol.seed)
    several, where = conditions is not None, f"{config.vehicle.name}, {config.track.name}"
    return Evaluation(tuple(rows), protocol, origin, several, tuple(left_out), where)


def _label(name: str) -> str:
    """The stem of a policy's file, or the name of the run's folder."""
    path = Path(name)
    if path.suffix != ".npz":
        return name
    return path.parent.name if path.stem == "policy" and path.parent.name else path.stem
