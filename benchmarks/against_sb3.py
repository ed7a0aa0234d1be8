"""Train e2e_paper by quadjax and by Stable-Baselines3 for equal time or steps, one after the other.

Both have the published hyperparameters, the same environment and one seed, and are evaluated after
every update. The time of a side counts from the start of its process. Laps are of the mean action
of the last policy, from hover. Arguments: SECONDS STEPS. Numbers: docs/design/results.md.
"""

import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import quadjax
from quadjax.config.assembly import make_race
from quadjax.learners.parallel import core_count, prepare_devices
from quadjax.training.build import untrained_policy
from quadjax.training.score import score_runs

PRESET, SEED = "e2e_paper", 0


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
        marks = self.marks[1:] if len(self.marks) > 2 else self.marks
        return (marks[-1][1] - marks[0][1]) / max(marks[-1][0] - marks[0][0], 1e-9)


def by_quadjax(config, clock: Clock, started: float) -> quadjax.Policy:
    """Train with quadjax; the last policy."""
    from quadjax.training.run import train

    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        train(config, run, started=started, enough=lambda row: clock.over(row["steps"]))
        return quadjax.Policy.load(run / "policy_last.npz")


def by_sb3(config, clock: Clock) -> quadjax.Policy:
    """Train with Stable-Baselines3, PyTorch on all cores; the last policy."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

    from quadjax.integrations import sb3

    torch.set_num_threads(core_count())
    untrained, runs = untrained_policy(config), score_runs(config)

    class Stop(BaseCallback):
        """Evaluates the policy after each update and reads the clock."""

        done = False

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                policy = sb3.policy_of_ppo(self.model, untrained)
                quadjax.evaluate(policy, config, runs=runs, deterministic=True)
                self.done = clock.over(self.num_timesteps)

        def _on_step(self) -> bool:
            return not self.done

    model = sb3.make_ppo(*make_race(config), config.learner, config.network, SEED)
    model.learn(config.run.steps, callback=Stop())
    return sb3.policy_of_ppo(model, untrained)


def train_side(kind: str, config, seconds: float, steps: int, started: float) -> str:
    """Train one side in this process, which began at ``started``; a line of the table."""
    prepare_devices("auto" if kind == "quadjax" else "1")
    clock = Clock(started, seconds, steps)
    trained = by_sb3(config, clock) if kind == "sb3" else by_quadjax(config, clock, started)
    laps = quadjax.evaluate(trained, config, runs=1, deterministic=True).laps
    done, wall = int(laps.laps_completed()[0]), clock.marks[-1][0] - started
    effort = f"{clock.marks[-1][1] / 1e6:.1f} | {wall:.0f} | {time.process_time():.0f}"
    return f"| {kind} | {clock.speed():,.0f} | {effort} | {done} in {laps.totals[0]:.2f} s |"


if __name__ == "__main__":
    learner = quadjax.load(PRESET).learner
    every = f"run.evaluate_every={learner.num_envs * learner.rollout_length}"
    race, limits = quadjax.load(PRESET, [every]), (float(sys.argv[1]), int(sys.argv[2]))
    print("| side | steps/s | M steps | wall s | CPU s | laps |\n|---|---|---|---|---|---|")
    for side in ("quadjax", "sb3"):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            print(pool.apply(train_side, (side, race, *limits, time.monotonic())), flush=True)
