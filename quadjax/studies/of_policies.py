"""The studies of ``quadjax evaluate``: flights of policies as a table, and as numbers for JSON."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.evaluation.evaluation import Evaluation, evaluate
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
Study = tuple[str, dict[str, Any]]  # the table, and the numbers


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


def laps(
    entry: Entry, deterministic: bool, ranges: Sequence[str] | None, **how: Any
) -> dict[str, Evaluation]:
    """Timed laps: every line of the table by its label; the first is the one to save.

    Args:
        entry: the policy in its race.
        deterministic: the mean action alone, without sampled ones.
        ranges: those that exported C is given; with them its fixed-point arithmetic is used.
        how: the other arguments of ``evaluate``.
    """
    fly = functools.partial(evaluate, entry.policy, entry.race, name=str(entry.file), **how)
    if ranges is not None:
        _, params = race_of(entry.race)
        spans = track_ranges(entry.policy.layout, params.track) | parse_overrides(ranges)
        actor = fixed_point_fly(entry.policy, spans)
        return {"fixed point, mean": fly(deterministic=True, actor=actor)}
    results = [fly(deterministic=mean) for mean in ((True,) if deterministic else (False, True))]
    return {result.label(): result for result in results}


def offsets_text(evaluation: Evaluation) -> str:
    """The distances from the gates' centers, at which the gates are passed."""
    offsets = evaluation.gate_offsets
    if not offsets.size:
        return "distance from the gates' centers: no gate is passed"
    mean, wide = offsets.mean(), np.percentile(offsets, 95.0)
    return f"distance from the gates' centers: mean {mean:.3f} m, 95% within {wide:.3f} m"


def protocols(entries: Sequence[Entry], report: Report, *, runs: int = 100) -> Study:
    """Mean and sampled flights from hover and from random starts, of any number of policies."""
    rows = []
    for number, entry in enumerate(entries, 1):
        report(f"{entry.label}, {number} of {len(entries)}")
        fly = functools.partial(evaluate, entry.policy, entry.race, runs=runs, name=str(entry.file))
        published = published_sampled(entry.race)
        rows.append(fly_protocols(fly, entry.label, entry.policy.log_std, published))
    return protocol_table(rows), {"results": [row.to_json() for row in rows]}


def spread(
    entries: Sequence[Entry], report: Report, *, runs: int = 1000, seconds: int = 12, seed: int = 0
) -> Study:
    """Flights from before the gates, with drawn constants, of one policy."""
    (entry,) = entries
    flights = fly_spreads(entry.policy, entry.race, runs, seconds, seed, str(entry.file))
    record = {"seconds": seconds, "flights": [row.to_json() for row in flights]}
    return spread_table(flights, entry.label), record


def races(
    entries: Sequence[Entry],
    report: Report,
    *,
    runs: int = 1000,
    laps: int | None = None,
    gates: int | None = None,
    seed: int = 0,
) -> Study:
    """Whole races from around the track's start, with drawn constants, of one policy."""
    (entry,) = entries
    flights = fly_races(entry.policy, entry.race, runs, laps, gates, seed, str(entry.file))
    return race_table(flights), {"flights": [row.to_json() for row in flights]}


def random_tracks(
    entries: Sequence[Entry], report: Report, *, runs: int = 100, laps: int = 3
) -> Study:
    """A flight on each of several random tracks, which training has not seen, of one policy."""
    (entry,) = entries
    trained = entry.race.randomization.tracks or RandomTracks()
    tracks = trained.replace(seed=trained.seed + trained.count, count=runs)
    flown = fly_random_tracks(entry.policy, entry.race, tracks, laps, str(entry.file))
    return flown.table(), flown.to_json()


STUDIES: dict[str, Callable[..., Study]] = {
    "protocols": protocols,
    "spread": spread,
    "races": races,
    "random-tracks": random_tracks,
}
