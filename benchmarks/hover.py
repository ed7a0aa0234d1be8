"""Train policies to catch a thrown drone and hover, and throw it: the row of ``hover.json``.

The task by which RLtools and crazyflow report how fast they train: the part ``+hover``. A throw has
any attitude, up to 1 m, 2 m/s and 3 rad/s in each axis. It is caught if the drone is within 0.3 m
of the point and below 0.5 m/s after 4 s.

    python -m benchmarks.hover --seeds 0 1 2 3 4
"""

from pathlib import Path
from typing import Annotated

import numpy as np

import quadjax
from benchmarks import rows
from quadjax.cli import script
from quadjax.cli.options import Folder, Seeds, whole
from quadjax.core.sections import MAX_RUNS

CONFIG = ["e2e", "+hover"]
SECONDS, NEAR, SLOW = 4.0, 0.3, 0.5  # s, m, m/s


def caught(policy: quadjax.Policy, config: quadjax.Config, throws: int) -> np.ndarray:
    """Which throws (n,) are caught by the policy's mean action."""
    flown = quadjax.evaluate(
        policy, config, seconds=SECONDS, start="random", runs=throws, deterministic=True
    )
    ends = [(flight["position"][-1], flight["velocity"][-1]) for flight in flown.flights]
    point = config.track.gates[0].position
    far, fast = np.linalg.norm(np.array(ends) - [point, (0.0, 0.0, 0.0)], axis=2).T
    alive = np.array([flight.time[-1] for flight in flown.flights]) > SECONDS - 0.1
    return alive & (far < NEAR) & (fast < SLOW)


def hover(
    *overrides: str,
    seeds: Seeds = (0,),
    throws: Annotated[int, whole(1, MAX_RUNS)] = 10_000,
    output: Folder = Path("runs/hover"),
) -> None:
    """Train with each seed, print training time and the share of throws caught, and write the row.

    The settings of ``overrides`` are part of the row's name.
    """
    first, *words = [*CONFIG, *overrides]
    configs, shares, steps = [quadjax.load(first, [*words, f"seed={x}"]) for x in seeds], [], 0
    for seed, config in zip(seeds, configs, strict=True):
        run = quadjax.train(config, output / str(seed), overwrite=True, progress=False)
        last = {key: values[-1] for key, values in run.metrics.items()}
        training, steps = last["steps"] / last["steps_per_second"], int(last["steps"])
        shares.append(round(100.0 * float(caught(run.policy, config, throws).mean()), 2))
        print(f"seed {seed}: {steps:,} steps in {training:.1f} s, {shares[-1]:.2f}% caught")
    row = {
        "name": " ".join([first, *words]),
        "command": " ".join(
            ["python -m benchmarks.hover", *overrides, "--seeds", *map(str, seeds)]
        ),
        "config": [first, *words],
        "seeds": list(seeds),
        "steps": steps,
        "caught, %": shares,
    }
    rows.write("hover", [row])


if __name__ == "__main__":
    script(hover)
