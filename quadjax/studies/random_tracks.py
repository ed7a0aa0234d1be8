"""Flights of one policy on random tracks."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.limits import MAX_LAPS, check_integer
from quadjax.core.markdown import table
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import environment, episode, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.random_track import RandomTracks
from quadjax.race.track import Track


@dataclasses.dataclass(frozen=True)
class TrackFlights:
    """One flight on each of several random tracks.

    Attributes:
        tracks: their settings; track ``i`` has the seed ``tracks.seed + i``.
        lap: median (tracks,) of the laps after the first one, s; NaN where a flight did not finish.
        crashes: how each flight ended, empty if it finished.
    """

    tracks: RandomTracks
    lap: np.ndarray
    crashes: tuple[str, ...]

    @property
    def finished(self) -> int:
        """Number of flights that completed every lap."""
        return int(np.isfinite(self.lap).sum())

    def table(self) -> str:
        """Finished flights, their laps and the causes of the crashes, as Markdown."""
        causes = sorted({each for each in self.crashes if each})
        shown = ", ".join(f"{self.crashes.count(each)} {each}" for each in causes) or "-"
        done = self.lap[np.isfinite(self.lap)]
        lap = f"{np.median(done):.3f} s" if done.size else "-"
        last = self.tracks.seed + self.tracks.count - 1
        row = [f"{self.tracks.seed} to {last}", f"{self.finished} of {len(self.lap)}", lap, shown]
        return table([["seeds of the tracks", "finished", "median lap", "not finished"], row])

    def to_json(self) -> dict[str, Any]:
        """The numbers as JSON takes them: ``null`` where a flight did not finish."""
        lap = [round(float(x), 4) if math.isfinite(x) else None for x in self.lap]
        settings = self.tracks.model_dump(mode="json")
        return {"tracks": settings, "lap": lap, "crashes": list(self.crashes)}


def fly_random_tracks(
    policy: Policy, config: Config, tracks: RandomTracks, lap_count: int = 3, name: str = "policy"
) -> TrackFlights:
    """Fly the mean action once on each track, from hover, by the exact rules.

    Args:
        policy: the policy.
        config: of the race, whose track is replaced.
        tracks: their settings.
        lap_count: laps of a flight, at least 2.
        name: of the policy, for messages.

    Raises:
        InputError: the policy does not fit the race, there are no tracks with these settings, or
            ``lap_count`` is out of range.
    """
    check_integer("laps", lap_count, 2, MAX_LAPS)
    own = config.replace(randomization=config.randomization.replace(tracks=tracks))
    choices, params = pilot.fit_race(*race_of(own), policy, name)
    every = params.tracks
    assert every is not None
    params = environment.exact_rules(choices.model, params)
    each = [jax.tree.map(lambda x, i=i: x[i], every) for i in range(tracks.count)]
    longest = max(each, key=laps.lap_length)
    params = params.replace(track=longest)
    states = jax.vmap(lambda track: _hover(choices, params, track), out_axes=-1)(every)
    flown = pilot.make_pilot(choices, params, policy, deterministic=True)
    steps, key = laps.step_limit(params, lap_count), jax.random.key(0)
    race, _ = laps.fly_race(choices, pilot.fly, lap_count, steps, False, params, flown, states, key)
    result = laps.laps_of(
        choices, race, float(params.rules.time_step), laps.time_limit(longest, lap_count)
    )
    done = np.isfinite(result.totals)
    lap = np.median(result.lap_times[:, 1:], axis=1)
    return TrackFlights(tracks, np.where(done, lap, np.nan), result.crashes)


def _hover(choices: Choices, params: RaceParams, track: Track) -> RaceState:
    """Hover at the last gate of a track."""
    params = params.on_track(track)
    return episode.hover_start(choices, params).replace(track=track)
