"""Short trainings, of one shape for each learner, so that they are compiled once."""

import quadjax

OF_EACH = (
    "run.devices=1",
    "run.steps=512",
    "run.evaluate_every=128",
    "run.checkpoint_seconds=0",
    "learner.num_envs=16",
    "network.hidden=[8]",
    "evaluate.laps=1",
)
OF_LEARNER = {
    "ppo": ("learner.rollout_length=8", "learner.num_minibatches=2", "learner.num_epochs=1"),
    "shac": ("learner.horizon=4", "learner.critic_minibatches=2", "learner.critic_epochs=1"),
}


def short(preset: str, *overrides: str) -> list[str]:
    """A preset and the overrides that make its training take seconds, for a command line."""
    algorithm = quadjax.load(preset, overrides).learner.algorithm
    return [preset, *OF_EACH, *OF_LEARNER[algorithm], *overrides]


def short_config(preset: str, *overrides: str) -> quadjax.Config:
    """The config of a short training."""
    name, *words = short(preset, *overrides)
    return quadjax.load(name, words)
