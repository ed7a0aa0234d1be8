"""PPO of quadjax and of Stable-Baselines3 on the same task for the same wall time."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.config.race import make_race
from quadjax.config.schema import Config
from quadjax.evaluation.evaluation import evaluate
from quadjax.learners.devices import core_count
from quadjax.policy.file import Policy
from quadjax.training.build import untrained_policy

if TYPE_CHECKING:
    from stable_baselines3.common.callbacks import BaseCallback

SEED = 0


@dataclasses.dataclass(frozen=True)
class Side:
    """Result of one library."""

    name: str
    threads: str
    seconds: float  # of wall time, with set-up and compilation
    steps: int
    steps_per_second: float  # of training, after the first update
    lap_total: float | None  # s, all laps, deterministic from hover; None if not finished
    laps_completed: int
    laps: int


def _evaluate(config: Config, policy: Policy) -> tuple[float | None, int]:
    laps = evaluate(policy, config, runs=1, deterministic=True).laps
    total = float(laps.totals[0])
    return (total if laps.finished else None), int(laps.laps_completed()[0])


class Clock:
    """Steps over time, and a time limit."""

    def __init__(self, started: float, seconds: float) -> None:
        """Start at ``started``, by ``time.monotonic()``, for ``seconds``."""
        self._started, self._seconds = started, seconds
        self._marks: list[tuple[float, int]] = [(started, 0)]

    def over(self, steps: int) -> bool:
        """Whether the time is over; called after an update."""
        now = time.monotonic()
        self._marks.append((now, steps))
        return now - self._started >= self._seconds

    @property
    def seconds(self) -> float:
        """Seconds until the last update."""
        return self._marks[-1][0] - self._started

    @property
    def speed(self) -> float:
        """Steps per second from the end of the first update, if there are several, to the last."""
        marks = self._marks[1:] if len(self._marks) > 2 else self._marks
        (first, before), (last, after) = marks[0], marks[-1]
        return (after - before) / max(last - first, 1e-9)


def ours(config: Config, seconds: float, started: float, directory: Path) -> Side:
    """Train with quadjax and evaluate the last policy.

    Args:
        config: with one update per chunk, so that the time is checked after each.
        seconds: of wall time since ``started``.
        started: by ``time.monotonic()``.
        directory: of the run.
    """
    from quadjax.training.run import train

    clock = Clock(started, seconds)
    result = train(config, directory, started=started, enough=lambda row: clock.over(row["steps"]))
    total, completed = _evaluate(config, Policy.load(directory / "policy_last.npz"))
    threads = f"{result.summary['devices']} host devices of one thread"
    steps = int(result.summary["steps"])
    return Side(
        "quadjax",
        threads,
        clock.seconds,
        steps,
        clock.speed,
        total,
        completed,
        config.evaluate.laps,
    )


def _stop_after(clock: Clock) -> "BaseCallback":
    """A callback of Stable-Baselines3 that stops when the time is over."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Stop(BaseCallback):
        """Checks the clock after each update."""

        def __init__(self) -> None:
            super().__init__()
            self.done = False

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                self.done = clock.over(self.num_timesteps)

        def _on_step(self) -> bool:
            return not self.done

    return Stop()


def stable_baselines(config: Config, seconds: float, started: float) -> Side:
    """Train with Stable-Baselines3, PyTorch on all cores, and evaluate the last policy.

    Args:
        config: the race and the hyperparameters.
        seconds: of wall time since ``started``.
        started: by ``time.monotonic()``.
    """
    import torch

    from quadjax.integrations import sb3

    torch.set_num_threads(core_count())
    model = sb3.make_ppo(*make_race(config), config.learner, config.network, SEED)
    clock = Clock(started, seconds)

    model.learn(config.run.steps, callback=_stop_after(clock))
    total, completed = _evaluate(config, sb3.policy_of_ppo(model, untrained_policy(config)))
    threads = f"PyTorch {torch.get_num_threads()} threads, the race in JAX on one device"
    steps = config.learner.num_envs * config.learner.rollout_length
    steps *= model.num_timesteps // steps
    return Side(
        "Stable-Baselines3",
        threads,
        clock.seconds,
        steps,
        clock.speed,
        total,
        completed,
        config.evaluate.laps,
    )


def format_sides(sides: list[Side], run: str) -> str:
    """A table of both, below the description ``run``."""
    lines = [run, f"{'':>18} {'steps/s':>10} {'M steps':>8} {'wall s':>7} {'laps':>8}  threads"]
    for side in sides:
        completed = (
            f"{side.lap_total:.2f} s"
            if side.lap_total is not None
            else f"{side.laps_completed} of {side.laps}"
        )
        lines.append(
            f"{side.name:>18} {side.steps_per_second:>10,.0f} {side.steps / 1e6:>8.1f} "
            f"{side.seconds:>7.0f} {completed:>8}  {side.threads}"
        )
    return "\n".join(lines)
