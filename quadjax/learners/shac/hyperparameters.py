"""Hyperparameters of SHAC: declared once, for configs and for ``quadjax.SHAC``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from quadjax.core.sections import LARGEST, Field, Unit, model_validator
from quadjax.learners.section import MAX_ENVS, MAX_UPDATE_STEPS, LearnerSection

if TYPE_CHECKING:
    from quadjax.core.environment import Environment
    from quadjax.learners.networks import Networks
    from quadjax.learners.state import Learner


class SHAC(LearnerSection):
    """Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""

    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "clipped_mean"

    algorithm: Literal["shac"] = Field("shac", description="short-horizon actor-critic")
    num_envs: Annotated[int, Unit("environments")] = Field(
        256, ge=1, le=MAX_ENVS, description="number of environments simulated in parallel"
    )
    horizon: Annotated[int, Unit("steps")] = Field(
        48,
        ge=1,
        le=4096,
        description="steps of each environment per update, through which gradients flow",
    )
    learning_rate: float = Field(3e-3, ge=0, le=1, description="step size of the policy's Adam")
    adam_b1: float = Field(0.7, ge=0, lt=1, description="decay of Adam's first moment")
    adam_b2: float = Field(0.95, ge=0, lt=1, description="decay of Adam's second moment")
    max_grad_norm: float = Field(
        1.0,
        gt=0,
        le=LARGEST,
        description="the policy's gradient is scaled to at most this global norm",
    )
    critic_learning_rate: float = Field(
        3e-3, ge=0, le=1, description="step size of the critic's Adam"
    )
    critic_max_grad_norm: float = Field(
        1.0,
        gt=0,
        le=LARGEST,
        description="the critic's gradient is scaled to at most this global norm",
    )
    critic_epochs: int = Field(
        4, ge=1, le=1000, description="passes of the critic over the data of an update"
    )
    critic_minibatches: int = Field(
        4, ge=1, le=100_000, description="minibatches of the critic per epoch"
    )
    target_update_rate: float = Field(
        0.2,
        ge=0,
        le=1,
        description="part of the way that the target critic moves to the critic per update",
    )
    td_lambda: float = Field(0.95, ge=0, le=1, description="lambda of the critic's TD targets")
    discount: Annotated[float, Unit("decay")] = Field(
        0.99, ge=0, lt=1, description="discount factor per step"
    )
    cotangent_decay: Annotated[float, Unit("decay")] = Field(
        0.95,
        ge=0,
        le=1,
        description="factor per step on the gradient that flows back through the state",
    )
    cotangent_clip: Annotated[float, Unit("1/m")] = Field(
        0.02,
        gt=0,
        le=LARGEST,
        description="largest entry of the gradient that flows back through the state, in units of "
        "the scaled return",
    )
    std: float = Field(
        0.3, gt=0, le=100, description="standard deviation of the action noise (actions: -1 to 1)"
    )
    reward_scale: float = Field(
        0.1, gt=0, le=LARGEST, description="factor on the reward in training"
    )
    ema_rate: float = Field(
        1.0,
        ge=1e-4,
        le=1,
        description="weight of the newest parameters in the exponential moving average that is "
        "evaluated and saved, per update; 1: no averaging",
    )
    critic_warmup: int = Field(
        0, ge=0, le=10**9, description="updates at the start that train the critic only"
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        if self.num_envs * self.horizon > MAX_UPDATE_STEPS:
            raise ValueError(
                f"num_envs is {self.num_envs} and horizon {self.horizon}, allowed: a product of "
                f"at most {MAX_UPDATE_STEPS}"
            )
        if self.num_envs % self.critic_minibatches:
            raise ValueError(
                f"critic_minibatches is {self.critic_minibatches}, allowed: a divisor of num_envs "
                f"{self.num_envs}"
            )
        return self

    def make(self, environment: Environment, networks: Networks, num_updates: int) -> Learner:
        """The learner on an environment; see ``LearnerSection.make``."""
        from quadjax.learners.shac.update import make_learner

        return make_learner(environment, networks, self)
