"""The studies of ``quadjax evaluate``: flights of policies as a table, and as numbers for JSON."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.evaluation.evaluation import Evaluation, evaluate, lap_table
from quadjax.evaluation.protocols import fly_protocols, protocol_table
from quadjax.evaluation.published import published_sampled
from quadjax.export.actor import fixed_point_fly
from quadjax.export.race_tables import track_ranges
from quadjax.export.ranges import parse_overrides
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.race import policy_path, race_of_policy
from quadjax.race.random_track import RandomTracks
from quadjax.studies.race_flights import fly_races, race_table
from quadjax.studies.random_tracks import fly_random_tracks
from quadjax.studies.robustness import fly_spreads, spread_table

Report = Callable[[str], object]


class StudyResult(NamedTuple):
    """The result of a study."""

    text: str  # the table
    record: dict[str, Any]  # the numbers and their provenance, for JSON
    evaluation: Evaluation | None = None  # that is drawn


@dataclasses.dataclass(frozen=True)
class Entry:
    """A policy and the race that it flies."""

    file: Path
    label: str
    policy: Policy
    race: Config

    @classmethod
    def read(
        cls, path: Path, config: str | None, overrides: Sequence[str], report: Report
    ) -> "Entry":
        """A policy file, or the folder of a run, in the race of a config or in its own.

        Args:
            path: the file or folder.
            config: a preset or a file; None: the race in which the policy was trained.
            overrides: of the config.
            report: called with a line of text if the race is that of a preset.

        Raises:
            InputError: a file that cannot be read, or a policy that does not fit the race.
        """
        file, label = policy_path(path), path.name if path.is_dir() else path.stem
        if config is None:
            policy = Policy.load(file)
            race, _ = race_of_policy(policy, file, report=report)
        else:
            race = load_config(config, overrides)
            policy = Policy.load(file, race)
        pilot.fit_race(*race_of(race), policy, str(file))
        return cls(file, label, policy, race)

    def origin(self, seed: int) -> dict[str, Any]:
        """The provenance of flights with a seed."""
        return provenance(self.race, str(self.file), seed)


def laps(
    entries: Sequence[Entry],
    report: Report,
    *,
    deterministic: bool = False,
    fixed_point: bool = False,
    range_: Sequence[str] | None = None,
    body: float | None = None,
    offsets: bool = False,
    runs: int | None = None,
    laps: int | None = None,
    gates: int | None = None,
    start: Literal["hover", "random"] = "hover",
    seed: int = 0,
) -> StudyResult:
    """Timed laps of one policy, sampled and with the mean action; see ``evaluate``.

    The first line of the table is the one that is saved. With ``fixed_point`` the arithmetic is
    that of C which is exported with the ranges ``range_``; ``offsets`` adds a line on the distances
    from the gates' centers.
    """
    (entry,) = entries
    if range_ and not fixed_point:
        raise InputError("--range is allowed only with --fixed-point")
    how: dict[str, Any] = {"runs": runs, "laps": laps, "gates": gates, "start": start, "seed": seed}
    how |= {"name": str(entry.file), "body_radius": body}
    fly = functools.partial(evaluate, entry.policy, entry.race, **how)
    if fixed_point:
        _, params = race_of(entry.race)
        ranges = track_ranges(entry.policy.layout, params.track) | parse_overrides(range_ or [])
        actor = fixed_point_fly(entry.policy, ranges)
        results = {"fixed point, mean": fly(deterministic=True, actor=actor)}
    else:
        flown = [fly(deterministic=mean) for mean in ((True,) if deterministic else (False, True))]
        results = {result.label(): result for result in flown}
    first, text = next(iter(results.values())), lap_table(results)
    if offsets and first.gate_offsets.size:
        mean, wide = first.gate_offsets.mean(), np.percentile(first.gate_offsets, 95.0)
        text += f"\ndistance from the gates' centers: mean {mean:.3f} m, 95% within {wide:.3f} m"
    return StudyResult(text, first.to_json(), first)


def write_files(evaluation: Evaluation, files: Mapping[str, Path], report: Report) -> None:
    """Write the states, the figures and the animation of an evaluation, by their options."""
    figures = {
        "figure": evaluation.plot,
        "figure_3d": evaluation.plot_3d,
        "signals": evaluation.plot_signals,
        "attitude": evaluation.plot_attitude,
    }
    frames = itertools.count(1)
    for option, path in files.items():
        if option == "states":
            evaluation.save_states(path)
        elif option == "animation":
            evaluation.animate(path, lambda: report(f"animation, frame {next(frames)}"))
        else:
            save_figure(figures[option](), path)


def protocols(entries: Sequence[Entry], report: Report, *, runs: int = 100) -> StudyResult:
    """Mean and sampled flights from hover and from random starts, of any number of policies."""
    rows, race = [], entries[0].race
    for number, entry in enumerate(entries, 1):
        report(f"{entry.label}, {number} of {len(entries)}")
        fly = functools.partial(evaluate, entry.policy, entry.race, runs=runs, name=str(entry.file))
        published = published_sampled(entry.race)
        rows.append(fly_protocols(fly, entry.label, entry.policy.log_std, published))
    shared = race if all(entry.race == race for entry in entries) else None
    record = {"results": [row.to_json() for row in rows], "provenance": provenance(shared)}
    return StudyResult(protocol_table(rows), record)


def spread(
    entries: Sequence[Entry], report: Report, *, runs: int = 1000, seconds: int = 12, seed: int = 0
) -> StudyResult:
    """Flights of one policy that start in front of a gate, with drawn constants."""
    (entry,) = entries
    flights = fly_spreads(entry.policy, entry.race, runs, seconds, seed, str(entry.file))
    rows = [row.to_json() for row in flights]
    record = {"seconds": seconds, "flights": rows, "provenance": entry.origin(seed)}
    return StudyResult(spread_table(flights, entry.label), record)


def races(
    entries: Sequence[Entry],
    report: Report,
    *,
    runs: int = 1000,
    laps: int | None = None,
    gates: int | None = None,
    seed: int = 0,
) -> StudyResult:
    """Whole races from around the track's start, with drawn constants, of one policy."""
    (entry,) = entries
    flights = fly_races(entry.policy, entry.race, runs, laps, gates, seed, str(entry.file))
    rows = [row.to_json() for row in flights]
    return StudyResult(race_table(flights), {"flights": rows, "provenance": entry.origin(seed)})


def random_tracks(
    entries: Sequence[Entry], report: Report, *, runs: int = 100, laps: int = 3
) -> StudyResult:
    """One flight of one policy on each of several random tracks that training does not use."""
    (entry,) = entries
    trained = entry.race.randomization.tracks or RandomTracks()
    tracks = trained.replace(seed=trained.seed + trained.count, count=runs)
    flown = fly_random_tracks(entry.policy, entry.race, tracks, laps, str(entry.file))
    return StudyResult(flown.table(), flown.to_json() | {"provenance": entry.origin(0)})


STUDIES: dict[str, Callable[..., StudyResult]] = {
    "laps": laps,
    "protocols": protocols,
    "spread": spread,
    "races": races,
    "random-tracks": random_tracks,
}
