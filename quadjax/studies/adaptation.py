"""Policies on drones that differ from the model, with and without the disturbance estimate.

The simulated drone is changed; the onboard model of the estimator is that of training. A policy
observes the estimate, or zeros in its place. It is compared with a policy that was trained without
disturbances.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from quadjax.config.race import build_vehicle, race_of
from quadjax.config.schema import Config
from quadjax.core.markdown import table
from quadjax.core.vectors import Rotors, Vec3
from quadjax.evaluation.protocols import cell, note, numbers
from quadjax.policy.file import Policy
from quadjax.policy.pilot import fly_policy
from quadjax.race.laps import Laps
from quadjax.vehicle import motor
from quadjax.vehicle.estimator import estimator_params
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.rigid_body import BodyState

# What the policy observes, by column; zeros are also what ``without`` observed in training.
COLUMNS = {"without": "none", "zeros": "none", "estimated": "estimated"}
PROTOCOLS = ("mean", "sampled")


@dataclasses.dataclass(frozen=True)
class Damaged(motor.Motor):
    """The motor-level model of a drone that is damaged or unbalanced.

    A rotor of thrust factor f has the forces and moments that one without damage has at
    ``sqrt(f)`` times its speed. The measured speeds are the true ones. A shift c of the center of
    mass adds the moment ``-c x m F`` of the specific force F.

    Attributes:
        rotors: thrust factor of each of the four rotors, above 0.
        imbalance: mass times shift of the center of mass along body x and y, kg m.
    """

    rotors: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    imbalance: tuple[float, float] = (0.0, 0.0)

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and moment, N m, body."""
        slow = Rotors(*(factor**0.5 for factor in self.rotors))
        speeds = {"actuators": body.actuators * slow, "actuator_rate": body.actuator_rate * slow}
        force, moment = super().force_moment(params, body.replace(**speeds))
        x, y = self.imbalance
        return force, moment + Vec3(-y * force.z, x * force.z, y * force.x - x * force.y)


@dataclasses.dataclass(frozen=True)
class Condition:
    """How the simulated drone differs from the model.

    Attributes:
        label: one line.
        moment: steady external moment, N m, body.
        thrust: factor on the thrust of all rotors.
        residual: factor on the residual.
        rotors: factor on the thrust of each rotor.
        imbalance: mass times shift of the center of mass along body x and y, kg m.
    """

    label: str
    moment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust: float = 1.0
    residual: float = 1.0
    rotors: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    imbalance: tuple[float, float] = (0.0, 0.0)

    def race(self, config: Config) -> Config:
        """The race with the simulated drone of the condition, without its damage."""
        vehicle, drone = config.vehicle, {}
        if self.thrust != 1.0:
            drone["mismatch"] = vehicle.mismatch | {"k_w": self.thrust}
        gain = vehicle.residual_gain * self.residual
        drone |= {"residual": None} if gain == 0 else {"residual_gain": gain}
        moment = {"moment_bias": self.moment}
        return config.replace(
            vehicle=vehicle.replace(**drone), disturbance=config.disturbance.replace(**moment)
        )


CONDITIONS = (
    Condition("as modeled"),
    Condition("4% less thrust", thrust=0.96),
    Condition("8% less thrust", thrust=0.92),
    Condition("no residual", residual=0.0),
    Condition("twice the residual", residual=2.0),
    Condition("roll moment +0.03 N m", (0.03, 0.0, 0.0)),
    Condition("roll moment -0.03 N m", (-0.03, 0.0, 0.0)),
    Condition("pitch moment +0.03 N m", (0.0, 0.03, 0.0)),
    Condition("pitch moment -0.03 N m", (0.0, -0.03, 0.0)),
    Condition("yaw moment +0.01 N m", (0.0, 0.0, 0.01)),
    Condition("yaw moment -0.01 N m", (0.0, 0.0, -0.01)),
    Condition("all three, positive", (0.03, 0.03, 0.01)),
    Condition("all three, negative", (-0.03, -0.03, -0.01)),
    *(
        Condition(f"rotor {i + 1}: 15% less thrust", rotors=(*(1.0,) * i, 0.85, *(1.0,) * (3 - i)))
        for i in range(4)
    ),
    Condition("mass shifted, 1 g m forward", imbalance=(1e-3, 0.0)),
    Condition("mass shifted, 1 g m to the right", imbalance=(0.0, 1e-3)),
)


def fly_condition(
    config: Config,
    condition: Condition,
    policy: Policy,
    source: str,
    deterministic: bool,
    runs: int = 100,
    seed: int = 0,
) -> Laps:
    """Flights from hover on a drone that differs from its model.

    Args:
        config: of the race as modeled; its vehicle is the onboard model.
        condition: of the simulated drone.
        policy: for the model ``motor``.
        source: of the observed disturbance, "estimated" or "none" (zeros).
        deterministic: fly the mean action rather than samples.
        runs: number of flights.
        seed: of the noise and the disturbances that the race draws.
    """
    config = config.at("observation.disturbance", source)
    choices, params = race_of(condition.race(config))
    if condition.rotors != (1.0,) * 4 or condition.imbalance != (0.0, 0.0):
        model = Damaged(disturbed=True, rotors=condition.rotors, imbalance=condition.imbalance)
        choices = dataclasses.replace(choices, model=model)
    if params.estimator is not None:
        onboard = estimator_params(
            motor.MODEL,
            build_vehicle(config),
            1.0 / config.rules.time_step,
            explicit_euler=config.vehicle.integrator == "euler",
        )
        params = params.replace(estimator=onboard)
    laps, _ = fly_policy(choices, params, policy, runs=runs, seed=seed, deterministic=deterministic)
    return laps


@dataclasses.dataclass(frozen=True)
class Row:
    """Flights on one drone: ``Laps`` by (column of ``COLUMNS``, "mean" or "sampled")."""

    condition: Condition
    laps: dict[tuple[str, str], Laps]


@dataclasses.dataclass(frozen=True)
class Study:
    """Flights of two policies on drones that differ from their model.

    Attributes:
        race: as modeled.
        adaptive: the policy that observes the disturbance.
        without: the policy that was trained without disturbances.
        runs: number of flights of each kind.
        seed: of the noise.
    """

    race: Config
    adaptive: Policy
    without: Policy
    runs: int = 100
    seed: int = 0

    def fly(self, condition: Condition) -> Row:
        """All flights on one drone."""
        flown = {}
        for column, source in COLUMNS.items():
            policy = self.without if column == "without" else self.adaptive
            for how in PROTOCOLS:
                flown[column, how] = fly_condition(
                    self.race, condition, policy, source, how == "mean", self.runs, self.seed
                )
        return Row(condition, flown)


def format_rows(rows: Sequence[Row]) -> str:
    """A Markdown table, one line per drone: time of all laps, and flights that finish."""
    keys = list(rows[0].laps)
    titles = ["drone", *(", ".join(key) for key in keys)]
    cells = [[row.condition.label, *(cell(row.laps[key]) for key in keys)] for row in rows]
    return f"{table([titles, *cells])}\n\n{note(rows[0].laps[keys[0]])}"


def to_json(row: Row) -> dict[str, Any]:
    """A row as JSON takes it."""
    flights = {", ".join(key): numbers(laps) for key, laps in row.laps.items()}
    return {"drone": dataclasses.asdict(row.condition), "flights": flights}
