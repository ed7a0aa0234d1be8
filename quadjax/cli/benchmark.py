"""Measure the speed of the environment and of training, without compilation.

Environment steps a second (a step and the reset of finished episodes) against the number of
environments, with and without residual networks; the same with the observation for each vehicle
model; training steps a second of the presets; and the peak memory of each. Every measurement runs
in a separate process and is the median of its repeats. With --sb3, quadjax and Stable-Baselines3
train the published hyperparameters for equal time. quadjax benchmark tracks (try --help) trains on
several tracks and compares the laps with the best known ones.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from quadjax.cli import STARTED
from quadjax.cli.arguments import Parser, check_writable, count, parse, whole
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

NUM_ENVS = tuple(4**power for power in range(9))  # 1 to 65,536
QUICK_NUM_ENVS = (1, 64, 4096, 65_536)
OBSERVED = 4096  # environments of the measurement with the observation
ENVIRONMENT = "e2e_shac"
VEHICLES = ("bebop1", "5inch", "a2rl", "cpc")  # of the measurement with the observation
PRESETS = ("e2e_shac", "e2e_ppo", "e2e_paper")
SIDE_BY_SIDE = "e2e_paper"
TITLES = {
    "environment": "environment: step and reset, without residual",
    "residual": "environment: step and reset, with residual networks",
    "observed": "environment: step, reset and observation, without residual",
    "training": "training",
}


@dataclasses.dataclass(frozen=True)
class Job:
    """One measurement: of the environment, or of a preset's training."""

    # of TITLES, or one side of --sb3
    kind: Literal["environment", "residual", "observed", "training", "quadjax", "sb3"]
    config: str
    num_envs: Annotated[int, Field(ge=0, le=2**20)]  # 0 for the preset's own
    repeats: Annotated[int, Field(ge=1, le=10**6)]
    seconds: Annotated[float, Field(ge=0, le=10**6)] = 0.0  # of one side of --sb3
    steps: Annotated[int, Field(ge=0, le=10**12)] = 0  # likewise; 0: any
    devices: str = "auto"  # of a preset's training
    vehicle: str = VEHICLES[0]

    def describe(self) -> str:
        """A short description of the job."""
        name = self.vehicle if self.kind == "observed" else Path(self.config).stem
        return f"{name} {self.kind} {self.num_envs or ''}".strip()


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("benchmark", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repeats")
    parser.add_argument("--repeats", type=count, help="of each measurement (7, or 3 with --quick)")
    parser.add_argument(
        "--sb3",
        type=count,
        metavar="SECONDS",
        help="only train e2e_paper for SECONDS by quadjax and by Stable-Baselines3, side by side",
    )
    parser.add_argument(
        "--steps", type=whole(1, 10**12), help="with --sb3: end each after so many steps"
    )
    parser.add_argument("--figure", metavar="FILE", help="with --sb3: draw both learning curves")
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parse(parser, argv)
    check_writable(arguments.json)
    for option in ("steps", "figure"):
        if getattr(arguments, option) and not arguments.sb3:
            raise InputError(f"--{option} has no effect without --sb3")
    check_writable(arguments.figure, (".png", ".svg", ".pdf"))
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and write the numbers if --json is given."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    if argv[:1] == ["tracks"]:
        from quadjax.cli.benchmark_tracks import main as tracks

        return tracks(argv[1:])
    options = _arguments(argv)
    if options.job:
        print(json.dumps(_run_job(_read_job(options.job))))
        return 0
    if options.sb3:
        return _side_by_side(options)
    results = _measure_all(_jobs(options.quick, options.repeats or (3 if options.quick else 7)))
    machine = results[0]["machine"]
    _print_machine(machine)
    _print_results(results)
    if options.json:
        from quadjax.core.files import write_json
        from quadjax.core.provenance import provenance

        plain = [{k: v for k, v in row.items() if k != "machine"} for row in results]
        write_json(options.json, {"machine": machine, "results": plain, "provenance": provenance()})
    return 0


def _jobs(quick: bool, repeats: int) -> list[Job]:
    jobs = [
        Job(kind, ENVIRONMENT, num_envs, repeats)
        for kind in ("environment", "residual")
        for num_envs in (QUICK_NUM_ENVS if quick else NUM_ENVS)
    ]
    jobs += [Job("observed", ENVIRONMENT, OBSERVED, repeats, vehicle=name) for name in VEHICLES]
    few = max(2, repeats // 2)
    jobs += [Job("training", preset, 0, few) for preset in PRESETS]
    return [*jobs, Job("training", ENVIRONMENT, 0, few, devices="1")]


def _measure_all(jobs: Sequence[Job]) -> list[dict[str, Any]]:
    from quadjax.training.progress import bar

    results = []
    with bar(counted=True) as progress:
        task = progress.add_task("measuring", total=len(jobs))
        for job in jobs:
            progress.update(task, description=job.describe())
            results.append(measure(job))
            progress.advance(task)
    return results


def measure(job: Job) -> dict[str, Any]:
    """Measure in a separate process, so that the peak memory is this measurement's."""
    text = json.dumps(dataclasses.asdict(job))
    done = subprocess.run(
        [sys.executable, "-m", "quadjax", "benchmark", "--job", text],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(f"measuring {job.describe()} failed: {last}")
    return json.loads(done.stdout.splitlines()[-1])


def _read_job(text: str) -> Job:
    """A job from JSON, which a process gets from the one that started it."""
    try:
        return TypeAdapter(Job).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"--job: {where or 'not a job'}: {first['msg']}") from None


def _run_job(job: Job) -> dict[str, Any]:
    """Measure in this process."""
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.learners.devices import prepare_devices

    if job.kind in ("quadjax", "sb3"):
        return _run_side(job)
    vehicle = [f"vehicle={job.vehicle}"] if job.kind == "observed" else []
    config = load_config(job.config, [f"run.devices={job.devices}", *vehicle])
    prepare_devices("auto")
    with loading():
        from quadjax.studies import benchmark
        from quadjax.training.result import peak_memory_mib

    if job.kind == "training":
        speed = benchmark.measure_training(config, job.repeats)
    else:
        residual, observed = job.kind == "residual", job.kind == "observed"
        speed = benchmark.measure_environment(config, job.num_envs, residual, observed, job.repeats)
    result = dataclasses.asdict(job) | dataclasses.asdict(speed)
    memory = {"peak_memory_mib": peak_memory_mib()}
    return result | memory | {"config": Path(job.config).stem, "machine": benchmark.machine()}


def _run_side(job: Job) -> dict[str, Any]:
    """Train one side of --sb3 in this process, for its time."""
    from quadjax.config.loading import load_config
    from quadjax.learners.devices import prepare_devices

    config = load_config(job.config)
    per_update = config.learner.num_envs * config.learner.rollout_length
    config = load_config(job.config, [f"run.evaluate_every={per_update}"])
    prepare_devices("auto" if job.kind == "quadjax" else "1")
    with loading():
        from quadjax.studies import ppo_against_sb3 as side_by_side
        from quadjax.studies.benchmark import machine

    clock = side_by_side.Clock(STARTED, job.seconds, job.steps)
    if job.kind == "quadjax":
        with tempfile.TemporaryDirectory() as folder:
            side = side_by_side.ours(config, clock, STARTED, Path(folder) / "run")
    else:
        side = side_by_side.stable_baselines(config, clock, STARTED)
    return {"side": dataclasses.asdict(side), "machine": machine()}


def _side_by_side(options: argparse.Namespace) -> int:
    """Both sides one after the other, on this machine."""
    from quadjax.config.loading import load_config
    from quadjax.core.files import write_json
    from quadjax.core.plotting import save_figure
    from quadjax.core.provenance import provenance
    from quadjax.studies.ppo_against_sb3 import SEED, Side, curves_figure, format_sides

    seconds, steps = options.sb3, options.steps or 0
    jobs = [Job(kind, SIDE_BY_SIDE, 0, 1, seconds, steps) for kind in ("quadjax", "sb3")]
    found = _measure_all(jobs)
    machine, sides = found[0]["machine"], [Side(**row["side"]) for row in found]
    _print_machine(machine)
    most = f"{seconds} s of wall time" + (f" or {steps:,} steps" if steps else "")
    run = (
        f"{SIDE_BY_SIDE}, seed {SEED}, {most} each from the start of the process; laps of the "
        "last policy, deterministic from hover"
    )
    print(format_sides(sides, run))
    if options.figure:
        save_figure(curves_figure(sides, f"{SIDE_BY_SIDE}, seed {SEED}"), options.figure)
        print(f"wrote {options.figure}")
    if options.json:
        origin = provenance(load_config(SIDE_BY_SIDE), seed=SEED)
        rows = [dataclasses.asdict(side) for side in sides]
        result = {"machine": machine, "run": run, "sides": rows, "provenance": origin}
        write_json(options.json, result)
    return 0


def _print_machine(machine: dict[str, Any]) -> None:
    print(
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB, "
        f"{machine['system']}, Python {machine['python']}, JAX {machine['jax']} on "
        f"{machine['device']} ({machine['backend']})"
    )


def _print_results(results: list[dict[str, Any]]) -> None:
    for kind, title in TITLES.items():
        print(f"\n{title}")
        print(
            f"{'':>10} {'num_envs':>8} {'devices':>7} {'steps/s':>12} {'slowest':>12} "
            f"{'compile':>8} {'memory':>9}"
        )
        for row in (row for row in results if row["kind"] == kind):
            memory = "-" if row["peak_memory_mib"] is None else f"{row['peak_memory_mib']:.0f} MiB"
            name = {"training": row["config"], "observed": row["vehicle"]}.get(kind, "")
            print(
                f"{name:>10} {row['num_envs']:>8,} {row['devices']:>7} "
                f"{row['steps_per_second']:>12,.0f} {row['slowest']:>12,.0f} "
                f"{row['compile_seconds']:>6.1f} s {memory:>9}"
            )
