"""Training that continues from a policy: schedules at their ends, falling learning rates."""

from pathlib import Path

from quadjax.config.checks import with_scheduled_values
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import policy_file
from quadjax.learners.schedules import Schedule
from quadjax.policy.file import Policy

FIRST_RATE_FACTOR = 0.3  # of the config's learning rates, at the start
RATES = ("learning_rate", "critic_learning_rate")


def fine_tuning(config: Config, policy: Path | str) -> Config:
    """The config of a training that continues from a policy file, and from its critic.

    Each scheduled number has its last value. The learning rates start at ``FIRST_RATE_FACTOR``
    of the config's and end at zero. ``train`` runs the config, as ``quadjax train --fine-tune``
    does.

    Args:
        config: the race in which the policy is to fly.
        policy: its file, the folder of its run, or the name of a shipped policy.

    Raises:
        InputError: a policy without a critic, or a config with another initial policy.
    """
    if config.run.initial_policy is not None:
        raise InputError("run.initial_policy is set; fine-tuning sets it to the policy")
    file = policy_file(policy)
    if not Policy.load(file).has_critic:
        raise InputError(
            f"{file} has no critic, which fine-tuning needs; "
            f"run.initial_policy={file} starts with an untrained critic"
        )
    last = with_scheduled_values(config)
    rates = [name for name in RATES if name in type(config.learner).model_fields]
    first = {name: FIRST_RATE_FACTOR * getattr(config.learner, name) for name in rates}
    return last.replace(
        learner=last.learner.replace(**first),
        schedules={f"learner.{name}": Schedule(linear=("value", 0.0)) for name in rates},
        run=last.run.replace(initial_policy=str(file)),
    )
