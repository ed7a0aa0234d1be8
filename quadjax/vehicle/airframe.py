"""Constants of the motor model from data that can be measured or looked up.

A first vehicle file for a drone that has no flight logs.
"""

import math
from typing import Annotated, Self

from quadjax.core.sections import Field, Section, model_validator

GRAVITY = 9.81  # m/s^2
AIR = 1.225  # kg/m^3
Moment = Annotated[float, Field(gt=0, le=100)]
RPM = 2.0 * math.pi / 60.0  # rad/s


class Airframe(Section):
    """Data of a quadcopter in X configuration; null: estimated from the other data.

    With the thrust coefficient ``T = mass k_w``, N/rpm^2, and the hover speed
    ``hover = sqrt(9.81 / (4 k_w))``, rpm, the constants of the motor model are

    ```text
    k_w          9.81 thrust_to_weight / (4 rpm_max^2)
                 or thrust_coefficient 1.225 D^4 / (3600 mass)
    k_p, k_q     T arm_y, T arm_x
    i_xx, i_yy   0.45 mass arm_y^2, 0.45 mass arm_x^2
    i_zz         0.45 mass (arm_x^2 + arm_y^2)
    k_r1, k_r2   2 torque_ratio T hover, rotor_inertia 2 pi / 60
    k_x, k_y     drag / (4 hover)
    ```

    ``k_z``, ``k_h``, ``k_pv``, ``k_qv`` and ``k_rr`` are zero: they need a fit. On the one drone
    checked, the Bebop 1, these rules are within a factor of two. The file's ``width`` is
    ``wheelbase / 1.41 + D``.
    """

    mass: float = Field(gt=0, le=100, description="ready to fly, kg")
    wheelbase: float = Field(gt=0, le=10, description="distance of diagonally opposite motors, m")
    arm_x: float | None = Field(
        None, gt=0, le=10, description="motor ahead of the center of gravity, m; wheelbase / 2.83"
    )
    arm_y: float | None = Field(
        None,
        gt=0,
        le=10,
        description="motor to the right of the center of gravity, m; wheelbase / 2.83",
    )
    propeller: float = Field(gt=0, le=2, description="diameter of a propeller, m")
    rpm_max: float | None = Field(
        None, gt=0, le=1e6, description="speed at full throttle; 0.7 motor_kv battery_volts"
    )
    rpm_min: float | None = Field(
        None, ge=0, le=1e6, description="idle speed when armed; 0.12 rpm_max"
    )
    motor_kv: float | None = Field(None, gt=0, le=1e5, description="rpm per V")
    battery_volts: float | None = Field(None, gt=0, le=1000, description="nominal voltage, V")
    thrust_to_weight: float | None = Field(
        None,
        gt=1,
        le=100,
        description="thrust of all four motors at rpm_max over weight; from thrust_coefficient",
    )
    thrust_coefficient: float = Field(
        0.13, gt=0, le=1, description="C_T of T = C_T rho n^2 D^4; unused with thrust_to_weight"
    )
    torque_ratio: float | None = Field(
        None, gt=0, le=1, description="torque over thrust of a propeller, m; 0.1 propeller"
    )
    rotor_inertia: float | None = Field(
        None, gt=0, le=1, description="inertia of propeller and rotor, kg m^2; 0.02 propeller^4"
    )
    inertia: tuple[Moment, Moment, Moment] | None = Field(
        None,
        description="inertia about x, y, z, kg m^2; 0.45 mass times the motors' squared distance",
    )
    drag: float = Field(0.3, ge=0, le=10, description="linear drag over mass, 1/s")
    tau: float = Field(0.03, gt=0, le=1, description="time constant of motor and controller, s")

    @model_validator(mode="after")
    def _check_hover(self) -> Self:
        if self.rpm_max is None and (self.motor_kv is None or self.battery_volts is None):
            raise ValueError("rpm_max is null, allowed: a number, or motor_kv and battery_volts")
        c = self.motor_constants()
        hover = math.sqrt(c["g"] / (4.0 * c["k_w"]))
        if not c["rpm_min"] < hover < c["rpm_max"]:
            raise ValueError(
                f"the hover speed is {hover:.0f} rpm, allowed: rpm_min {c['rpm_min']:.0f}"
                f" to rpm_max {c['rpm_max']:.0f}"
            )
        return self

    @property
    def width(self) -> float:
        """From edge to edge of the propellers, m."""
        return self.wheelbase / math.sqrt(2.0) + self.propeller

    def motor_constants(self) -> dict[str, float]:
        """The constants of the motor model by name, in its units."""
        mass, diameter = self.mass, self.propeller
        x = self.arm_x or self.wheelbase / math.sqrt(8.0)
        y = self.arm_y or self.wheelbase / math.sqrt(8.0)
        rpm_max = self.rpm_max or 0.7 * (self.motor_kv or 0.0) * (self.battery_volts or 0.0)
        if self.thrust_to_weight is None:
            thrust = self.thrust_coefficient * AIR * diameter**4 / 3600.0  # N/rpm^2
        else:
            thrust = mass * GRAVITY * self.thrust_to_weight / (4.0 * rpm_max**2)
        hover = math.sqrt(mass * GRAVITY / (4.0 * thrust))  # rpm
        inertia = self.inertia or tuple(0.45 * mass * d for d in (y * y, x * x, x * x + y * y))
        torque = (self.torque_ratio or 0.1 * diameter) * thrust
        drag = self.drag / (4.0 * hover)
        return {
            "g": GRAVITY,
            **dict(zip(("i_xx", "i_yy", "i_zz"), inertia, strict=True)),
            "k_x": drag,
            "k_y": drag,
            "k_z": 0.0,
            "k_w": thrust / mass,
            "k_h": 0.0,
            "k_p": thrust * y,
            "k_q": thrust * x,
            "k_pv": 0.0,
            "k_qv": 0.0,
            "k_r1": 2.0 * torque * hover,
            "k_r2": RPM * (self.rotor_inertia or 0.02 * diameter**4),
            "k_rr": 0.0,
            "tau": self.tau,
            "rpm_min": 0.12 * rpm_max if self.rpm_min is None else self.rpm_min,
            "rpm_max": rpm_max,
        }
