"""Constants of the vehicle models from data that can be measured or looked up.

A first vehicle file for a drone that has no flight logs.
"""

import math
from typing import Annotated, Self

from quadjax.core.sections import Field, Section, Unit, model_validator

GRAVITY_M_S2 = 9.81
AIR_DENSITY = 1.225  # kg/m^3
Moment = Annotated[float, Field(gt=0, le=100)]
RAD_S_PER_RPM, RPM_PER_RAD_S = 2.0 * math.pi / 60.0, 30.0 / math.pi
SPREAD = 0.02  # of lengths that describe one frame
ALTERNATIVES = (  # of which one may be given
    ("thrust_to_weight", "max_thrust", "thrust_coefficient"),
    ("rpm_max", "motor_kv"),
    ("rpm_max", "battery_volts"),
)


class Airframe(Section):
    """Data of a quadcopter in X configuration; null: estimated from the other data.

    With the thrust coefficient ``T = mass k_w``, N/rpm^2, and the hover speed
    ``hover = sqrt(9.81 / (4 k_w))``, rpm, the constants of the motor model are

    ```text
    k_w          9.81 thrust_to_weight / (4 rpm_max^2) or max_thrust / (mass rpm_max^2)
                 or thrust_coefficient 1.225 D^4 / (3600 mass)
    k_p, k_q     T arm_y, T arm_x
    i_xx, i_yy   0.45 mass arm_y^2, 0.45 mass arm_x^2
    i_zz         0.45 mass (arm_x^2 + arm_y^2)
    k_r1, k_r2   2 torque_ratio T hover, rotor_inertia 2 pi / 60
    k_x, k_y     drag / (4 hover)
    ```

    ``k_z``, ``k_h``, ``k_pv``, ``k_qv`` and ``k_rr`` are zero: they need a fit. On the one drone
    checked, the Bebop 1, these rules are within a factor of two. The file's ``width`` is the
    distance of diagonally opposite motors, plus D.

    The constants of ``racing`` are these, per rad/s in place of rpm, with moments over ``i_xx``,
    ``i_yy``, ``i_zz``. Those of ``rate`` are

    ```text
    d_x, d_y                drag
    tau_rate, tau_thrust    tau
    thrust_min, thrust_max  4 k_w rpm_min^2, the mean of 9.81 and 4 k_w rpm_max^2
    p_max, q_max            tau (k_p / i_xx, k_q / i_yy) (rpm_max^2 - rpm_min^2)
    r_max                   (tau k_r1 + k_r2) (rpm_max - rpm_min) / i_zz
    ```

    At ``thrust_max`` the motors can still turn the drone, and the reversal of a rate needs no
    more than their largest angular acceleration.
    """

    mass: Annotated[float, Unit("kg")] = Field(gt=0, le=100, description="ready to fly, kg")
    wheelbase: Annotated[float | None, Unit("m")] = Field(
        None, gt=0, le=10, description="distance of diagonally opposite motors, m; 2 arm"
    )
    arm: Annotated[float | None, Unit("m")] = Field(
        None, gt=0, le=5, description="from the center of gravity to a motor, m; wheelbase / 2"
    )
    arm_x: Annotated[float | None, Unit("m")] = Field(
        None, gt=0, le=5, description="motor ahead of the center of gravity, m; 0.71 arm"
    )
    arm_y: Annotated[float | None, Unit("m")] = Field(
        None, gt=0, le=5, description="motor to the right of the center of gravity, m; 0.71 arm"
    )
    propeller: Annotated[float, Unit("m")] = Field(
        gt=0, le=2, description="diameter of a propeller, m"
    )
    rpm_max: Annotated[float | None, Unit("rpm")] = Field(
        None, gt=0, le=1e6, description="speed at full throttle; 0.7 motor_kv battery_volts"
    )
    rpm_min: Annotated[float | None, Unit("rpm")] = Field(
        None, ge=0, le=1e6, description="idle speed when armed; 0.12 rpm_max"
    )
    motor_kv: Annotated[float | None, Unit("rpm/V")] = Field(
        None, gt=0, le=1e5, description="rpm per V"
    )
    battery_volts: Annotated[float | None, Unit("V")] = Field(
        None, gt=0, le=1000, description="nominal voltage, V"
    )
    thrust_to_weight: float | None = Field(
        None, gt=1, le=100, description="thrust of all four motors at rpm_max over weight"
    )
    max_thrust: Annotated[float | None, Unit("N")] = Field(
        None, gt=0, le=1000, description="thrust of one motor at rpm_max, N (1 kgf is 9.81 N)"
    )
    thrust_coefficient: float | None = Field(
        None, gt=0, le=1, description="C_T of T = C_T rho n^2 D^4; 0.13 without the two above"
    )
    torque_ratio: Annotated[float | None, Unit("m")] = Field(
        None, gt=0, le=1, description="torque over thrust of a propeller, m; 0.1 propeller"
    )
    rotor_inertia: Annotated[float | None, Unit("kg m^2")] = Field(
        None, gt=0, le=1, description="inertia of propeller and rotor, kg m^2; 0.02 propeller^4"
    )
    inertia: Annotated[tuple[Moment, Moment, Moment] | None, Unit("kg m^2")] = Field(
        None,
        description="inertia about x, y, z, kg m^2; 0.45 mass times the motors' squared distance",
    )
    drag: Annotated[float, Unit("1/s")] = Field(
        0.3, ge=0, le=10, description="linear drag over mass, 1/s"
    )
    tau: Annotated[float, Unit("s")] = Field(
        0.03, gt=0, le=1, description="time constant of motor and controller, s"
    )
    motor_map: float = Field(
        0.84, ge=0, le=1, description="k of racing; 1: speed is linear in the command, 0: thrust is"
    )

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        for names in ALTERNATIVES:
            if len(given := [name for name in names if getattr(self, name) is not None]) > 1:
                both = " and ".join(f"{name} is {getattr(self, name):g}" for name in given[:2])
                raise ValueError(f"{both}, allowed: one of them")
        if self.rpm_max is None and (self.motor_kv is None or self.battery_volts is None):
            raise ValueError("rpm_max is null, allowed: a number, or motor_kv and battery_volts")
        return self

    @model_validator(mode="after")
    def _check_frame(self) -> Self:
        sizes = {"arm": self.arm, "wheelbase": self.wheelbase and 0.5 * self.wheelbase}
        if self.arm_x and self.arm_y:
            sizes["arm_x and arm_y"] = math.hypot(self.arm_x, self.arm_y)
        known = {name: size for name, size in sizes.items() if size}
        if not known:
            raise ValueError("wheelbase is null, allowed: a number, or arm, or arm_x and arm_y")
        (name, half), *others = known.items()
        for other, size in others:
            if abs(size / half - 1.0) > SPREAD:
                value = getattr(self, name)
                raise ValueError(
                    f"{name} is {value:g}, but by {other} a motor is {size:.4g} m from the center "
                    f"of gravity, allowed: {size * value / half:.4g}"
                )
        for name in ("arm_x", "arm_y"):
            if (length := getattr(self, name)) and length >= half * (1.0 + SPREAD):
                raise ValueError(f"{name} is {length:g}, allowed: below arm, {half:.4g}")
        if self.propeller > 2.0 * min(self.arms):
            raise ValueError(
                f"propeller is {self.propeller:g}, allowed: a diameter up to "
                f"{2.0 * min(self.arms):.4g} m, the distance of adjacent motors"
            )
        return self

    @model_validator(mode="after")
    def _check_hover(self) -> Self:
        c = self.motor_constants()
        hover = math.sqrt(c["g"] / (4.0 * c["k_w"]))
        if not c["rpm_min"] < hover < c["rpm_max"]:
            raise ValueError(
                f"the hover speed is {hover:.0f} rpm, allowed: rpm_min {c['rpm_min']:.0f}"
                f" to rpm_max {c['rpm_max']:.0f}"
            )
        return self

    @property
    def arms(self) -> tuple[float, float]:
        """A motor's distance ahead and to the right of the center of gravity, m."""
        half = self.arm or 0.5 * (self.wheelbase or 0.0)
        if not self.arm_x and not self.arm_y:
            return half / math.sqrt(2.0), half / math.sqrt(2.0)
        rest = math.sqrt(max(half**2 - (self.arm_x or self.arm_y or 0.0) ** 2, 0.0))
        return self.arm_x or rest, self.arm_y or rest

    @property
    def width(self) -> float:
        """From tip to tip of diagonally opposite propellers, m.

        A drone passes a gate with any yaw and roll; half of this is the radius of its sphere.
        """
        return 2.0 * math.hypot(*self.arms) + self.propeller

    def constants(self) -> dict[str, dict[str, float]]:
        """The constants of each model by name, in its units."""
        motor = self.motor_constants()
        return {"motor": motor, "racing": self._racing(motor), "rate": self._rate(motor)}

    def motor_constants(self) -> dict[str, float]:
        """The constants of the motor model by name, in its units."""
        mass, diameter = self.mass, self.propeller
        x, y = self.arms
        rpm_max = self.rpm_max or 0.7 * (self.motor_kv or 0.0) * (self.battery_volts or 0.0)
        if self.thrust_to_weight is not None:
            thrust = mass * GRAVITY_M_S2 * self.thrust_to_weight / (4.0 * rpm_max**2)  # N/rpm^2
        elif self.max_thrust is not None:
            thrust = self.max_thrust / rpm_max**2
        else:
            thrust = (self.thrust_coefficient or 0.13) * AIR_DENSITY * diameter**4 / 3600.0
        hover = math.sqrt(mass * GRAVITY_M_S2 / (4.0 * thrust))  # rpm
        inertia = self.inertia or tuple(0.45 * mass * d for d in (y * y, x * x, x * x + y * y))
        torque = (self.torque_ratio or 0.1 * diameter) * thrust
        drag = self.drag / (4.0 * hover)
        return {
            "g": GRAVITY_M_S2,
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
            "k_r2": RAD_S_PER_RPM * (self.rotor_inertia or 0.02 * diameter**4),
            "k_rr": 0.0,
            "tau": self.tau,
            "rpm_min": 0.12 * rpm_max if self.rpm_min is None else self.rpm_min,
            "rpm_max": rpm_max,
        }

    def _racing(self, c: dict[str, float]) -> dict[str, float]:
        """The constants of ``racing`` for the same forces and moments as those of the motor model.

        Motors 2 and 4 turn counter-clockwise, so that the yaw moment of the two models is one.
        """
        moments = {
            "k_p": c["k_p"] / (RAD_S_PER_RPM**2 * c["i_xx"]),
            "k_q": c["k_q"] / (RAD_S_PER_RPM**2 * c["i_yy"]),
            "k_r": c["k_r1"] / (RAD_S_PER_RPM * c["i_zz"]),
            "k_rd": c["k_r2"] / (RAD_S_PER_RPM * c["i_zz"]),
        }
        turning = {f"turning{rotor}": (-1.0) ** rotor for rotor in (1, 2, 3, 4)}
        return {
            "g": c["g"],
            "k_w": c["k_w"] / RAD_S_PER_RPM**2,
            "k_x": c["k_x"] / RAD_S_PER_RPM,
            "k_y": c["k_y"] / RAD_S_PER_RPM,
            **{f"{name}{rotor}": x for name, x in moments.items() for rotor in (1, 2, 3, 4)},
            **turning,
            "w_min": c["rpm_min"] * RAD_S_PER_RPM,
            "w_max": c["rpm_max"] * RAD_S_PER_RPM,
            "k": self.motor_map,
            "tau": c["tau"],
        }

    def _rate(self, c: dict[str, float]) -> dict[str, float]:
        """The constants of ``rate``, of an inner loop that the motors of the model can follow."""
        squares, range_ = c["rpm_max"] ** 2 - c["rpm_min"] ** 2, c["rpm_max"] - c["rpm_min"]
        return {
            "g": c["g"],
            "d_x": self.drag,
            "d_y": self.drag,
            "tau_rate": c["tau"],
            "tau_thrust": c["tau"],
            "p_max": c["tau"] * c["k_p"] * squares / c["i_xx"],
            "q_max": c["tau"] * c["k_q"] * squares / c["i_yy"],
            "r_max": (c["tau"] * c["k_r1"] + c["k_r2"]) * range_ / c["i_zz"],
            "thrust_min": 4.0 * c["k_w"] * c["rpm_min"] ** 2,
            "thrust_max": 0.5 * c["g"] + 2.0 * c["k_w"] * c["rpm_max"] ** 2,
        }
