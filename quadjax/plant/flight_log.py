"""Flight logs of the stand-in plant in the columns of Paparazzi's flight logger.

They hold what a drone knows: the navigation filter's position, velocity and attitude, the gyro, the
measured propeller speeds and commands, the accelerometer as measured and its estimated bias. As a
command, flights of policies and of a pilot who wanders through the hall::

    python -m quadjax.plant.flight_log configs/plant/standin.yaml \
        --policy quadjax/pretrained/e2e.npz --flights 4 --out runs/standin_logs
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from quadjax.commands import Parser, count, parse, seed
from quadjax.config import REPOSITORY_CONFIGS, load_config
from quadjax.errors import InputError, command_line
from quadjax.fit.synthetic_log import write_log
from quadjax.plant.plant_schema import load_plant_config
from quadjax.plant.race import Flights, fly_plan, plan_flights
from quadjax.policy_file import read_policy
from quadjax.race.track import gate_count
from quadjax.schema import Config

GATES = ("target_gate_x", "target_gate_y", "target_gate_z")


def log_columns(flights: Flights, run: int, gates: np.ndarray) -> dict[str, np.ndarray]:
    """One recorded run as the columns of a Paparazzi flight log, each (n,).

    Args:
        flights: that were flown.
        run: which of the recorded ones.
        gates: (gates, 3) centres, m, world.
    """
    frames = flights.frames
    going = ~frames.over[:, run]

    def rows(vector: object) -> np.ndarray:
        columns = [np.asarray(x)[going, run] for x in jax.tree.leaves(vector)]
        return np.stack(columns, axis=1).astype(np.float64)

    believed, number = frames.believed, int(going.sum())
    groups = {
        "pos_": ("xyz", rows(believed.position)),
        "vel_": ("xyz", rows(believed.velocity)),
        "att_": (("phi", "theta", "psi"), rows(believed.euler)),
        "rate_": ("pqr", rows(frames.gyro)),
        "rpm_obs_": ("1234", rows(believed.rpm)),
        "rpm_ref_": ("1234", rows(frames.rpm_command)),
        "ekf_U": ("123", rows(frames.accelerometer)),
        "ekf_X": (("10", "11", "12"), rows(frames.force_bias)),
        "target_gate_": ("xyz", gates[np.asarray(frames.target)[going, run]]),
    }
    columns = {"time": flights.step * np.arange(number), "autopilot_mode": np.ones(number)}
    for prefix, (suffixes, values) in groups.items():
        columns |= {prefix + s: values[:, i] for i, s in enumerate(suffixes)}
    return columns


def gate_centres(config: Config) -> np.ndarray:
    """Centres (gates, 3) of a config's track, m, world."""
    return np.array([gate.position for gate in config.track.gates], np.float64)


def _arguments() -> argparse.Namespace:
    parser = Parser(description="Write flight logs of the stand-in plant.")
    parser.add_argument("config", help="YAML file of configs/plant")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--policy", action="append", required=True, metavar="FILE.npz")
    parser.add_argument("--race", default=str(REPOSITORY_CONFIGS / "e2e_shac.yaml"), metavar="FILE")
    parser.add_argument("--flights", type=count, default=4, help="of each policy")
    parser.add_argument("--laps", type=count, default=6)
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    return parse(parser)


def main() -> None:
    """Fly policies on the plant and write what they logged."""
    arguments = _arguments()
    config = load_plant_config(arguments.config, arguments.words)
    # A log has a row for every sample, as an autopilot's has.
    config = dataclasses.replace(config, control_rate=config.sample_rate)
    race = load_config(arguments.race)
    for name in arguments.policy:
        policy = read_policy(name)
        plan = plan_flights(
            race, config, policy, name, arguments.laps, arguments.flights, arguments.flights
        )
        assert gate_count(plan.params.race.track) == len(race.track.gates)
        with Console(stderr=True).status("compiling") as status:
            flights = fly_plan(
                plan,
                arguments.seed,
                lambda seconds, status=status: status.update(f"{seconds:.0f} s flown"),
            )
        for run in range(arguments.flights):
            columns = log_columns(flights, run, gate_centres(race))
            if not all(np.isfinite(values).all() for values in columns.values()):
                raise InputError(f"{name}: flight {run} is not finite")
            path = arguments.out / f"{Path(name).stem}_{run}.csv"
            write_log(path, columns)
            print(f"wrote {path}, {len(columns['time'])} rows {flights.laps.crashes[run]}")


if __name__ == "__main__":
    command_line(main)()
