"""What is trained for, and flown in, the comparison of ``benchmarks.betaflight``."""

DRONES = ("5inch", "3inch")
RACE = ("track=figure8_tudelft", "reward.gate_edge_margin=0.2", "run.steps=5000000")
PUBLISHED = {"tau_rate": 0.03, "tau_thrust": 0.03, "d_x": 0.34, "d_y": 0.43}  # of the Bebop 1
INDI, E2E = ("indi_race", "vehicle={}_betaflight", *RACE), ("e2e_race", "vehicle={}", *RACE)
CONTENDERS = {  # preset and overrides of a drone
    "INDI, published lags": (*INDI, *(f"vehicle.constants.{k}={x}" for k, x in PUBLISHED.items())),
    "INDI, measured lags": INDI,
    "INDI, 50 m/s^2": (*INDI, "vehicle.constants.thrust_max=50"),
    "E2E": E2E,
}


def config(contender: str, drone: str) -> list[str]:
    """Preset and overrides of a training."""
    return [word.format(drone) for word in CONTENDERS[contender]]
