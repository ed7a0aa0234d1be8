"""Hyperparameters of SHAC: declared once, for configs and for ``quadjax.SHAC``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from quadjax.core.sections import Field, Fraction, Positive, Unit, model_validator
from quadjax.learners.section import (
    Count,
    Discount,
    LearnerSection,
    NumEnvs,
    RewardScale,
    Warmup,
    check_divisor,
)

if TYPE_CHECKING:
    from quadjax.core.environment import Environment
    from quadjax.learners.networks import Networks
    from quadjax.learners.state import Learner


class SHAC(LearnerSection):
    """Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""

    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "clipped_mean"

    algorithm: Literal["shac"] = Field("shac", description="short-horizon actor-critic")
    num_envs: NumEnvs = 256
    horizon: Annotated[int, Unit("steps")] = Field(
        48,
        ge=1,
        le=4096,
        description="steps of each environment per update, through which gradients flow",
    )
    learning_rate: Fraction = Field(3e-3, description="step size of the policy's Adam")
    adam_b1: float = Field(0.7, ge=0, lt=1, description="decay of Adam's first moment")
    adam_b2: float = Field(0.95, ge=0, lt=1, description="decay of Adam's second moment")
    max_grad_norm: Positive = Field(
        1.0, description="the policy's gradient is scaled to at most this global norm"
    )
    critic_learning_rate: Fraction = Field(3e-3, description="step size of the critic's Adam")
    critic_max_grad_norm: Positive = Field(
        1.0, description="the critic's gradient is scaled to at most this global norm"
    )
    critic_epochs: int = Field(
        4, ge=1, le=1000, description="passes of the critic over the data of an update"
    )
    critic_minibatches: Count = Field(4, description="minibatches of the critic per epoch")
    target_update_rate: Fraction = Field(
        0.2,
        description="fraction of the distance that the target critic moves toward the critic per "
        "update",
    )
    td_lambda: Fraction = Field(0.95, description="lambda of the critic's TD targets")
    discount: Discount = 0.99
    cotangent_decay: Annotated[Fraction, Unit("decay")] = Field(
        0.95, description="factor per step on the gradient that flows back through the state"
    )
    cotangent_clip: Annotated[Positive, Unit("1/m")] = Field(
        0.02,
        description="largest entry of the gradient that flows back through the state, in units of "
        "the scaled return",
    )
    std: float = Field(
        0.3, gt=0, le=100, description="standard deviation of the action noise (actions: -1 to 1)"
    )
    reward_scale: RewardScale = 0.1
    ema_rate: float = Field(
        1.0,
        ge=1e-4,
        le=1,
        description="weight of the newest parameters in the exponential moving average that is "
        "evaluated and saved, per update; 1: no averaging",
    )
    critic_warmup: Warmup = 0

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        check_divisor("critic_minibatches", self.critic_minibatches, self.num_envs, "num_envs")
        return self

    def make(self, environment: Environment, networks: Networks, num_updates: int) -> Learner:
        """The learner on an environment; see ``LearnerSection.make``."""
        from quadjax.learners.shac.update import make_learner

        return make_learner(environment, networks, self)
