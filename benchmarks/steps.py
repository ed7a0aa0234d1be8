"""The trainings of tournament and interventions, by the name of contender or step."""

from typing import NamedTuple

PRESETS = {  # of the tournament
    "E2E": "e2e_cyberzoo",
    "INDI": "indi_cyberzoo",
    "E2E by PPO": "benchmarks/e2e_cyberzoo_ppo.yaml",
    "INDI by PPO": "benchmarks/indi_cyberzoo_ppo.yaml",
}
FAST = tuple(f"vehicle.constants.{rate}_max={6 if rate != 'r' else 4}" for rate in "pqr")
MOTORS = "benchmarks/indi_inner_loop.yaml"  # INDI, trained on the motors through its loop


class Step(NamedTuple):
    """What is trained, and what is changed in the training and on the plant."""

    preset: str
    training: tuple[str, ...] = ()
    plant: tuple[str, ...] = ()


def _thrust(limit: int) -> tuple[str, ...]:
    return (f"vehicle.constants.thrust_max={limit}",)


YAW = ("indi_simple.yaw_rate=4",)  # of the inner loop
ALLOCATIONS = {
    "no priorities": ("indi_simple.saturation=clip",),
    "model effectiveness": (
        "indi_simple.effectiveness=null",
        "indi_simple.thrust_gain=null",
    ),
}
STEPS = {
    **{f"INDI, {limit} m/s^2": Step("indi_cyberzoo", _thrust(limit)) for limit in range(13, 21)},
    **{
        f"INDI, {limit} m/s^2, {label}": Step("indi_cyberzoo", _thrust(limit), words)
        for limit in (17, 20)
        for label, words in ALLOCATIONS.items()
    },
    "INDI, 20 m/s^2, 6 rad/s": Step("indi_cyberzoo", (*_thrust(20), *FAST), YAW),
    "INDI, 20 m/s^2, 6 rad/s, filters of 20 Hz": Step(
        "indi_cyberzoo", (*_thrust(20), *FAST), ("indi_simple.cutoff=20", *YAW)
    ),
    "INDI on the motors, 17 m/s^2": Step(MOTORS),
    "INDI on the motors, 20 m/s^2": Step(MOTORS, _thrust(20)),
    "INDI on the motors, 20 m/s^2, 6 rad/s": Step(MOTORS, (*_thrust(20), *FAST), YAW),
    **{
        f"E2E, {speed} rpm": Step("e2e_cyberzoo", (f"vehicle.constants.rpm_max={speed}",))
        for speed in (10300, 11000, 12000)
    },
}
WITHOUT = {
    "E2E, estimate not observed": Step("e2e_cyberzoo", ("observation.disturbance=none",)),
    "E2E, no delay": Step("e2e_cyberzoo", ("vehicle.delay=null",)),
    "E2E, no battery": Step("e2e_cyberzoo", ("battery=null", "observation.highest_rpm=estimated")),
    "E2E, highest speed observed": Step("e2e_cyberzoo", ("observation.highest_rpm=estimated",)),
    "E2E, lag drawn": Step("e2e_cyberzoo", ("randomization.constants={tau: 0.3}",)),
}
PARTS = ("E2E, 12000 rpm", *WITHOUT)  # of E2E
OBSERVED = ("observation.highest_rpm=estimated",)
TRAINED = {  # for a battery that gets empty
    "E2E": ("vehicle.constants.rpm_max=12000",),
    "E2E, highest speed observed": OBSERVED,
    "E2E, highest speed observed, low charges": (*OBSERVED, "battery.charge=[0.1, 1.0]"),
}
CHARGED = {
    f"{label}, charge {charge}": Step(
        "e2e_cyberzoo", words, (f"battery.charge=[{charge}, {charge}]",)
    )
    for label, words in TRAINED.items()
    for charge in (1.0, 0.2)
}
ALL = STEPS | WITHOUT | CHARGED
CHANGES = (  # steps from INDI to E2E, and back
    ("INDI, 17 m/s^2", "INDI, 20 m/s^2"),
    *(
        (f"INDI, {limit} m/s^2", f"INDI, {limit} m/s^2, {label}")
        for limit in (17, 20)
        for label in ALLOCATIONS
    ),
    ("INDI, 17 m/s^2", "INDI on the motors, 17 m/s^2"),
    ("INDI on the motors, 17 m/s^2", "INDI on the motors, 20 m/s^2"),
    ("INDI on the motors, 20 m/s^2", "INDI on the motors, 20 m/s^2, 6 rad/s"),
    ("INDI on the motors, 20 m/s^2", "E2E, 12000 rpm"),
    ("E2E, 12000 rpm", "E2E, 11000 rpm"),
    ("E2E, 11000 rpm", "E2E, 10300 rpm"),
)
