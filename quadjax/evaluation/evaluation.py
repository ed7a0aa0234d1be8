"""Timed flights of a policy by the rules of a race, under one or several conditions."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypedDict, Unpack, overload

from quadjax.config.checks import with_body
from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.provenance import provenance
from quadjax.evaluation.conditions import Condition, Conditions, Start, damaged, read_conditions
from quadjax.evaluation.plants import fly_plants
from quadjax.evaluation.protocol import Length, Protocol
from quadjax.evaluation.published import published_flight
from quadjax.evaluation.result import Evaluation, Evaluations, Record
from quadjax.evaluation.rows import Row
from quadjax.evaluation.simulate import Flights, longest, prepare
from quadjax.flights.flight import Flight, recorded_flights
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.laps import Actor
from quadjax.race.random_track import RandomTracks


class Options(TypedDict, total=False):
    """The other arguments of ``evaluate``."""

    runs: int | None
    laps: int | None
    gates: int | None
    seconds: float | None
    deterministic: bool
    start: Start
    seed: int
    plant: PlantConfig | Path | str | None
    plants: int | None
    tracks: RandomTracks | int | None
    name: str | None
    body_radius: float | None
    actor: Actor
    progress: Callable[[str], object]


@overload
def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str,
    *,
    conditions: None = None,
    **options: Unpack[Options],
) -> Evaluation: ...


@overload
def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str,
    *,
    conditions: Conditions | Sequence[Condition] | Path | str,
    **options: Unpack[Options],
) -> Evaluations: ...


def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str,
    *,
    runs: int | None = None,
    laps: int | None = None,
    gates: int | None = None,
    seconds: float | None = None,
    deterministic: bool = False,
    start: Start = "hover",
    seed: int = 0,
    conditions: Conditions | Sequence[Condition] | Path | str | None = None,
    plant: PlantConfig | Path | str | None = None,
    plants: int | None = None,
    tracks: RandomTracks | int | None = None,
    name: str | None = None,
    body_radius: float | None = None,
    actor: Actor = pilot.fly,
    progress: Callable[[str], object] = lambda text: None,
) -> Evaluation | Evaluations:
    """Time the flights of a policy by the rules of a race.

    Args:
        policy: a policy, or the path of its file.
        config: of the race: a config, a preset's name or a YAML file.
        runs: number of runs; ``evaluate.runs`` of the config if not given.
        laps: of a run; ``evaluate.laps`` of the config if neither is given.
        gates: of a run, in place of laps; ``evaluate.gates`` of the config if neither is given.
        seconds: of a run, in place of laps: it ends then, or with a crash.
        deterministic: apply the mean action; samples otherwise.
        start: from hover before the first gate ("hover"), from hover around that place ("around"),
            from the random starts of training ("random"), or 1 m before a random gate
            ("before_gate").
        seed: of the noise, the disturbances and the starts.
        conditions: a list of conditions, its file, or a name in ``configs/conditions``; what it
            says of runs, laps, start, actions, plant and tracks is the default of these arguments.
        plant: config of the stand-in plant on which the policy flies; None: in the simulator.
        plants: number of drawn plants, which share the runs. Each has its own noise.
        tracks: fly each run on another random track: their settings, or the number of tracks, with
            the seeds after those of ``randomization.tracks``; in place of ``runs``.
        name: of the policy, for messages, tables and JSON; its path if not given.
        body_radius: of the drone, m, in place of ``rules.body_radius``; gates are then tested where
            the line between two samples crosses their planes (``rules.gate_test: interpolated``).
        actor: computes the actions; see ``quadjax.policy.pilot.fly``.
        progress: called with the label of each condition before it is flown.

    Returns:
        The flights; with ``conditions`` those under each of them.

    Raises:
        InputError: a file that cannot be read, a policy for another vehicle model, or a number out
            of range.
    """
    config = config if isinstance(config, Config) else load_config(config)
    network = policy if isinstance(policy, Policy) else Policy.load(policy, config)
    name = name or ("policy" if isinstance(policy, Policy) else str(policy))
    if body_radius is not None:
        config = with_body(config, body_radius)
    if config.run.compilation_cache:
        enable_compilation_cache()
    listed = read_conditions((Condition(label="-"),) if conditions is None else conditions)
    said = {"start": start, "deterministic": deterministic}
    listed = listed.replace(**{k: x for k, x in said.items() if getattr(listed, k) is None})
    length: Length = {"laps": laps, "gates": gates, "seconds": seconds}
    protocol = Protocol.of(config, listed, length, runs, seed, plants, tracks)
    if plant is None or not isinstance(plant, PlantConfig):
        source = plant or listed.plant
        plant = None if source is None else load_plant_config(source)
    if plant is not None and actor is not pilot.fly:
        raise InputError("actor is given, allowed: without a plant")
    job = Job(network, name, config, protocol, plant, actor)
    results = []
    for condition, race in list(listed.of(config)):
        progress(f"{name}: {condition.label}" if conditions is not None else name)
        results.append(job.evaluate(condition, race))
    if conditions is None:
        return results[0]
    return Evaluations(listed, protocol, tuple(results))


@dataclasses.dataclass(frozen=True)
class Job:
    """A policy that flies under conditions.

    Attributes:
        policy: its network.
        name: of the policy.
        config: of the race as modeled; its vehicle is the onboard model.
        protocol: how flights are flown.
        plant: on which they are flown; None: in the simulator.
        actor: computes the actions.
    """

    policy: Policy
    name: str
    config: Config
    protocol: Protocol
    plant: PlantConfig | None
    actor: Actor

    @property
    def label(self) -> str:
        """The stem of the policy's file, or the name of the run's folder."""
        path = Path(self.name)
        if path.suffix != ".npz":
            return self.name
        return path.parent.name if path.stem == "policy" and path.parent.name else path.stem

    def evaluate(self, condition: Condition, race: Config) -> Evaluation:
        """The flights under one condition, whose race is given."""
        protocol = self.protocol.under(condition)
        fly = self._simulate if self.plant is None else self._fly_on_plant
        row, record = fly(condition, race, protocol)
        published = None
        if self.plant is None and protocol.plain and condition.damage is None:
            published = published_flight(
                race,
                protocol.laps,
                protocol.gates,
                deterministic=protocol.deterministic,
                from_hover=protocol.start == "hover",
            )
        return Evaluation(
            row=dataclasses.replace(row, beside=published),
            protocol=protocol,
            gates=race.track.gates,
            time_step=race.rules.time_step,
            provenance=provenance(self.config, self.name, protocol.seed),
            record=record,
        )

    def _simulate(
        self, condition: Condition, race: Config, protocol: Protocol
    ) -> tuple[Row, Record]:
        label = condition.label
        if condition.plant or condition.only is not None:
            raise InputError(f"condition {label}: changes the plant, allowed: with a plant")
        if protocol.tracks is not None:
            last = protocol.tracks.seed + protocol.tracks.count - 1
            label = f"{protocol.tracks.seed} to {last}"
            settings = race.randomization.replace(tracks=protocol.tracks)
            race = race.replace(randomization=settings)
        flights = self._flights(condition, race, protocol)
        speeds, limit = None, race.vehicle.fitted_speed
        if protocol.speeds:
            laps, speeds = flights.fly_with_speeds(limit)
        else:
            laps, _ = flights.fly()

        def record() -> list[Flight]:
            _, trace = flights.fly(trace=True)
            assert trace is not None
            model, gates = flights.choices.model, race.track.gates
            return recorded_flights(trace, laps, flights.time_step, gates, model)

        return Row(self.label, laps, label, speeds=speeds, speed_limit=limit), record

    def _flights(self, condition: Condition, race: Config, protocol: Protocol) -> Flights:
        """Flights in the simulator; the onboard estimator is that of the race as modeled."""
        modeled = race_of(race)
        choices, params, own = prepare(modeled, self.policy, self.name, protocol.deterministic)
        if condition.damage is not None:
            choices = dataclasses.replace(choices, model=damaged(choices.model, condition.damage))
        if protocol.drawn:
            choices = dataclasses.replace(choices, randomize=True)
        if params.estimator is not None and race.vehicle != self.config.vehicle:
            onboard = self.config.replace(observation=race.observation)
            params = params.replace(estimator=race_of(onboard)[1].estimator)
        tracks = None if protocol.tracks is None else modeled[1].tracks
        if tracks is not None:
            params = params.replace(track=longest(tracks))
        return Flights(choices, params, own, protocol, tracks, self.actor)

    def _fly_on_plant(
        self, condition: Condition, race: Config, protocol: Protocol
    ) -> tuple[Row, Record]:
        assert self.plant is not None
        if condition.damage is not None:
            raise InputError(f"condition {condition.label}: has damage, allowed: without a plant")
        plant = condition.on_plant(self.plant)
        laps, record = fly_plants(self.policy, self.name, race, plant, protocol)
        return Row(self.label, laps, condition.label, protocol.plants), record
