"""Timed laps of a policy, with their table and figures."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from quadjax.config import schema
from quadjax.config.checks import with_body
from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.limits import MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED, check_integer
from quadjax.core.provenance import provenance
from quadjax.evaluation.figures import flight_title, signals_figure, trajectory_figure
from quadjax.evaluation.figures_3d import attitude_figure, space_figure
from quadjax.evaluation.published import published_flight
from quadjax.evaluation.tables import Row, counted, describe_crashes, format_table, lap_row
from quadjax.flights.files import lap_times, save
from quadjax.flights.flight import Flight, distinct, fastest, recorded_flights
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.laps import Actor, Laps, Trace
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import VehicleModel
from quadjax.view.data import page_record
from quadjax.view.notebook import show


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed laps of a policy in a race.

    Attributes:
        laps: lap times (runs, laps) in s, totals, crashes.
        deterministic: the mean action was applied, not samples.
        start: "hover", or "random": the starts of training.
        gates: of the track, in order of passage.
        time_step: of the simulation, s.
        model: of the vehicle.
        published: published lines of the same race and protocol, for the table.
        provenance: versions, config, policy, seed, date and device.
        fly: repeats the runs; with ``trace=True`` it records their states.
    """

    laps: Laps
    deterministic: bool
    start: str
    gates: Sequence[GateSection]
    time_step: float
    model: VehicleModel
    published: tuple[Row, ...]
    provenance: dict[str, Any]
    fly: Callable[..., tuple[Laps, Trace | None]] = dataclasses.field(repr=False)

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
        """Every run as a flight; the race is repeated to record it."""
        _, trace = self.fly(trace=True)
        assert trace is not None
        return recorded_flights(trace, self.laps, self.time_step, self.gates, self.model)

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
        return flights + [lap_times(row.label, row.laps) for row in self.published]

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m."""
        return np.concatenate([_gate_offsets(flight) for flight in self.flights])

    def label(self) -> str:
        """How the actions were chosen, and the number of runs."""
        how = "deterministic" if self.deterministic else "sampled"
        return f"{how}, {counted(len(self.laps.crashes), 'run')}"

    def table(self) -> str:
        """The lap table, with the published rows of the same race and protocol, if any."""
        return lap_table({self.label(): self})

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        best = self.best
        return trajectory_figure([best], self.gates, flight_title(best))

    def plot_signals(self) -> Figure:
        """Actuators and body rates of the best run over time."""
        return signals_figure(self.best, flight_title(self.best))

    def plot_3d(self) -> Figure:
        """The best run in perspective, colored by speed."""
        best = self.best
        return space_figure([best], self.gates, flight_title(best))

    def plot_attitude(self) -> Figure:
        """Height, speed and Euler angles of the best run over time."""
        return attitude_figure({"": self.best}, flight_title(self.best))

    def show(self, path: Path | str | None = None) -> None:
        """Show the runs in 3D: in a notebook, or as a page in the browser.

        Args:
            path: of the page, an HTML file that needs no network; a temporary file if not given.
        """
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


def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str,
    *,
    runs: int | None = None,
    laps: int | None = None,
    gates: int | None = None,
    deterministic: bool = False,
    start: Literal["hover", "random"] = "hover",
    seed: int = 0,
    name: str | None = None,
    body_radius: float | None = None,
    actor: Actor = pilot.fly,
) -> Evaluation:
    """Time the laps of a policy by the rules of a race.

    Args:
        policy: a policy, or the path of its file.
        config: of the race: a config, a preset's name or a YAML file.
        runs: number of runs; ``evaluate.runs`` of the config if not given.
        laps: of a run; ``evaluate.laps`` of the config if neither is given.
        gates: of a run, in place of laps; ``evaluate.gates`` of the config if neither is given.
        deterministic: apply the mean action; samples otherwise.
        start: from hover before the first gate, or from the random starts of training.
        seed: of the noise, the disturbances and the starts.
        name: of the policy, for messages and JSON; its path if not given.
        body_radius: of the drone, m, in place of ``rules.body_radius``; gates are then tested where
            the line between two samples crosses their planes (``rules.gate_test: interpolated``).
        actor: computes the actions; see ``quadjax.policy.pilot.fly_policy``.

    Raises:
        InputError: a file that cannot be read, a policy for another vehicle model, or a number out
            of range.
    """
    config = config if isinstance(config, Config) else load_config(config)
    own = policy if isinstance(policy, Policy) else Policy.load(policy, config)
    name = name or ("policy" if isinstance(policy, Policy) else str(policy))
    if body_radius is not None:
        config = with_body(config, body_radius)
    if config.run.compilation_cache:
        enable_compilation_cache()
    race = _checked_race(config.evaluate, runs, laps, gates, seed)
    hover = start == "hover"
    if start not in ("hover", "random"):
        raise InputError(f"start is {start!r}, allowed: hover, random")
    choices, params = race_of(config)
    how: dict[str, Any] = {
        "from_hover": hover,
        "deterministic": deterministic,
        "actor": actor,
        "name": name,
    }
    fly = functools.partial(pilot.fly_policy, choices, params, own, **race, **how)
    published = published_flight(
        config, race["laps"], race["gates"], deterministic=deterministic, from_hover=hover
    )
    return Evaluation(
        laps=fly()[0],
        deterministic=deterministic,
        start=start,
        gates=config.track.gates,
        time_step=config.rules.time_step,
        model=choices.model,
        published=() if published is None else (published,),
        provenance=provenance(config, name, seed),
        fly=fly,
    )


def _checked_race(
    defaults: schema.Evaluate, runs: int | None, laps: int | None, gates: int | None, seed: int
) -> dict[str, Any]:
    """Arguments of ``evaluate``, with the config's values where there are none."""
    if laps is not None and gates is not None:
        raise InputError(f"gates is {gates}, allowed: null with laps")
    if laps is None and gates is None:
        gates = defaults.gates
    laps = defaults.laps if laps is None else laps
    runs = defaults.runs if runs is None else runs
    check_integer("laps", laps, 1, MAX_LAPS)
    check_integer("gates", 1 if gates is None else gates, 1, MAX_GATES)
    check_integer("runs", runs, 1, MAX_RUNS)
    check_integer("seed", seed, 0, MAX_SEED)
    return {"laps": laps, "gates": gates, "runs": runs, "seed": seed}


def _gate_offsets(flight: Flight) -> np.ndarray:
    """The larger of the lateral and the vertical distance of each passage (n,), m."""
    gates = [flight.gates[int(index)] for index in flight.passages[:, 1]]
    when = flight.passages[:, 0]
    path = [np.interp(when, flight.time, column) for column in flight["position"].T]
    center = np.array([gate.position for gate in gates], np.float64).reshape(-1, 3)
    axes = np.array([gate.axes for gate in gates]).reshape(-1, 3, 3)
    place = np.einsum("ni,nij->nj", np.stack(path, axis=1) - center, axes)
    return np.abs(place[:, 1:]).max(axis=1)


def lap_table(evaluations: Mapping[str, Evaluation]) -> str:
    """Evaluations of one race by label as one table, then how runs ended early."""
    rows = [lap_row(label, each.laps) for label, each in evaluations.items()]
    published = {each.published for each in evaluations.values() if not each.deterministic}
    text = [format_table(rows, published.pop() if len(published) == 1 else ())]
    for label, each in evaluations.items():
        text += [f"{label}: {line}" for line in describe_crashes(each.laps).splitlines()]
    return "\n".join(text)
