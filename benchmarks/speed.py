"""Measure the speed of the environment and of training, without compilation.

Environment steps a second (a step and the reset of finished episodes) against the number of
environments, with and without residual networks; the same with the observation for each vehicle
model; training steps a second of the presets; and the peak memory of each. Every measurement runs
in a separate process and is the median of its repeats.

    python -m benchmarks.speed --quick
"""

import dataclasses
import multiprocessing
from typing import Any

from quadjax.cli import script
from quadjax.cli.options import Count, Flag, JsonFile
from quadjax.cli.output import steps, write_record
from quadjax.core.provenance import provenance

NUM_ENVS = tuple(4**power for power in range(9))  # 1 to 65,536
QUICK_NUM_ENVS = (1, 64, 4096, 65_536)
PRESET, OBSERVED = "e2e", 4096
VEHICLES = ("bebop1", "5inch", "a2rl", "cpc")  # of the measurement with the observation
PRESETS = ("e2e", "e2e_ppo", "e2e_paper")
COLUMNS = f"{'':>10} {'num_envs':>8} {'devices':>7} {'steps/s':>12} {'slowest':>12} {'compile':>8}"


@dataclasses.dataclass(frozen=True)
class Job:
    """One measurement: of the environment, or of a preset's training.

    Attributes:
        kind: environment, residual, observed or training.
        name: of the vehicle of an observed environment, or of the preset.
        num_envs: of the environment; 0 for the preset's.
        repeats: of which the median is taken.
        devices: of a training.
    """

    kind: str
    name: str
    num_envs: int
    repeats: int
    devices: str = "auto"


def speed(*, quick: Flag = False, repeats: Count | None = None, json: JsonFile = None) -> None:
    """Measure the speed of the environment and of training on this machine.

    Args:
        quick: Fewer sizes and repeats.
        repeats: Of each measurement (default: 7, or 3 with --quick).
        json: Write the numbers.
    """
    times = repeats or (3 if quick else 7)
    sizes, few = QUICK_NUM_ENVS if quick else NUM_ENVS, max(2, times // 2)
    jobs = [Job(kind, PRESET, n, times) for kind in ("environment", "residual") for n in sizes]
    jobs += [Job("observed", vehicle, OBSERVED, times) for vehicle in VEHICLES]
    jobs += [Job("training", preset, 0, few) for preset in PRESETS]
    jobs += [Job("training", PRESET, 0, few, devices="1")]
    rows = []
    with steps() as report:
        for number, job in enumerate(jobs, 1):
            report(f"{job.name} {job.kind} {job.num_envs or ''}, {number} of {len(jobs)}")
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                rows.append(pool.apply(measure, (job,)))
    machine = rows[0]["machine"]
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    for kind in dict.fromkeys(job.kind for job in jobs):
        print(f"\n{kind}\n{COLUMNS} {'memory':>9}")
        for row in (row for row in rows if row["kind"] == kind):
            memory = row["peak_memory_mib"]
            print(
                f"{row['name']:>10} {row['num_envs']:>8,} {row['devices']:>7} "
                f"{row['steps_per_second']:>12,.0f} {row['slowest']:>12,.0f} "
                f"{row['compile_seconds']:>6.1f} s {memory and round(memory)!s:>5} MiB"
            )
    write_record(json, {"machine": machine, "results": rows}, provenance())


def measure(job: Job) -> dict[str, Any]:
    """One measurement, in this process."""
    from quadjax.config.loading import load_config
    from quadjax.learners.parallel import prepare_devices

    observed = job.kind == "observed"
    preset, vehicle = (PRESET, [f"vehicle={job.name}"]) if observed else (job.name, [])
    config = load_config(preset, [f"run.devices={job.devices}", *vehicle])
    prepare_devices("auto")
    from quadjax.studies import benchmark
    from quadjax.training.result import peak_memory_mib

    if job.kind == "training":
        result = benchmark.measure_training(config, job.repeats)
    else:
        residual = job.kind == "residual"
        result = benchmark.measure_environment(
            config, job.num_envs, residual, observed, job.repeats
        )
    record = dataclasses.asdict(job) | dataclasses.asdict(result)
    return record | {"peak_memory_mib": peak_memory_mib(), "machine": benchmark.machine()}


if __name__ == "__main__":
    script(speed)
