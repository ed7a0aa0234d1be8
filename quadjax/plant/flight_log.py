"""Flight logs of the stand-in plant in the columns of Paparazzi's flight logger.

They hold what a drone knows: the navigation filter's position, velocity and attitude, the gyro, the
measured propeller speeds and commands, the accelerometer as measured and its estimated bias. As a
command, flights of policies and of a pilot who wanders through the hall::

    python -m quadjax.plant.flight_log configs/plant/standin.yaml \
        --policy quadjax/pretrained/e2e.npz --flights 4 --out runs/standin_logs
"""

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from quadjax.cli.arguments import Parser, count, parse, seed
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, command_line
from quadjax.core.resources import CONFIGS
from quadjax.fitting.synthetic_log import write_log
from quadjax.plant.plant_schema import PlantConfig, load_plant_config
from quadjax.plant.race import Flights, fly_plan, plan_flights
from quadjax.policy.file import read_policy
from quadjax.race.track import gate_count


@dataclasses.dataclass(frozen=True)
class Logged:
    """A log that was written."""

    path: Path
    rows: int
    crash: str  # why the flight ended early; "" where it did not


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


def write_logs(
    race: Config,
    plant: PlantConfig,
    policies: Sequence[Path | str],
    out: Path,
    flights: int = 4,
    laps: int = 6,
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
) -> list[Logged]:
    """Fly policies on the plant and write what each flight logged to ``out/POLICY_RUN.csv``.

    A log has a row for every sample of the plant, as an autopilot's has, whatever the plant's
    ``control_rate``. Of a policy one of whose flights is not finite nothing is written.

    Args:
        race: config of the race.
        plant: config of the plant.
        policies: files.
        out: folder for the logs.
        flights: of each policy.
        laps: of each flight, from hover.
        seed: of batteries, gusts, sensors and the policies' noise.
        report: told what is being done.

    Raises:
        InputError: a policy that cannot be read or does not fit, or a flight that is not finite.
    """
    plant = dataclasses.replace(plant, control_rate=plant.sample_rate)
    written: list[Logged] = []
    for name in policies:
        report(f"{name}: compiling")
        plan = plan_flights(race, plant, read_policy(name), str(name), laps, flights, flights)
        assert gate_count(plan.params.race.track) == len(race.track.gates)
        flown = fly_plan(plan, seed, _reporter(report, str(name)))
        logs = [log_columns(flown, run, gate_centres(race)) for run in range(flights)]
        for run, columns in enumerate(logs):
            if not all(np.isfinite(values).all() for values in columns.values()):
                raise InputError(f"{name}: flight {run} is not finite")
        for run, columns in enumerate(logs):
            path = out / f"{Path(name).stem}_{run}.csv"
            write_log(path, columns)
            written.append(Logged(path, len(columns["time"]), flown.laps.crashes[run]))
    return written


def _reporter(report: Callable[[str], None], name: str) -> Callable[[float], None]:
    return lambda seconds: report(f"{name}: {seconds:.0f} s flown")


def _arguments() -> argparse.Namespace:
    parser = Parser(description="Write flight logs of the stand-in plant.")
    parser.add_argument("config", help="YAML file of configs/plant")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--policy", action="append", required=True, metavar="FILE.npz")
    parser.add_argument("--race", default=str(CONFIGS / "e2e_shac.yaml"), metavar="FILE")
    parser.add_argument("--flights", type=count, default=4, help="of each policy")
    parser.add_argument("--laps", type=count, default=6)
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    return parse(parser)


def main() -> None:
    """Fly policies on the plant and write what they logged."""
    arguments = _arguments()
    plant = load_plant_config(arguments.config, arguments.words)
    race = load_config(arguments.race)
    with Console(stderr=True).status("compiling") as status:
        written = write_logs(
            race,
            plant,
            arguments.policy,
            arguments.out,
            arguments.flights,
            arguments.laps,
            arguments.seed,
            status.update,
        )
    for log in written:
        print(f"wrote {log.path}, {log.rows} rows {log.crash}".rstrip())


if __name__ == "__main__":
    command_line(main)()
