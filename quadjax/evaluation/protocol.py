"""How flights are flown: start, length, number, seed, actions, plants and tracks."""

import dataclasses
from typing import Self, TypedDict, get_args

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.sections import MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED, check_integer
from quadjax.evaluation.conditions import Condition, Conditions, Start
from quadjax.race.random_track import RandomTracks

MAX_TRACKS, MAX_PLANTS = 4096, 1000


class Length(TypedDict):
    """How long a flight is: one of them, or none."""

    laps: int | None
    gates: int | None
    seconds: float | None


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
        length: Length,
        runs: int | None = None,
        seed: int = 0,
        plants: int | None = None,
        tracks: RandomTracks | int | None = None,
    ) -> Self:
        """The arguments of ``evaluate``, then what the conditions say, then the config.

        Raises:
            InputError: a number out of range, or arguments that exclude each other.
        """
        named = [key for key, value in length.items() if value is not None]
        if len(named) > 1:
            raise InputError(f"{named[1]} is not null, allowed: one of {', '.join(length)}")
        if not named:
            length = {"laps": listed.laps, "gates": listed.gates, "seconds": listed.seconds}
        laps, gates = length["laps"], length["gates"]
        if laps is None and length["seconds"] is None:
            gates = config.evaluate.gates if gates is None else gates
        if tracks is not None and runs is not None:
            raise InputError(f"runs is {runs}, allowed: null with tracks")
        count = listed.runs if runs is None else runs
        count = config.evaluate.runs if count is None else count
        if listed.tracks and tracks is None:
            tracks = count
        if isinstance(tracks, int):
            check_integer("tracks", tracks, 1, MAX_TRACKS)
            trained = config.randomization.tracks or RandomTracks()
            tracks = trained.replace(seed=trained.seed + trained.count, count=tracks)
        return cls(
            start=listed.start or "hover",
            deterministic=bool(listed.deterministic),
            runs=count if tracks is None else tracks.count,
            laps=config.evaluate.laps if laps is None else laps,
            gates=gates,
            seconds=length["seconds"],
            seed=seed,
            plants=listed.plants if plants is None else plants,
            tracks=tracks,
            drawn=listed.drawn,
            speeds=listed.speeds,
        )

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        check_integer("laps", self.laps, 1 if self.tracks is None else 2, MAX_LAPS)
        check_integer("gates", 1 if self.gates is None else self.gates, 1, MAX_GATES)
        check_integer("runs", self.runs, 1, MAX_RUNS)
        check_integer("seed", self.seed, 0, MAX_SEED)
        check_integer("plants", self.plants, 1, MAX_PLANTS)
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
