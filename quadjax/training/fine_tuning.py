"""Training that continues from a policy: schedules at their ends, falling learning rates."""

from pathlib import Path

from quadjax.config.checks import with_scheduled_values
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.learners.schedules import Schedule
from quadjax.policy.file import Policy

FIRST_RATE = 0.3  # of the config's learning rates, at the start
RATES = ("learning_rate", "critic_learning_rate")


def check_policy(config: Config, policy: Path | str) -> None:
    """Refuse a policy without a critic, and a config with another initial policy."""
    if config.run.initial_policy is not None:
        raise InputError("--fine-tune and run.initial_policy exclude each other")
    if Policy.load(policy).value is None:
        raise InputError(
            f"--fine-tune: {policy} has no critic, allowed: a policy with one; "
            f"run.initial_policy={policy} starts with an untrained critic"
        )


def fine_tuning(config: Config, policy: Path | str) -> Config:
    """The config of a training that continues from a policy file, and from its critic.

    Each scheduled number has its last value. The learning rates start at ``FIRST_RATE`` of the
    config's and end at zero.

    Args:
        config: the race in which the policy is to fly.
        policy: file of the policy.
    """
    last = with_scheduled_values(config)
    rates = [name for name in RATES if name in type(config.learner).model_fields]
    first = {name: FIRST_RATE * getattr(config.learner, name) for name in rates}
    return last.replace(
        learner=last.learner.replace(**first),
        schedules={f"learner.{name}": Schedule(linear=("value", 0.0)) for name in rates},
        run=last.run.replace(initial_policy=str(policy)),
    )
