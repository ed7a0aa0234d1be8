"""Hyperparameters as config sections."""

import pytest

from quadjax.core.errors import InputError
from quadjax.core.sections import build
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.shac.hyperparameters import SHAC


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        (PPO, {"num_envs": 0}, "num_envs is 0, allowed: greater than or equal to 1"),
        (PPO, {"num_epochs": 1e20}, "num_epochs is "),
        (PPO, {"num_envs": 10**7}, "num_envs is 10000000"),
        (PPO, {"num_envs": 3}, "num_minibatches is 8, allowed: a divisor of 3 (blocks of"),
        (
            PPO,
            {"shuffle_block": 7},
            "shuffle_block is 7, allowed: a divisor of 64 (rollout",
        ),
        (PPO, {"clip": 0.2}, "unknown key clip"),
        (PPO, {"discount": 1.0}, "discount is 1, allowed: less than 1"),
        (SHAC, {"horizon": 1e20}, "horizon is "),
        (SHAC, {"num_envs": 6}, "critic_minibatches is 4, allowed: a divisor of 6 (num_envs)"),
        (SHAC, {"num_envs": 10**6}, None),
        (SHAC, {"std": 0}, "std is 0"),
        (SHAC, {"algorithm": "ppo"}, "algorithm is 'ppo'"),
        (PPO, {"max_kl": None, "num_envs": 2e3}, None),
    ],
)
def test_bounds(section, values, message):
    if message is None:
        build(section, values, "here.yaml")
        return
    with pytest.raises(InputError) as caught:
        build(section, values, "here.yaml")
    assert message in str(caught.value) and "\n" not in str(caught.value)
