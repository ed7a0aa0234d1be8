"""Hyperparameters of PPO: declared once, for configs and for ``quadjax.PPO``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

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


class PPO(LearnerSection):
    """Proximal policy optimization (Schulman et al., 2017)."""

    algorithm: Literal["ppo"] = Field("ppo", description="proximal policy optimization")
    num_envs: NumEnvs = 1024
    rollout_length: Annotated[Count, Unit("steps")] = Field(
        64, description="steps of each environment per update"
    )
    num_minibatches: Count = Field(8, description="minibatches per epoch")
    num_epochs: int = Field(5, ge=1, le=1000, description="passes over the data of an update")
    shuffle_block: Count | None = Field(
        None,
        description="consecutive steps of an environment that stay together when minibatches are "
        "drawn; null: all steps of an update",
    )
    learning_rate: Fraction = Field(7e-4, description="step size of Adam")
    adam_epsilon: float = Field(1e-5, gt=0, le=1, description="epsilon of Adam")
    discount: Discount = 0.99
    gae_lambda: Fraction = Field(0.95, description="lambda of generalized advantage estimation")
    clip_range: float = Field(
        0.2, gt=0, le=100, description="the probability ratio is clipped to 1 +- clip_range"
    )
    value_coefficient: float = Field(0.5, ge=0, le=1e6, description="weight of the value loss")
    entropy_coefficient: float = Field(0.0, ge=0, le=1e6, description="weight of the entropy bonus")
    max_grad_norm: Positive = Field(
        0.5, description="gradients are scaled to at most this global norm"
    )
    separate_grad_clip: bool = Field(
        True,
        description="clip the gradients of policy and value each by its own norm; false: by their "
        "common norm",
    )
    max_kl: Positive | None = Field(
        0.03,
        description="a minibatch whose estimated KL divergence from the policy before the update "
        "is larger is skipped; null: none is",
    )
    reward_scale: RewardScale = 1.0
    critic_warmup: Warmup = 0
    initial_log_std: float = Field(
        0.0,
        ge=-20,
        le=5,
        description="initial logarithm of the standard deviation of the action noise",
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        block = self.shuffle_block or self.rollout_length
        blocks = self.num_envs * (self.rollout_length // block)
        check_divisor("shuffle_block", block, self.rollout_length, "rollout_length")
        check_divisor("num_minibatches", self.num_minibatches, blocks, "blocks of an update")
        return self

    def make(self, environment: Environment, networks: Networks, num_updates: int) -> Learner:
        """The learner on an environment; see ``LearnerSection.make``."""
        from quadjax.learners.ppo.update import make_learner

        return make_learner(environment, networks, self)
