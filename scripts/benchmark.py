"""Measure the environment's and the training's speed on this machine, compile time apart.

Environment steps a second (a step and the reset of finished episodes) against the number of
drones, with and without residual networks; training steps a second of the presets; and the peak
memory of each. Every measurement runs in a process of its own and is the median of its repeats.
With --sb3, the published hyperparameters by quadjax and by Stable-Baselines3 for equal time.
"""

import time

STARTED = time.monotonic()  # a side of the side-by-side counts from here

import argparse  # noqa: E402
import dataclasses  # noqa: E402
import json  # noqa: E402
import os  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
from pathlib import Path  # noqa: E402

from quadjax.cli.arguments import Parser, check_writable, count, parse  # noqa: E402
from quadjax.config.loading import load_config  # noqa: E402
from quadjax.core.errors import InputError, command_line  # noqa: E402
from quadjax.learners.devices import prepare_devices  # noqa: E402

DRONES = tuple(4**power for power in range(9))  # 1 to 65,536
QUICK_DRONES = (1, 64, 4096, 65_536)
OBSERVED = 4096  # drones of the measurement with the observation
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
ENVIRONMENT = CONFIGS / "e2e_shac.yaml"
PRESETS = ("e2e_shac.yaml", "e2e_ppo.yaml", "e2e_paper.yaml")


@dataclasses.dataclass(frozen=True)
class Job:
    """One measurement: of the environment, or of a preset's training."""

    kind: str  # "environment" | "observed" | "residual" | "training" | "ours" | "sb3"
    config: str
    drones: int
    repeats: int
    seconds: float = 0.0  # of a side of the side-by-side
    devices: str = "auto"  # train.devices of a preset's training


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repeats")
    parser.add_argument("--repeats", type=count, help="of each measurement (7, or 3 with --quick)")
    parser.add_argument(
        "--sb3",
        type=count,
        metavar="SECONDS",
        help="only train e2e_paper.yaml so long by quadjax and by Stable-Baselines3, side by side",
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parse(parser)
    check_writable(arguments.json)
    return arguments


def _jobs(quick: bool, repeats: int) -> list[Job]:
    environment = str(ENVIRONMENT)
    jobs = [
        Job(kind, environment, drones, repeats)
        for kind in ("environment", "residual")
        for drones in (QUICK_DRONES if quick else DRONES)
    ]
    jobs.append(Job("observed", environment, OBSERVED, repeats))
    present = [CONFIGS / name for name in PRESETS if (CONFIGS / name).is_file()]
    few = max(2, repeats // 2)
    alone = [Job("training", environment, 0, few, devices="1")]  # what more devices are worth
    return jobs + [Job("training", str(path), 0, few) for path in present] + alone


def _run_side(job: Job) -> dict[str, object]:
    """Train one side in this process, for its time."""
    config = load_config(job.config)
    per_update = config.train.drones * config.ppo.steps_per_update
    config = load_config(job.config, [f"train.evaluate_every={per_update}"])
    prepare_devices("auto" if job.kind == "ours" else "1")
    from quadjax.evaluation.benchmark import machine
    from quadjax.studies import ppo_against_sb3 as side_by_side

    if job.kind == "ours":
        with tempfile.TemporaryDirectory() as folder:
            side = side_by_side.ours(config, job.seconds, STARTED, Path(folder) / "run")
    else:
        side = side_by_side.stable_baselines(config, job.seconds, STARTED)
    return {"side": dataclasses.asdict(side), "machine": machine()}


def _run_job(job: Job) -> dict[str, object]:
    """Measure in this process."""
    if job.kind in ("ours", "sb3"):
        return _run_side(job)
    config = load_config(job.config, [f"train.devices='{job.devices}'"])
    prepare_devices("auto")
    from quadjax.evaluation import benchmark
    from quadjax.training.run import peak_memory_mib

    if job.kind == "training":
        speed = benchmark.measure_training(config, job.repeats)
    else:
        residual, observed = job.kind == "residual", job.kind == "observed"
        speed = benchmark.measure_environment(config, job.drones, residual, observed, job.repeats)
    result = dataclasses.asdict(job) | dataclasses.asdict(speed)
    memory = {"peak_memory_mib": peak_memory_mib()}
    return result | memory | {"config": Path(job.config).stem, "machine": benchmark.machine()}


def _measure(job: Job) -> dict[str, object]:
    """Measure in a process of its own, so that the peak memory is this measurement's."""
    text = json.dumps(dataclasses.asdict(job))
    done = subprocess.run(
        [sys.executable, __file__, "--job", text],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(f"measuring {job.kind} {job.config} {job.drones} failed: {last}")
    return json.loads(done.stdout.splitlines()[-1])


def _describe(job: Job) -> str:
    return f"{Path(job.config).stem} {job.kind} {job.drones or ''}".strip()


def _print_machine(machine: dict[str, object]) -> None:
    print(
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB, "
        f"{machine['system']}, Python {machine['python']}, JAX {machine['jax']} on "
        f"{machine['device']} ({machine['backend']})"
    )


def _print_results(results: list[dict[str, object]]) -> None:
    titles = {
        "environment": "environment: step and reset, without residual",
        "residual": "environment: step and reset, with residual networks",
        "observed": "environment: step, reset and observation, without residual",
        "training": "training",
    }
    for kind, title in titles.items():
        rows = [row for row in results if row["kind"] == kind]
        if not rows:
            continue
        print(f"\n{title}")
        print(
            f"{'':>14} {'drones':>7} {'devices':>7} {'steps/s':>12} {'slowest':>12} "
            f"{'fastest':>12} {'compile':>8} {'memory':>9}"
        )
        for row in rows:
            name = row["config"] if kind == "training" else ""
            print(
                f"{name:>14} {row['drones']:>7,} {row['devices']:>7} "
                f"{row['steps_per_second']:>12,.0f} {row['slowest']:>12,.0f} "
                f"{row['fastest']:>12,.0f} {row['compile_seconds']:>6.1f} s "
                f"{row['peak_memory_mib'] or 0:>5.0f} MiB"
            )


def _side_by_side(seconds: int, path: str | None) -> int:
    """Both sides one after the other, on this machine."""
    from quadjax.core.files import write_json
    from quadjax.studies.ppo_against_sb3 import Side, format_sides
    from quadjax.training.progress import bar

    found = []
    with bar(counted=True) as progress:
        task = progress.add_task("training side by side", total=2)
        for kind in ("ours", "sb3"):
            found.append(_measure(Job(kind, str(CONFIGS / "e2e_paper.yaml"), 0, 1, seconds)))
            progress.advance(task)
    machine, sides = found[0]["machine"], [row["side"] for row in found]
    _print_machine(machine)
    run = (
        f"e2e_paper.yaml, seed 0, {seconds} s of wall time each from the start of the process; "
        "laps of the last policy, deterministic from hover"
    )
    print(format_sides([Side(**side) for side in sides], run))
    if path:
        write_json(path, {"machine": machine, "run": run, "sides": sides})
    return 0


@command_line
def main() -> int:
    """Measure, print, and write the numbers if asked."""
    arguments = _arguments()
    if arguments.job:
        print(json.dumps(_run_job(Job(**json.loads(arguments.job)))))
        return 0
    from quadjax.core.files import write_json
    from quadjax.training.progress import bar

    if arguments.sb3:
        return _side_by_side(arguments.sb3, arguments.json)
    jobs = _jobs(arguments.quick, arguments.repeats or (3 if arguments.quick else 7))
    results = []
    with bar(counted=True) as progress:
        task = progress.add_task("measuring", total=len(jobs))
        for job in jobs:
            progress.update(task, description=_describe(job))
            results.append(_measure(job))
            progress.advance(task)
    machine = results[0]["machine"]
    _print_machine(machine)
    _print_results(results)
    if arguments.json:
        plain = [{k: v for k, v in row.items() if k != "machine"} for row in results]
        write_json(arguments.json, {"machine": machine, "results": plain})
    return 0


if __name__ == "__main__":
    main()
