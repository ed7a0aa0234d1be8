"""Random closed tracks of upright gates, reproducible from a seed.

Every condition of a track is a condition on distances in the horizontal plane: the length of a leg,
the turn at a gate (which gives the distance between the gates before and after it), and the room
for the frames. The generator draws lengths, turns and heights, and moves the gates until every
distance is allowed (position-based dynamics, Mueller et al. 2007). World NED, m, deg.
"""

import math
from typing import Annotated

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.sections import ORDERED, Field, Section, model_validator
from quadjax.core.yaml_files import Tree

Length = Annotated[float, Field(gt=0, le=1000)]
MAX_ATTEMPTS, MAX_ROUNDS = 40, 600
UNBOUNDED_M = 1e6  # no largest distance
MAX_COORDINATE_M = 1e4  # from the origin: positions are float32, whose step is 1 mm there
DRAW_MARGIN = 0.03  # m and fraction by which drawn values are inside the allowed ones
FRAMES_DEPTH_M = 0.2  # room for the depth of two frames
MAX_LEG_ANGLE_DEG = 85.0  # largest angle between a leg and the direction of its gate
LIMIT_MARGIN_M = 5.0  # from the outermost gate to the position limit


class RandomTrack(Section):
    """Settings of a random track."""

    seed: int = Field(0, ge=0, le=2**31 - 1, description="seed of all random numbers of the track")
    gates: int = Field(8, ge=3, le=100, description="number of gates")
    leg: Annotated[tuple[Length, Length], ORDERED] = Field(
        (3.0, 8.0), description="shortest and longest horizontal distance to the next gate, m"
    )
    turn_deg: float = Field(
        120.0, ge=1, le=170, description="largest turn between the legs before and after a gate"
    )
    leg_ratio: float | None = Field(
        None,
        ge=1.2,
        le=100,
        description="largest ratio of the legs of one track: its shortest leg is drawn first, "
        "uniformly in its logarithm; null: all legs are drawn from leg",
    )
    yaw_deg: float = Field(
        0.0,
        ge=0,
        le=80,
        description="largest angle between a gate and the mean of the directions to and from it; "
        f"both directions stay within {MAX_LEG_ANGLE_DEG:g} deg of the gate's",
    )
    height: Annotated[tuple[Length, Length], ORDERED] = Field(
        (1.2, 2.5), description="lowest and highest center of a gate above ground, m"
    )
    size: tuple[Length, Length] = Field(
        (1.5, 1.5), description="width and height of the openings, m"
    )
    frame: float = Field(
        0.3, ge=0, le=10, description="width of the frames, which do not touch each other, m"
    )

    @model_validator(mode="after")
    def _check(self) -> "RandomTrack":
        if self.leg_ratio is not None and self.leg[1] <= self.leg_ratio * self.leg[0]:
            raise ValueError(
                f"leg_ratio is {self.leg_ratio:g}, allowed with leg {list(self.leg)}: less than "
                "their ratio, or null"
            )
        outer = [side + 2.0 * self.frame for side in self.size]
        if self.height[0] < 0.5 * outer[1]:
            raise ValueError(
                f"height is {list(self.height)}, allowed: at least {0.5 * outer[1]:g}, half of the "
                "height of a gate with its frame"
            )
        if self.leg[1] < outer[0] + FRAMES_DEPTH_M:
            raise ValueError(
                f"leg is {list(self.leg)}, allowed: a longest of at least "
                f"{outer[0] + FRAMES_DEPTH_M:g}, the width of a gate with its frame"
            )
        return self


class RandomTracks(RandomTrack):
    """Settings of several random tracks with the same number of gates."""

    seed: int = Field(0, ge=0, le=2**30, description="seed of the first track; then one higher")
    count: int = Field(256, ge=1, le=4096, description="number of tracks")

    @property
    def each(self) -> list[RandomTrack]:
        """The settings of each track."""
        settings = self.model_dump(exclude={"count"})
        return [RandomTrack(**settings | {"seed": self.seed + i}) for i in range(self.count)]


def generate(track: RandomTrack) -> Tree:
    """The keys ``gates`` and ``rules`` of a random track, as in a track file.

    The center of the track is at the origin, and ``rules.position_limit`` has room around it.

    Raises:
        InputError: no track found with these settings, or one beyond ``MAX_COORDINATE_M``.
    """
    rng = np.random.default_rng(track.seed)
    for _ in range(MAX_ATTEMPTS):
        rng.integers(track.gates)  # unused; without it a seed would have another track
        places = np.round(_solve(rng, track), 2)
        if _allowed(track, places):
            gates = _gates(rng, track, places)
            limit = float(np.ceil(np.abs(places).max() + LIMIT_MARGIN_M))
            if limit > MAX_COORDINATE_M:
                raise InputError(
                    f"gates {track.gates} and leg {list(track.leg)} need a position_limit of "
                    f"{limit:g} m, allowed: at most {MAX_COORDINATE_M:g}"
                )
            return {"gates": gates, "rules": {"position_limit": limit}}
    raise InputError(
        f"found no track with gates {track.gates}, leg {list(track.leg)} and "
        f"turn_deg {track.turn_deg:g}, allowed: larger turn_deg, a wider range of leg, or fewer "
        "gates"
    )


def _solve(rng: np.random.Generator, track: RandomTrack) -> np.ndarray:
    """Places (n, 2) whose distances are near the allowed ones."""
    count, (short, long) = track.gates, track.leg
    shortest = max(short, _room(track))
    if track.leg_ratio is not None and long > track.leg_ratio * shortest:
        shortest *= (long / track.leg_ratio / shortest) ** rng.uniform()
        long = track.leg_ratio * shortest
    inside = min(DRAW_MARGIN, 0.25 * (long - shortest))
    legs = rng.uniform(shortest + inside, max(long - inside, shortest + inside), count)
    turns = rng.uniform(-track.turn_deg, track.turn_deg, count)
    heading = np.radians(np.cumsum(turns))
    steps = legs[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = np.cumsum(steps - steps.mean(axis=0), axis=0)
    low, high = _distances(track, legs)
    for _ in range(MAX_ROUNDS):
        apart = places[:, None] - places[None]
        distance = np.sqrt((apart**2).sum(axis=2)) + 1e-9
        wrong = np.clip(distance, low, high) - distance
        np.fill_diagonal(wrong, 0.0)
        if np.abs(wrong).max() < 0.1 * DRAW_MARGIN:
            break
        active = np.maximum((np.abs(wrong) > 1e-9).sum(axis=1), 1)
        moves = (0.5 * wrong / distance)[..., None] * apart
        places = places + 1.5 * moves.sum(axis=1) / active[:, None]
    return places - 0.5 * (places.max(axis=0) + places.min(axis=0))


def _room(track: RandomTrack) -> float:
    """Distance of two gates whose frames cannot touch in any direction, m."""
    return track.size[0] + 2.0 * track.frame + FRAMES_DEPTH_M


def _distances(track: RandomTrack, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest distance (n, n) of each two places, m; ``legs`` lead to each place."""
    count, turn = len(legs), math.radians(track.turn_deg) * (1.0 - DRAW_MARGIN)
    low = np.full((count, count), _room(track) + DRAW_MARGIN)
    high = np.full((count, count), UNBOUNDED_M)
    for index in range(count):
        before, after = index - 1, (index + 1) % count
        come, go = legs[index], legs[after]
        across = math.sqrt(come**2 + go**2 + 2.0 * come * go * math.cos(turn))
        low[before, after] = low[after, before] = max(across, low[before, after])
    for index in range(count):  # after the turns: of three places, every two follow each other
        for bound in (low, high):
            bound[index - 1, index] = bound[index, index - 1] = legs[index]
    return low, high


def _turns(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading (n,) of the leg to each place and the turn (n,) there, rad, within half a turn."""
    legs = places - np.roll(places, 1, axis=0)
    heading = np.arctan2(legs[:, 1], legs[:, 0])
    turn = np.roll(heading, -1) - heading
    return heading, (turn + np.pi) % (2.0 * np.pi) - np.pi


def _allowed(track: RandomTrack, places: np.ndarray) -> bool:
    """Whether places (n, 2) are a track."""
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    legs = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
    others = distance[~np.eye(len(places), dtype=bool)]
    _, turn = _turns(places)
    return bool(
        np.all((legs >= track.leg[0]) & (legs <= track.leg[1]))
        and np.all(others >= _room(track))
        and np.all(np.abs(turn) <= math.radians(track.turn_deg))
    )


def _gates(rng: np.random.Generator, track: RandomTrack, places: np.ndarray) -> list[Tree]:
    """The gates of places (n, 2): halfway between the headings before and after."""
    heading, turn = _turns(places)
    gates = []
    for (x, y), yaw, bend in zip(places, heading + 0.5 * turn, turn, strict=True):
        height = rng.uniform(*track.height)
        if track.yaw_deg:
            largest = min(
                track.yaw_deg, max(0.0, MAX_LEG_ANGLE_DEG - abs(math.degrees(0.5 * bend)))
            )
            yaw += math.radians(rng.uniform(-largest, largest))
        angle = (math.degrees(yaw) + 180.0) % 360.0 - 180.0
        gates.append(
            {
                "position": [float(x), float(y), -round(float(height), 2)],
                "yaw_deg": round(angle, 1) + 0.0,  # without the sign of zero
                "size": list(track.size),
            }
        )
    return gates
