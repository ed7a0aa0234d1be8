"""Measure the environment's and the training's speed on this machine, compile time apart.

Environment steps a second (a step and the reset of finished episodes) against the number of
drones, with and without residual networks; training steps a second of the presets; and the peak
memory of each. Every measurement runs in a process of its own and is the median of its repeats.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

from quadjax.commands import Parser, check_writable, count, parse
from quadjax.config import load_config
from quadjax.devices import prepare_devices
from quadjax.errors import InputError, command_line

DRONES = tuple(4**power for power in range(9))  # 1 to 65,536
QUICK_DRONES = (1, 64, 4096, 65_536)
OBSERVED = 4096  # drones of the measurement with the observation
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
ENVIRONMENT = CONFIGS / "e2e.yaml"
PRESETS = ("e2e.yaml", "e2e_ppo.yaml", "e2e_paper.yaml")


@dataclasses.dataclass(frozen=True)
class Job:
    """One measurement: of the environment, or of a preset's training."""

    kind: str  # "environment" | "observed" | "residual" | "training"
    config: str
    drones: int
    repeats: int


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repeats")
    parser.add_argument("--repeats", type=count, help="of each measurement (7, or 3 with --quick)")
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
    return jobs + [Job("training", str(path), 0, max(2, repeats // 2)) for path in present]


def _run_job(job: Job) -> dict[str, object]:
    """Measure in this process."""
    config = load_config(job.config)
    prepare_devices("auto")
    from quadjax.evaluate import benchmark
    from quadjax.training import peak_memory_mib

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


@command_line
def main() -> int:
    """Measure, print, and write the numbers if asked."""
    arguments = _arguments()
    if arguments.job:
        print(json.dumps(_run_job(Job(**json.loads(arguments.job)))))
        return 0
    from quadjax.files import write_json
    from quadjax.progress import bar

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
