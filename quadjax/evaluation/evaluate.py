"""Timed flights of a policy by the rules of a race, under one or several conditions."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.checks import with_body
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.precision import single_precision
from quadjax.core.provenance import provenance
from quadjax.evaluation import figures
from quadjax.evaluation.conditions import Condition, Conditions, Start, read_conditions
from quadjax.evaluation.plants import fly_plants
from quadjax.evaluation.rows import Row
from quadjax.evaluation.simulate import simulate
from quadjax.evaluation.table import Format, condition_table, counted, lap_table, policy_table
from quadjax.flights.files import lap_times, save
from quadjax.flights.flight import Flight, distinct, fastest, numbered
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy, warn_of_other_race
from quadjax.race.laps import Actor, Laps


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
    plants: int | None = None,
    tracks: bool | None = None,
    name: str | None = None,
    body_radius: float | None = None,
    actor: Actor = pilot.fly,
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
        plant: config of the stand-in plant on which the policy flies; None: the simulator. On a
            plant, conditions that do not start from hover are left out.
        plants: number of drawn plants, which share the runs. Each has its own noise.
        tracks: fly each run on another random track, with the seeds after those of
            ``randomization.tracks``.
        name: name of the policy in messages, tables and JSON; its path if not given.
        body_radius: radius of the drone, m, in place of ``rules.body_radius``; a gate is then
            tested where the line between two samples crosses its plane (``rules.gate_test:
            interpolated``).
        actor: computes the actions; see ``quadjax.policy.pilot.fly``.
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
    choices = {"deterministic": deterministic, "start": start, "tracks": tracks, "plants": plants}
    protocol = listed.resolved(config, **numbers, **choices)
    if not isinstance(plant, PlantConfig) and (plant := plant or protocol.plant) is not None:
        plant = load_plant_config(plant)
    if plant is not None and actor is not pilot.fly:
        raise InputError("actor is not None, allowed: without a plant")
    flying = list(protocol.of(config, plant))
    left_out = [c.label for c, _, drone in flying if plant is not None and drone is None]
    if len(left_out) == len(flying):
        raise InputError("plant: no condition starts from hover, allowed: start=hover")
    rows = []
    for condition, race, drone in flying:
        if condition.label in left_out:
            continue
        progress(name if conditions is None else f"{name}: {condition.label}")
        flown = protocol.under(condition)
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


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed flights: a row for each policy and condition.

    ``laps``, ``flights``, ``best`` and the figures are those of the first row.

    Attributes:
        rows: policies one after the other, conditions in their order.
        protocol: how they were flown, and how the table looks.
        provenance: versions, config, policy, seed, date and device.
        by_condition: whether a list of conditions was flown.
        left_out: labels of conditions that the plant does not have.
        race: names of the drone and of the track, for titles.
    """

    rows: tuple[Row, ...]
    protocol: Conditions
    provenance: dict[str, Any]
    by_condition: bool = False
    left_out: tuple[str, ...] = ()
    race: str = ""

    def __repr__(self) -> str:
        """One line, of each row: policy, condition, how many runs finished."""
        rows = (
            f"{' '.join(filter(None, (row.policy, row.condition)))}: "
            f"{row.laps.finished}/{len(row.laps.totals)} finished"
            for row in self.rows
        )
        return f"Evaluation({', '.join(rows)})"

    def __getitem__(self, label: str) -> Row:
        """The first row of a condition, by its label."""
        return next(row for row in self.rows if row.condition == label)

    @property
    def row(self) -> Row:
        """The first row."""
        return self.rows[0]

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
        facts = {"race": self.race} if self.race else {}
        return [flight.replace(source=flight.source | facts) for flight in self.row.record()]

    @property
    def title(self) -> str:
        """The policy, the drone and the track of the first row."""
        return ": ".join(filter(None, (self.row.policy, self.race)))

    @property
    def best(self) -> Flight:
        """The fastest of the recorded runs, or the longest if none finished."""
        return fastest(self.flights)

    def named_flights(self, name: str) -> list[Flight]:
        """The distinct runs, named for a page, and the published lap times of the same race."""
        runs = distinct(self.flights)
        actions = "deterministic" if self.protocol.deterministic else "sampled"
        flights = [
            run.replace(name=label, source=run.source | {"note": f"{flight_title(run)}, {actions}"})
            for label, run in zip(numbered(name, len(runs)), runs, strict=True)
        ]
        published = self.row.published
        return flights + ([lap_times(published.policy, published.lap_means)] if published else [])

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m.

        The larger of the lateral and the vertical one.
        """
        distances = [np.zeros(0)]
        for flight in self.flights:
            when, passed = flight.passages[:, 0], flight.passages[:, 1].astype(int)
            path = [np.interp(when, flight.time, column) for column in flight["position"].T]
            center = np.array([gate.position for gate in flight.gates])[passed]
            axes = np.array([gate.axes for gate in flight.gates])[passed]
            place = np.einsum("ni,nij->nj", np.stack(path, axis=1) - center, axes)
            distances.append(np.abs(place[:, 1:]).max(axis=1))
        return np.concatenate(distances)

    def table(self, format: Format | None = None) -> str:
        """The rows as a table, by default as Markdown with conditions and as text without.

        Without conditions it is the lap table, with the published row of the same race and
        protocol, if any.
        """
        columns = self.protocol.columns
        if not self.by_condition and self.protocol.seconds is None:
            table = lap_table(self.rows)
        elif not self.by_condition:
            table = condition_table(self.rows, "", ("crashed", "ended"))
        elif self.protocol.across:
            table = policy_table(self.rows, columns[0])
        else:
            table = condition_table(self.rows, self.protocol.title, columns)
        if self.left_out:
            note = f"Not flown on the plant, which has no such start: {'; '.join(self.left_out)}."
            table = dataclasses.replace(table, notes=[*table.notes, note])
        return table.format(format or ("markdown" if self.by_condition else "text"))

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        return self.figures()["trajectory"]

    def figures(self) -> dict[str, Figure]:
        """Figures of the best run by name: ``trajectory``, ``perspective`` and ``signals``."""
        best, title = self.best, f"{self.title}\n{flight_title(self.best)}"
        return {
            "trajectory": figures.trajectory_figure([best], best.gates, title),
            "perspective": figures.space_figure([best], best.gates, title),
            "signals": figures.signals_figure(best, title),
        }

    def show(self, path: Path | str | None = None) -> None:
        """Show the runs in 3D: in a notebook, or as a page in the browser.

        Args:
            path: of the page, an HTML file that needs no network; a temporary file if not given.
        """
        from quadjax.view.data import page_record
        from quadjax.view.page import show

        title = f"{self.title}; {self.row.condition}"
        show(page_record(title, self.named_flights("run")), path)

    def save_states(self, path: Path | str) -> None:
        """Write all runs, as arrays (``.npz``) or as a table (``.csv``); see ``flights.files``.

        The metadata of the arrays have the entries of ``to_json``, too.

        Raises:
            InputError: another suffix.
        """
        save(self.flights, path, **self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Lap times in s, crashes, how the runs were made, and their provenance; or the rows."""
        protocol, record = self.protocol, {"provenance": self.provenance}
        if not self.by_condition:
            actions = {"deterministic": bool(protocol.deterministic)}
            return self.laps.to_json() | actions | {"start": protocol.start} | record
        rows = {"flights": [row.to_json() for row in self.rows]}
        return rows | ({"seconds": protocol.seconds} if protocol.seconds else {}) | record


def flight_title(flight: Flight) -> str:
    """Laps, time and crash of a flight as a short text."""
    title = f"{counted(len(flight.lap_ends), 'lap')} in {flight.time[-1]:.2f} s"
    return f"{title}, then {flight.crash}" if flight.crash else title


def joined(evaluations: Sequence[Evaluation]) -> Evaluation:
    """The rows of several evaluations of one race: of policies, or of one with other actions.

    Policies of one label have their files as labels.
    """
    files = {result.provenance["policy"]["file"]: result.row.policy for result in evaluations}
    labels = Counter(files.values())
    rows = [
        row if labels[row.policy] == 1 else dataclasses.replace(row, policy=file)
        for result in evaluations
        for file in [result.provenance["policy"]["file"]]
        for row in result.rows
    ]
    return dataclasses.replace(evaluations[0], rows=tuple(rows))
