"""Hyperparameters of PPO: declared once, for configs and for ``quadjax.PPO``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from quadjax.core.sections import LARGEST, Field, Unit, model_validator
from quadjax.learners.section import MAX_ENVS, MAX_UPDATE_STEPS, LearnerSection

if TYPE_CHECKING:
    from quadjax.core.environment import Environment
    from quadjax.learners.networks import Networks
    from quadjax.learners.state import Learner


class PPO(LearnerSection):
    """Proximal policy optimization (Schulman et al., 2017)."""

    algorithm: Literal["ppo"] = Field("ppo", description="proximal policy optimization")
    num_envs: Annotated[int, Unit("environments")] = Field(
        1024, ge=1, le=MAX_ENVS, description="number of environments simulated in parallel"
    )
    rollout_length: Annotated[int, Unit("steps")] = Field(
        64, ge=1, le=100_000, description="steps of each environment per update"
    )
    num_minibatches: int = Field(8, ge=1, le=100_000, description="minibatches per epoch")
    num_epochs: int = Field(5, ge=1, le=1000, description="passes over the data of an update")
    shuffle_block: int | None = Field(
        None,
        ge=1,
        le=100_000,
        description="consecutive steps of an environment that stay together when minibatches are "
        "drawn; null: all steps of an update",
    )
    learning_rate: float = Field(7e-4, ge=0, le=1, description="step size of Adam")
    adam_epsilon: float = Field(1e-5, gt=0, le=1, description="epsilon of Adam")
    discount: Annotated[float, Unit("decay")] = Field(
        0.99, ge=0, lt=1, description="discount factor per step"
    )
    gae_lambda: float = Field(
        0.95, ge=0, le=1, description="lambda of generalized advantage estimation"
    )
    clip_range: float = Field(
        0.2, gt=0, le=100, description="the probability ratio is clipped to 1 +- clip_range"
    )
    value_coefficient: float = Field(0.5, ge=0, le=1e6, description="weight of the value loss")
    entropy_coefficient: float = Field(0.0, ge=0, le=1e6, description="weight of the entropy bonus")
    max_grad_norm: float = Field(
        0.5, gt=0, le=LARGEST, description="gradients are scaled to at most this global norm"
    )
    separate_grad_clip: bool = Field(
        True,
        description="clip the gradients of policy and value each by its own norm; false: by their "
        "common norm",
    )
    max_kl: float | None = Field(
        0.03,
        gt=0,
        le=LARGEST,
        description="a minibatch whose estimated KL divergence from the policy before the update "
        "is larger is skipped; null: none is",
    )
    reward_scale: float = Field(
        1.0, gt=0, le=LARGEST, description="factor on the reward in training"
    )
    critic_warmup: int = Field(
        0, ge=0, le=10**9, description="updates at the start that train the value only"
    )
    initial_log_std: float = Field(
        0.0,
        ge=-20,
        le=5,
        description="initial logarithm of the standard deviation of the action noise",
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        if self.num_envs * self.rollout_length > MAX_UPDATE_STEPS:
            raise ValueError(
                f"num_envs is {self.num_envs} and rollout_length {self.rollout_length}, allowed: "
                f"a product of at most {MAX_UPDATE_STEPS}"
            )
        block = self.shuffle_block or self.rollout_length
        if self.rollout_length % block:
            raise ValueError(
                f"shuffle_block is {block}, allowed: a divisor of rollout_length "
                f"{self.rollout_length}"
            )
        blocks = self.num_envs * (self.rollout_length // block)
        if blocks % self.num_minibatches:
            raise ValueError(
                f"num_minibatches is {self.num_minibatches}, allowed: a divisor of the {blocks} "
                f"blocks of an update (num_envs {self.num_envs} x {self.rollout_length // block})"
            )
        return self

    def make(self, environment: Environment, networks: Networks, num_updates: int) -> Learner:
        """The learner on an environment; see ``LearnerSection.make``."""
        from quadjax.learners.ppo.update import make_learner

        return make_learner(environment, networks, self)
