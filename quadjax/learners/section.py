"""The base class of the learners' hyperparameters, and the section of the networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from quadjax.core.sections import LARGEST, Field, Section, Unit

if TYPE_CHECKING:  # JAX is imported when it is used
    from quadjax.core.environment import Environment
    from quadjax.learners.networks import Networks
    from quadjax.learners.state import Learner
    from quadjax.learners.train import TrainResult

MAX_ENVS = 1_000_000
Value = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Width = Annotated[int, Field(ge=1, le=8192)]
Count = Annotated[int, Field(ge=1, le=100_000)]
NumEnvs = Annotated[
    int,
    Unit("environments"),
    Field(ge=1, le=MAX_ENVS, description="number of environments simulated in parallel"),
]
Discount = Annotated[
    float, Unit("decay"), Field(ge=0, lt=1, description="discount factor per step")
]
RewardScale = Annotated[
    float, Field(gt=0, le=LARGEST, description="factor on the reward in training")
]
Warmup = Annotated[
    int, Field(ge=0, le=10**9, description="updates at the start that train the value only")
]


class Network(Section):
    """Policy and value networks: two separate multilayer perceptrons of the same widths."""

    hidden: tuple[Width, ...] = Field(
        (64, 64, 64), min_length=1, max_length=16, description="units of each hidden layer"
    )
    activation: Literal["relu", "tanh"] = Field(
        "relu", description="activation of the hidden layers"
    )
    normalize: bool = Field(
        False,
        description="train on lengths in legs and on times in leg times of the race; the policy "
        "file takes plain units all the same",
    )


class Curriculum(Section):
    """The level that schedules with ``by: pass_rate`` follow: from 0, the start, to 1."""

    pass_rate: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="the level rises while at least this share of gates is passed: gates passed, "
        "divided by gates passed and crashes (and finished courses)",
    )
    duration: float = Field(
        0.25, gt=0, le=1, description="shortest time from level 0 to 1, as a fraction of the run"
    )


class Schedule(Section):
    """Values of one number during training: a hyperparameter, or one of the environment."""

    linear: tuple[Value | Literal["value"], ...] = Field(
        min_length=2,
        max_length=64,
        description="values at equal distances, linear in between; value: the key's own",
    )
    start: float = Field(
        0.0,
        alias="from",
        ge=0,
        le=1e12,
        description="when the first value ends: up to 1 a fraction of the run, above 1 steps",
    )
    until: float = Field(
        1.0, gt=0, le=1e12, description="when the last value is reached: as from; 1 is the end"
    )
    by: Literal["steps", "pass_rate"] = Field(
        "steps",
        description="what the schedule follows: the steps of the run, or a level from 0 to 1 that "
        "rises while the share of gates passed is above curriculum.pass_rate, and falls while it "
        "is below",
    )

    def knots(self, run_steps: int, total: int) -> list[float]:
        """Environment steps, or levels, of the values.

        Args:
            run_steps: ``run.steps``, to which fractions refer.
            total: steps at the end of the run, a whole number of chunks.
        """
        begin, end = self.start, self.until
        if self.by == "steps":
            begin, end = (
                float(total) if x == 1 else x if x > 1 else min(x * run_steps, total)
                for x in (begin, end)
            )
        last = len(self.linear) - 1
        return [begin + (end - begin) * i / last for i in range(last + 1)]


Schedules = Mapping[str, Schedule | Sequence[float | Literal["value"]]]


class LearnerSection(Section):
    """Hyperparameters of a learner, which make the learner and train it.

    Fields of ``float`` or ``float | None`` are traced: other numbers do not trigger recompilation,
    and schedules can change them. All others fix shapes or code, and so does None.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A hyperparameter of the learner's own class."""

    # What action noise is added to. PPO's is learned and added to the network's output; far beyond
    # the limits it has no effect, so a policy can become deterministic. SHAC's is not learned and
    # added to the clipped mean, so that exploration continues at a limit. Both learners are much
    # worse with the other choice.
    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "mean"

    algorithm: str = Field("", description="ppo, shac, or module:Class of a learner of your own")

    def make(self, environment: Environment, networks: Networks, num_updates: int) -> Learner:
        """The learner on an environment.

        Args:
            environment: three pure functions of one agent.
            networks: the policy and the value.
            num_updates: of the whole run.
        """
        raise NotImplementedError

    def train(
        self,
        environment: Environment,
        params: object,
        steps: int,
        seed: int = 0,
        network: Network | Networks | None = None,
        schedules: Schedules | None = None,
        progress: Callable[[Mapping[str, float]], None] | None = None,
    ) -> TrainResult:
        """Train on any environment; see ``quadjax.learners.train.train``."""
        from quadjax.learners.train import train

        return train(self, environment, params, steps, seed, network, schedules, progress)


def check_divisor(name: str, value: int, total: int, of: str) -> None:
    """Raise a ``ValueError`` if a hyperparameter does not divide ``total``, the number ``of``."""
    if total % value:
        raise ValueError(f"{name} is {value}, allowed: a divisor of {total} ({of})")
