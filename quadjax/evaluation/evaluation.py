"""Timed flights of a policy under one or several conditions, with their tables and figures."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack, overload

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.checks import with_body
from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.provenance import provenance
from quadjax.evaluation import charts, figures
from quadjax.evaluation.conditions import Condition, Conditions, Start, damaged, read_conditions
from quadjax.evaluation.plants import fly_plants
from quadjax.evaluation.protocol import Length, Protocol
from quadjax.evaluation.published import published_flight
from quadjax.evaluation.rows import Row
from quadjax.evaluation.simulate import Flights, longest, prepare
from quadjax.evaluation.table import (
    Format,
    condition_table,
    counted,
    flight_title,
    lap_table,
    policy_table,
)
from quadjax.flights.files import lap_times, save
from quadjax.flights.flight import Flight, distinct, fastest, recorded_flights
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.laps import Actor, Laps
from quadjax.race.random_track import RandomTracks
from quadjax.race.track import GateSection

Record = Callable[[], list[Flight]]


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed flights of a policy under one condition.

    Attributes:
        row: the flights, with the labels of the policy and the condition.
        deterministic: the mean action was applied, not samples.
        start: see ``evaluate``.
        gates: of the track, in order of passage.
        time_step: of the simulation, s.
        provenance: versions, config, policy, seed, date and device.
        record: the recorded flights; a simulation is repeated to record it.
    """

    row: Row
    deterministic: bool
    start: str
    gates: Sequence[GateSection]
    time_step: float
    provenance: dict[str, Any]
    record: Record = dataclasses.field(repr=False)

    @property
    def laps(self) -> Laps:
        """Lap times, totals and crashes of all runs."""
        return self.row.laps

    @property
    def lap_times(self) -> np.ndarray:
        """Lap times (runs, laps), s; NaN for laps that were not completed."""
        return self.laps.lap_times

    @property
    def totals(self) -> np.ndarray:
        """Time of all laps of each run (runs,), s; NaN for runs that did not finish."""
        return self.laps.totals

    @property
    def finished(self) -> int:
        """Number of runs that completed every lap."""
        return self.laps.finished

    @functools.cached_property
    def flights(self) -> list[Flight]:
        """Every run as a flight; of flights on the plant the first of each plant."""
        return self.record()

    @property
    def best(self) -> Flight:
        """The fastest of the recorded runs, or the longest if none finished."""
        return fastest(self.flights)

    def shown(self, name: str) -> list[Flight]:
        """The distinct runs, named for a page, and the published lap times of the same race."""
        runs = distinct(self.flights)
        actions = "deterministic" if self.deterministic else "sampled"
        flights = [
            run.replace(
                name=name if len(runs) == 1 else f"{name} {number}",
                source=run.source | {"note": f"{flight_title(run)}, {actions}"},
            )
            for number, run in enumerate(runs, start=1)
        ]
        beside = self.row.beside
        return flights + ([lap_times(beside.policy, beside.lap_means)] if beside else [])

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m."""
        return np.concatenate([_gate_offsets(flight) for flight in self.flights])

    def label(self) -> str:
        """How the actions were chosen, and the number of runs."""
        how = "deterministic" if self.deterministic else "sampled"
        return f"{how}, {counted(self.row.runs, 'run')}"

    def table(self, format: Format = "text") -> str:
        """The lap table, with the published row of the same race and protocol, if any."""
        return tabulate({self.label(): self}, format)

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        return figures.trajectory_figure([self.best], self.gates, flight_title(self.best))

    def plot_signals(self) -> Figure:
        """Actuators and body rates of the best run over time."""
        return charts.signals_figure(self.best, flight_title(self.best))

    def plot_3d(self) -> Figure:
        """The best run in perspective, colored by speed."""
        return figures.space_figure([self.best], self.gates, flight_title(self.best))

    def plot_attitude(self) -> Figure:
        """Height, speed and Euler angles of the best run over time."""
        return charts.attitude_figure({"": self.best}, flight_title(self.best))

    def show(self, path: Path | str | None = None) -> None:
        """Show the runs in 3D: in a notebook, or as a page in the browser.

        Args:
            path: of the page, an HTML file that needs no network; a temporary file if not given.
        """
        from quadjax.view.data import page_record
        from quadjax.view.notebook import show

        show(page_record(self.label(), self.shown("run")), path)

    def animate(self, path: Path | str, advance: Callable[[], object] = lambda: None) -> None:
        """Write an animation of all runs in real time.

        Args:
            path: a ``.gif`` file.
            advance: called after every frame.
        """
        from quadjax.evaluation.animation import write_animation

        write_animation(distinct(self.flights), self.gates, path, advance)

    def save_states(self, path: Path | str) -> None:
        """Write all runs, as arrays (``.npz``) or as a table (``.csv``); see ``flights.files``.

        The metadata of the arrays have the entries of ``to_json``, too.

        Raises:
            InputError: another suffix.
        """
        save(self.flights, path, **self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Lap times in s, crashes, how the runs were made, and their provenance."""
        return self.laps.to_json() | {
            "deterministic": self.deterministic,
            "start": self.start,
            "provenance": self.provenance,
        }


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """Flights of one or several policies under conditions.

    Attributes:
        conditions: the list, which says how the table looks.
        protocol: how the flights are flown.
        results: policies one after the other, conditions in their order.
    """

    conditions: Conditions
    protocol: Protocol
    results: tuple[Evaluation, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """One row for each policy and condition."""
        return tuple(result.row for result in self.results)

    def __getitem__(self, label: str) -> Evaluation:
        """The first result under a condition, by its label."""
        return next(result for result in self.results if result.row.condition == label)

    def table(self, format: Format = "markdown") -> str:
        """The rows with the columns of the list."""
        if self.conditions.across:
            return policy_table(self.rows, self.conditions.columns[0]).format(format)
        columns = self.conditions.columns
        return condition_table(self.rows, self.conditions.title, columns).format(format)

    def to_json(self) -> dict[str, Any]:
        """The rows, and the provenance of the first result."""
        first = self.results[0]
        record: dict[str, Any] = {"flights": [row.to_json() for row in self.rows]}
        if self.protocol.seconds is not None:
            record["seconds"] = self.protocol.seconds
        return record | {"provenance": first.provenance}


def joined(evaluations: Iterable[Evaluations]) -> Evaluations:
    """The results of several policies under the same conditions."""
    first, *others = evaluations
    results = [result for each in (first, *others) for result in each.results]
    return dataclasses.replace(first, results=tuple(results))


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
    if conditions is None:
        listed = listed.replace(start=start)
    if listed.deterministic is None:
        listed = listed.replace(deterministic=deterministic)
    length: Length = {"laps": laps, "gates": gates, "seconds": seconds}
    protocol = Protocol.of(config, listed, length, runs, seed, plants, tracks)
    if plant is None or not isinstance(plant, PlantConfig):
        source = plant or listed.plant
        plant = None if source is None else load_plant_config(source)
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
            deterministic=protocol.deterministic,
            start=protocol.start,
            gates=race.track.gates,
            time_step=race.rules.time_step,
            provenance=provenance(self.config, self.name, protocol.seed),
            record=record,
        )

    def _simulate(
        self, condition: Condition, race: Config, protocol: Protocol
    ) -> tuple[Row, Record]:
        label = condition.label
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

        return Row(self.name, laps, label, speeds=speeds, speed_limit=limit), record

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
            raise InputError(f"{condition.label}: has damage, allowed: without a plant")
        plant = condition.on_plant(self.plant)
        laps, record = fly_plants(self.policy, self.name, race, plant, protocol)
        return Row(self.name, laps, condition.label, protocol.plants), record


def _gate_offsets(flight: Flight) -> np.ndarray:
    """The larger of the lateral and the vertical distance of each passage (n,), m."""
    gates = [flight.gates[int(index)] for index in flight.passages[:, 1]]
    when = flight.passages[:, 0]
    path = [np.interp(when, flight.time, column) for column in flight["position"].T]
    center = np.array([gate.position for gate in gates], np.float64).reshape(-1, 3)
    axes = np.array([gate.axes for gate in gates]).reshape(-1, 3, 3)
    place = np.einsum("ni,nij->nj", np.stack(path, axis=1) - center, axes)
    return np.abs(place[:, 1:]).max(axis=1)


def tabulate(evaluations: Mapping[str, Evaluation], format: Format = "text") -> str:
    """Evaluations of one race by label as one lap table, with how runs ended early."""
    rows = [
        dataclasses.replace(result.row, policy=label, condition="")
        for label, result in evaluations.items()
    ]
    beside = {row.row.beside for row in evaluations.values() if not row.deterministic}
    published = [row for row in beside if row is not None] if len(beside) == 1 else []
    return lap_table([*rows, *published]).format(format)
