"""PPO of quadjax and of Stable-Baselines3 on the same task, for the same time or steps."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.race import make_race
from quadjax.config.schema import Config
from quadjax.evaluation.curves import training_figure
from quadjax.evaluation.evaluation import evaluate
from quadjax.learners.parallel import core_count
from quadjax.policy.file import Policy
from quadjax.training.build import untrained_policy
from quadjax.training.score import score_runs

if TYPE_CHECKING:
    from stable_baselines3.common.callbacks import BaseCallback

SEED = 0
CURVE = ("steps", "seconds", "reward", "lap_total")  # of metrics.csv, at every update

Curve = dict[str, list[float | None]]  # by name of CURVE; None for infinite


@dataclasses.dataclass(frozen=True)
class Side:
    """Result of one library."""

    name: str
    threads: str
    seconds: float  # of wall time, with set-up and compilation
    processor_seconds: float  # user and system, likewise
    steps: int
    steps_per_second: float  # of training, after the first update
    lap_total: float | None  # s, all laps, deterministic from hover; None if not finished
    laps_completed: int
    laps: int
    curve: Curve  # reward per step of the rollouts; lap times as run.score, mean action from hover


def _evaluate(config: Config, policy: Policy) -> tuple[float | None, int]:
    laps = evaluate(policy, config, runs=1, deterministic=True).laps
    total = float(laps.totals[0])
    return (total if laps.finished else None), int(laps.laps_completed()[0])


class Clock:
    """Steps over time, and limits of both."""

    def __init__(self, started: float, seconds: float, steps: int = 0) -> None:
        """Start at ``started``, by ``time.monotonic()``, for ``seconds`` or ``steps`` (0: any)."""
        self._started, self._seconds, self._steps = started, seconds, steps
        self._marks: list[tuple[float, int]] = [(started, 0)]

    def over(self, steps: int) -> bool:
        """Whether a limit is reached; called after an update."""
        now = time.monotonic()
        self._marks.append((now, steps))
        return now - self._started >= self._seconds or 0 < self._steps <= steps

    @property
    def steps(self) -> int:
        """Steps until the last update."""
        return int(self._marks[-1][1])

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


def ours(config: Config, clock: Clock, started: float, directory: Path) -> Side:
    """Train with quadjax and evaluate the last policy.

    Args:
        config: with one update per chunk, so that the clock is read after each.
        clock: with the limits.
        started: by ``time.monotonic()``.
        directory: of the run.
    """
    from quadjax.training.run import train

    result = train(config, directory, started=started, enough=lambda row: clock.over(row["steps"]))
    policy = Policy.load(directory / "policy_last.npz")
    threads = f"{result.summary['devices']} host devices of one thread"
    curve = {name: result.metrics[name].tolist() for name in CURVE}
    return _side("quadjax", threads, config, policy, clock, curve)


def _side(
    name: str,
    threads: str,
    config: Config,
    policy: Policy,
    clock: Clock,
    curve: dict[str, list[float]],
) -> Side:
    processor = time.process_time()
    total, completed = _evaluate(config, policy)
    finite = {key: [x if np.isfinite(x) else None for x in column] for key, column in curve.items()}
    return Side(
        name,
        threads,
        clock.seconds,
        processor,
        clock.steps,
        clock.speed,
        total,
        completed,
        config.evaluate.laps,
        finite,
    )


def _recorder(config: Config, clock: Clock, started: float) -> "BaseCallback":
    """A callback of Stable-Baselines3 with the curve, which stops when a limit is reached."""
    from stable_baselines3.common.callbacks import BaseCallback

    from quadjax.integrations.sb3 import policy_of_ppo

    like, runs = untrained_policy(config), score_runs(config)

    class Recorder(BaseCallback):
        """Evaluates the policy and reads the clock after each update."""

        def __init__(self) -> None:
            super().__init__()
            self.done = False
            self.rewards: list[float] = []
            self.curve: dict[str, list[float]] = {name: [] for name in CURVE}

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                policy = policy_of_ppo(self.model, like)
                score = evaluate(policy, config, runs=runs, deterministic=True).laps.score
                self.done = clock.over(self.num_timesteps)
                seconds, reward = time.monotonic() - started, float(np.mean(self.rewards))
                row = (float(self.num_timesteps), seconds, reward, score)
                for name, value in zip(CURVE, row, strict=True):
                    self.curve[name].append(value)
                self.rewards.clear()

        def _on_step(self) -> bool:
            self.rewards.append(float(self.locals["rewards"].mean()))
            return not self.done

    return Recorder()


def stable_baselines(config: Config, clock: Clock, started: float) -> Side:
    """Train with Stable-Baselines3, PyTorch on all cores, and evaluate the last policy.

    Args:
        config: the race and the hyperparameters.
        clock: with the limits.
        started: by ``time.monotonic()``.
    """
    import torch

    from quadjax.integrations import sb3

    torch.set_num_threads(core_count())
    model = sb3.make_ppo(*make_race(config), config.learner, config.network, SEED)
    recorder = _recorder(config, clock, started)
    model.learn(config.run.steps, callback=recorder)
    policy = sb3.policy_of_ppo(model, untrained_policy(config))
    threads = f"PyTorch {torch.get_num_threads()} threads, the race in JAX on one device"
    return _side("Stable-Baselines3", threads, config, policy, clock, recorder.curve)


def curves_figure(sides: list[Side], title: str) -> Figure:
    """Reward and lap time of both against wall time and environment steps."""
    curves = {
        side.name: {
            key: np.array([np.inf if x is None else x for x in column], np.float64)
            for key, column in side.curve.items()
        }
        for side in sides
    }
    return training_figure(curves, title)


def format_sides(sides: list[Side], run: str) -> str:
    """A table of both, below the description ``run``."""
    lines = [
        run,
        f"{'':>18} {'steps/s':>9} {'M steps':>8} {'wall s':>7} {'CPU s':>6} {'laps':>8}  threads",
    ]
    for side in sides:
        completed = (
            f"{side.lap_total:.2f} s"
            if side.lap_total is not None
            else f"{side.laps_completed} of {side.laps}"
        )
        lines.append(
            f"{side.name:>18} {side.steps_per_second:>9,.0f} {side.steps / 1e6:>8.1f} "
            f"{side.seconds:>7.0f} {side.processor_seconds:>6.0f} {completed:>8}  {side.threads}"
        )
    return "\n".join(lines)
