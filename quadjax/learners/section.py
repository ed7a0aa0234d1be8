"""The base class of the learners' hyperparameters, and the section of the networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from quadjax.core.sections import Field, Section

if TYPE_CHECKING:  # JAX is imported when it is used
    from quadjax.core.environment import Environment
    from quadjax.learners.networks import Networks
    from quadjax.learners.state import Learner
    from quadjax.learners.train import Schedules, TrainResult

MAX_ENVS = 1_000_000
MAX_UPDATE_STEPS = 250_000_000  # environment steps of an update, all of which are in memory at once
Width = Annotated[int, Field(ge=1, le=8192)]


class Network(Section):
    """Policy and value networks: two separate multilayer perceptrons of the same widths."""

    hidden: tuple[Width, ...] = Field(
        (64, 64, 64), min_length=1, max_length=16, description="units of each hidden layer"
    )
    activation: Literal["relu", "tanh"] = Field(
        "relu", description="activation of the hidden layers"
    )


class LearnerSection(Section):
    """Hyperparameters of a learner, which make the learner and train it.

    Fields annotated ``float`` are traced: other values do not trigger recompilation, and
    schedules can change them. All others fix shapes or code.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A hyperparameter of the learner's own class."""

    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "mean"  # what action noise is added to

    algorithm: str = Field("", description="ppo, shac, or module:Class of a learner of your own")

    def make(
        self,
        environment: Environment,
        networks: Networks,
        num_updates: int,
        max_shards: int = 8,
    ) -> Learner:
        """The learner on an environment.

        Args:
            environment: three pure functions of one agent.
            networks: the policy and the value.
            num_updates: of the whole run.
            max_shards: upper bound of the number of equal parts of the environments, each with its
                own PRNG key, that devices can share; a power of two.
        """
        raise NotImplementedError

    def train(
        self,
        environment: Environment,
        params: object,
        steps: int,
        seed: int = 0,
        network: Network | None = None,
        schedules: Schedules | None = None,
        progress: Callable[[Mapping[str, float]], None] | None = None,
    ) -> TrainResult:
        """Train on any environment; see ``quadjax.learners.train.train``."""
        from quadjax.learners.train import train

        return train(self, environment, params, steps, seed, network, schedules, progress)
