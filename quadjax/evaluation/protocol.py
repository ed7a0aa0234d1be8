"""How flights are flown: start, length, number, seed, actions, plants and tracks."""

import dataclasses
from typing import Any, Self, get_args

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.limits import MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED, check_integer
from quadjax.evaluation.conditions import Condition, Conditions, Start
from quadjax.race.random_track import RandomTracks

LENGTHS = ("laps", "gates", "seconds")


@dataclasses.dataclass(frozen=True)
class Protocol:
    """How flights are flown; see ``quadjax.evaluate``.

    Attributes:
        start: of the flights.
        deterministic: mean actions rather than samples.
        runs: number of flights.
        laps: of a flight.
        gates: of a flight, in place of laps.
        seconds: of a flight, in place of laps.
        seed: of starts, noise and disturbances.
        plants: number of drawn plants, which share the flights.
        tracks: random tracks, one for each flight.
        drawn: constants are drawn as ``randomization`` says, also where that draws none.
        speeds: speeds are recorded.
    """

    start: Start
    deterministic: bool
    runs: int
    laps: int
    gates: int | None
    seconds: float | None
    seed: int
    plants: int
    tracks: RandomTracks | None
    drawn: bool
    speeds: bool

    @classmethod
    def of(
        cls,
        config: Config,
        listed: Conditions,
        *,
        runs: int | None,
        laps: int | None,
        gates: int | None,
        seconds: float | None,
        seed: int,
        plants: int | None,
        tracks: RandomTracks | int | None,
    ) -> Self:
        """The arguments of ``evaluate``, then what the conditions say, then the config.

        Raises:
            InputError: a number out of range, or arguments that exclude each other.
        """
        length: dict[str, Any] = {"laps": laps, "gates": gates, "seconds": seconds}
        named = [key for key, value in length.items() if value is not None]
        if len(named) > 1:
            raise InputError(f"{named[1]} is {length[named[1]]}, allowed: null with {named[0]}")
        if not named:
            length = {key: getattr(listed, key) for key in LENGTHS}
        if all(value is None for value in length.values()):
            length["gates"] = config.evaluate.gates
        length["laps"] = config.evaluate.laps if length["laps"] is None else length["laps"]
        count = listed.runs if runs is None else runs
        if listed.tracks and tracks is None:
            tracks = 100 if count is None else count
        if isinstance(tracks, int):
            check_integer("tracks", tracks, 1, 4096)
            trained = config.randomization.tracks or RandomTracks()
            tracks = trained.replace(seed=trained.seed + trained.count, count=tracks)
        if tracks is not None:
            count = tracks.count
        return cls(
            start=listed.start,
            deterministic=bool(listed.deterministic),
            runs=config.evaluate.runs if count is None else count,
            seed=seed,
            plants=listed.plants if plants is None else plants,
            tracks=tracks,
            drawn=listed.drawn,
            speeds=listed.speeds,
            **length,
        )

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        check_integer("laps", self.laps, 1 if self.tracks is None else 2, MAX_LAPS)
        check_integer("gates", 1 if self.gates is None else self.gates, 1, MAX_GATES)
        check_integer("runs", self.runs, 1, MAX_RUNS)
        check_integer("seed", self.seed, 0, MAX_SEED)
        check_integer("plants", self.plants, 1, 1000)
        if self.seconds is not None and not 0.0 < self.seconds <= 1e4:
            raise InputError(f"seconds is {self.seconds}, allowed: above 0 and at most 10000")
        if self.start not in get_args(Start):
            raise InputError(f"start is {self.start}, allowed: {', '.join(get_args(Start))}")
        if self.runs % self.plants:
            raise InputError(f"runs is {self.runs}, allowed: multiples of plants ({self.plants})")
        if self.tracks is not None and self.start != "hover":
            raise InputError(f"start is {self.start}, allowed: hover on random tracks")

    @property
    def plain(self) -> bool:
        """Whether all flights are of whole laps or gates on the track of the race."""
        return self.tracks is None and self.seconds is None

    def under(self, condition: Condition) -> Self:
        """The protocol with what a condition says."""
        actions = condition.deterministic
        return dataclasses.replace(
            self,
            start=condition.start or self.start,
            deterministic=self.deterministic if actions is None else actions,
            seed=self.seed + condition.seed,
        )
