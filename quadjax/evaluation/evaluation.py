"""Timed laps of a policy, with their table and figures."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.arguments import MAX_LAPS, MAX_RUNS, MAX_SEED
from quadjax.core.errors import InputError, check_integer
from quadjax.core.files import write_npz
from quadjax.core.plotting import show_figure
from quadjax.core.provenance import provenance
from quadjax.evaluation.figures import flight_title, signals_figure, trajectory_figure
from quadjax.evaluation.recording import (
    SIGNALS,
    Recording,
    choose,
    distinct,
    gate_offsets,
    recordings,
)
from quadjax.evaluation.tables import counted, describe_crashes, format_table, lap_row
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps, Trace
from quadjax.training.paper import published_rows

Fly = Callable[[bool], tuple[Laps, Trace | None]]  # whether to record; result and recording


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed laps of a policy in the race of a config.

    Attributes:
        config: of the race.
        race: laps, runs, start and seed.
        laps: lap times (runs, laps) in s, totals, crashes.
        deterministic: the mean action was applied, not samples.
        policy_name: the policy's file, or "policy".
    """

    config: Config
    race: pilot.Race
    laps: Laps
    deterministic: bool
    policy_name: str
    fly: Fly = dataclasses.field(repr=False)

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
    def flights(self) -> list[Recording]:
        """The recorded trajectory of every run; the race is repeated to record it."""
        laps, trace = self.fly(True)
        assert trace is not None
        return recordings(trace, laps, self.config.rules.time_step)

    @property
    def best(self) -> Recording:
        """The fastest of the recorded runs, or the longest if none finished."""
        return choose(self.flights)

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m."""
        gates = self.config.track.gates
        return np.concatenate([gate_offsets(flight, gates) for flight in self.flights])

    def label(self) -> str:
        """How the actions were chosen, and the number of runs."""
        runs = counted(self.race.runs, "run")
        return f"deterministic, {runs}" if self.deterministic else f"sampled, {runs}"

    def table(self) -> str:
        """The lap table, with the published rows if the race is the paper's."""
        return lap_table({self.label(): self})

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        best = self.best
        return trajectory_figure([best], self.config.track.gates, flight_title(best))

    def plot_signals(self) -> Figure:
        """Actuators and body rates of the best run over time."""
        return signals_figure(self.best, flight_title(self.best))

    def show(self) -> None:
        """Show the figure of ``plot``: in a notebook, or in a window until it is closed.

        Without a display nothing is shown: write the figure with ``plot().savefig(path)``.
        """
        show_figure(self.plot())

    def animate(self, path: Path | str, advance: Callable[[], object] = lambda: None) -> None:
        """Write an animation of all runs in real time.

        Args:
            path: a ``.gif`` file.
            advance: called after every frame.
        """
        from quadjax.evaluation.animation import write_animation

        write_animation(distinct(self.flights), self.config.track.gates, path, advance)

    def save_states(self, path: Path | str) -> None:
        """Write the trajectories of all runs to an ``.npz`` file.

        Arrays: ``time`` (steps,) s; ``position``, ``velocity`` (runs, steps, 3) m, m/s, world NED;
        ``euler``, ``rates`` (runs, steps, 3) rad, rad/s; ``actuators`` (runs, steps, 4 or 1) rpm or
        m/s^2; ``command`` (runs, steps, 4); NaN after the end of a run; ``lap_times`` (runs, laps)
        s; ``meta``, the JSON of ``to_json``.
        """
        longest = max(self.flights, key=lambda flight: len(flight.time))
        arrays = {"time": longest.time, "lap_times": self.lap_times}
        for name in SIGNALS:
            rows = [getattr(flight, name) for flight in self.flights]
            arrays[name] = np.full((len(rows), len(longest.time), rows[0].shape[1]), np.nan)
            for whole, row in zip(arrays[name], rows, strict=True):
                whole[: len(row)] = row
        write_npz(path, arrays, self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Lap times in s, crashes, how the runs were made, and their provenance."""
        return self.laps.to_json() | {
            "deterministic": self.deterministic,
            "start": "hover" if self.race.from_hover else "random",
            "provenance": provenance(self.config, self.policy_name, self.race.seed),
        }


def evaluate(
    policy: Policy | Path | str,
    config: Config | Path | str,
    *,
    runs: int | None = None,
    laps: int | None = None,
    deterministic: bool = False,
    start: Literal["hover", "random"] = "hover",
    seed: int = 0,
    name: str | None = None,
) -> Evaluation:
    """Time the laps of a policy by the rules of a race.

    Args:
        policy: a policy, or the path of its file.
        config: of the race: a config, a preset's name or a YAML file.
        runs: number of runs; ``evaluate.runs`` of the config if not given.
        laps: of a run; ``evaluate.laps`` of the config if not given.
        deterministic: apply the mean action; samples otherwise.
        start: from hover before the first gate, or from the random starts of training.
        seed: of the noise, the disturbances and the starts.
        name: of the policy, for messages and JSON; its path if not given.

    Raises:
        InputError: a file that cannot be read, a policy for another vehicle model, or a number out
            of range.
    """
    own = policy if isinstance(policy, Policy) else Policy.load(policy)
    name = name or ("policy" if isinstance(policy, Policy) else str(policy))
    race_config = config if isinstance(config, Config) else load_config(config)

    def fly(race: pilot.Race, trace: bool) -> tuple[Laps, Trace | None]:
        return pilot.fly_policy(race_config, own, race, deterministic, trace, name)

    return evaluate_by(
        fly,
        race_config,
        runs=runs,
        laps=laps,
        deterministic=deterministic,
        start=start,
        seed=seed,
        name=name,
    )


def evaluate_by(
    fly: Callable[[pilot.Race, bool], tuple[Laps, Trace | None]],
    config: Config,
    *,
    runs: int | None,
    laps: int | None,
    deterministic: bool,
    start: str,
    seed: int,
    name: str,
) -> Evaluation:
    """Time laps that ``fly(race, record)`` flies; other arguments as of ``evaluate``."""
    if start not in ("hover", "random"):
        raise InputError(f"start is {start!r}, allowed: hover, random")
    laps = config.evaluate.laps if laps is None else laps
    runs = config.evaluate.runs if runs is None else runs
    check_integer("laps", laps, 1, MAX_LAPS)
    check_integer("runs", runs, 1, MAX_RUNS)
    check_integer("seed", seed, 0, MAX_SEED)
    race = pilot.Race(laps, runs, start == "hover", seed)
    own = functools.partial(fly, race)
    return Evaluation(config, race, own(False)[0], deterministic, name, own)


def lap_table(evaluations: Mapping[str, Evaluation]) -> str:
    """Evaluations of one race by label as one table, then how runs ended early."""
    first = next(iter(evaluations.values()))
    published = published_rows(first.config, first.race.laps, first.race.from_hover)
    rows = [lap_row(label, each.laps) for label, each in evaluations.items()]
    text = [format_table(rows, published)]
    for label, each in evaluations.items():
        text += [f"{label}: {line}" for line in describe_crashes(each.laps).splitlines()]
    return "\n".join(text)
