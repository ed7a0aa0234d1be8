"""Train e2e_paper by quadjax and by Stable-Baselines3 for equal time or steps, one after the other.

Both have the same hyperparameters, environment and seed, and are evaluated after every update. Laps
are of the mean action of the best policy, which ``output`` gets. Numbers: docs/design/results.md.

    python -m benchmarks.against_sb3 e2e_paper --seconds 900 --steps 2500000
"""

import multiprocessing
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

import quadjax
from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.learners.parallel import prepare_devices
from quadjax.training.score import score_runs


class Clock:
    """Steps over time, and limits of both."""

    def __init__(self, started: float, seconds: float, steps: int = 0) -> None:
        """Start at ``started``, by ``time.monotonic()``, for ``seconds`` or ``steps`` (0: any)."""
        self.limits, self.marks = (seconds, steps or np.inf), [(started, 0)]

    def over(self, steps: int) -> bool:
        """Whether a limit is reached; called after an update."""
        self.marks.append((time.monotonic(), steps))
        return self.marks[-1][0] - self.marks[0][0] >= self.limits[0] or steps >= self.limits[1]

    def speed(self) -> float:
        """Steps per second from the end of the first update, if there are several, to the last."""
        seconds, steps = np.subtract(self.marks[-1], self.marks[len(self.marks) > 2])
        return steps / max(seconds, 1e-9)


def by_sb3(config: quadjax.Config, clock: Clock, folder: Path) -> None:
    """Train with Stable-Baselines3, PyTorch on all cores."""
    from stable_baselines3.common.callbacks import BaseCallback

    from benchmarks.sb3_ppo import make_ppo

    model, file, runs = make_ppo(config), folder / "sb3.zip", score_runs(config)

    class Evaluation(BaseCallback):
        best, done = np.inf, False

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                self.model.save(file)
                policy = quadjax.Policy.load(file, config)
                score = quadjax.evaluate(policy, config, runs=runs, deterministic=True).laps.score
                if score <= self.best:
                    policy.save(folder / "policy.npz")
                self.best = min(score, self.best)
                print(f"{self.num_timesteps:,} steps, {score:.2f} s", flush=True)
                self.done = clock.over(self.num_timesteps)

        def _on_step(self) -> bool:
            return not self.done

    folder.mkdir(parents=True, exist_ok=True)
    model.learn(config.run.steps, callback=Evaluation())


def train_side(
    side: str, config: quadjax.Config, seconds: float, steps: int, started: float, folder: Path
) -> str:
    """Train one side in this process, which began at ``started``; a line of the table."""
    prepare_devices("auto" if side == "quadjax" else "1")
    clock = Clock(started, seconds, steps)
    if side == "sb3":
        by_sb3(config, clock, folder)
    else:
        quadjax.train(config, folder, stop_when=lambda row: clock.over(row["steps"]))
    laps = quadjax.evaluate(folder / "policy.npz", config, runs=1, deterministic=True).laps
    done, (ended, total) = int(laps.laps_completed()[0]), clock.marks[-1]
    effort = f"{total / 1e6:.1f} | {ended - started:.0f} | {time.process_time():.0f} | {done} in"
    return f"| {side} | {clock.speed():,.0f} | {effort} {laps.totals[0]:.2f} s |"


def against_sb3(
    preset: str = "e2e_paper",
    *changes: str,
    sides: Annotated[tuple[Literal["quadjax", "sb3"], ...], options.LIST] = ("quadjax", "sb3"),
    seconds: Annotated[float, options.number(0.0, 1e6)] = 900.0,
    steps: Annotated[int, options.whole(0, 10**12)] = 0,
    output: options.Folder = Path("runs/against_sb3"),
) -> None:
    """Train a preset of PPO by each side, and print a table."""
    learner = quadjax.load(preset, changes).learner
    if learner.algorithm != "ppo":
        raise InputError(f"{preset} trains by {learner.algorithm}, allowed: presets of ppo")
    interval = f"run.evaluate_every={learner.num_envs * learner.rollout_length}"
    config = quadjax.load(preset, [*changes, interval])
    print("| side | steps/s | M steps | wall s | CPU s | laps |\n|---|---|---|---|---|---|")
    for side in sides:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            arguments = side, config, seconds, steps, time.monotonic(), output / side
            print(pool.apply(train_side, arguments), flush=True)


if __name__ == "__main__":
    script(against_sb3)
