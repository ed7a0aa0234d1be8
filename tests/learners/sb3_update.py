"""One update of PPO by Stable-Baselines3, minibatch by minibatch, with all that it is made of.

``python -m tests.learners.sb3_update`` writes the file that ``test_sb3_update.py`` reads. It needs
Stable-Baselines3 (``pip install 'quadjax[sb3]'``).
"""

from pathlib import Path
from unittest import mock

import gymnasium
import jax
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.sb3_ppo import make_ppo
from quadjax.config.loading import load_config

FILE = Path(__file__).with_suffix(".npz")
# Overrides of e2e_paper. With so little noise, 12 steps move the ratio of the densities beyond the
# clip range.
SMALL = [
    *("network.hidden=[16, 16, 16]", "learner.num_envs=8", "learner.rollout_length=64"),
    *("learner.num_minibatches=4", "learner.num_epochs=3", "learner.initial_log_std=-3.0"),
]
PUBLISHED = [  # 100 environments, 3 x 120, minibatches of 5,000 rows; a shorter rollout
    *("learner.rollout_length=200", "learner.num_minibatches=4", "learner.num_epochs=1"),
]
KEY = 0  # of the state that quadjax updates: the order of the rows follows from it


class Replay(VecEnv):
    """Drawn observations, rewards and ends of episodes, whatever the actions."""

    def __init__(self, learner, observations, actions):
        time, n = learner.rollout_length, learner.num_envs
        draw = np.random.default_rng(0)
        self.observation, other = draw.normal(size=(2, time + 1, n, observations)).astype("f4")
        self.reward = draw.normal(size=(time, n)).astype("f4")
        kind = draw.uniform(size=(time, n))
        self.terminated, self.truncated = kind < 0.03, (kind > 0.03) & (kind < 0.06)
        ended = (self.terminated | self.truncated)[..., None]
        self.next_observation = np.where(ended, other[1:], self.observation[1:])  # before any reset
        self.render_mode = None
        unbounded = gymnasium.spaces.Box(-np.inf, np.inf, (observations,))
        super().__init__(n, unbounded, gymnasium.spaces.Box(-1.0, 1.0, (actions,)))

    def reset(self):
        self.step_number = 0
        return self.observation[0]

    def step_async(self, actions):
        pass

    def step_wait(self):
        now, self.step_number = self.step_number, self.step_number + 1
        done = self.terminated[now] | self.truncated[now]
        infos = [{} for _ in done]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": self.next_observation[now, index],
                "TimeLimit.truncated": bool(self.truncated[now, index]),
            }
        return self.observation[now + 1], self.reward[now].copy(), done, infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *arguments, indices=None, **named):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def flat(policy, of):
    """A number of every parameter, ``of(parameter)``, under the parameter's name in quadjax."""
    body = policy.mlp_extractor
    heads = {
        "actor": [*body.policy_net, policy.action_net],
        "critic": [*body.value_net, policy.value_net],
    }
    named = {"log_std": of(policy.log_std)}
    for part, modules in heads.items():
        layers = [module for module in modules if isinstance(module, torch.nn.Linear)]
        for index, layer in enumerate(layers):
            named[f"{part}/Dense_{index}/kernel"] = of(layer.weight).T
            named[f"{part}/Dense_{index}/bias"] = of(layer.bias)
    return {name: x.detach().numpy().copy() for name, x in named.items()}


def orders(learner):
    """The rows of every epoch as ``quadjax.learners.ppo`` shuffles them."""
    shuffle_key = jax.random.split(jax.random.key(KEY), 3)[2]
    keys = jax.random.split(shuffle_key, learner.num_epochs)
    count = learner.num_envs * learner.rollout_length
    return [np.asarray(jax.random.permutation(key, count)) for key in keys]


def spied(module, name, record):
    """A function that also passes its results to ``record``."""
    original = getattr(module, name)

    def spy(*arguments, **named):
        result = original(*arguments, **named)
        record(result)
        return result

    return mock.patch.object(module, name, spy)


def make_trace(overrides, observations, actions):
    """Collect a rollout, learn from it, and record both; axes (time, n, ...) or (minibatches, ...).

    Returns:
        The overrides of ``e2e_paper``; the rollout; ``start/NAME``, ``param/NAME`` and
        ``moment/NAME``: each parameter before the update, and itself and Adam's first moment after
        every minibatch; ``policy_loss`` and ``value_loss`` of every minibatch.
    """
    torch.set_num_threads(1)  # several wait for each other where other programs use the cores
    config = load_config("e2e_paper", overrides)
    env = Replay(config.learner, observations, actions)
    model = make_ppo(config, env)
    policy, optimizer = model.policy, model.policy.optimizer
    start = flat(policy, lambda x: x)
    after, policy_losses, value_losses = [], [], []

    def stepped(_):
        moments = flat(policy, lambda x: optimizer.state[x]["exp_avg"])
        after.append((flat(policy, lambda x: x), moments))

    order = iter(orders(config.learner))
    with (
        spied(optimizer, "step", stepped),
        spied(torch, "min", lambda x: policy_losses.append(-x.mean().item())),
        spied(torch.nn.functional, "mse_loss", lambda x: value_losses.append(x.item())),
        mock.patch.object(np.random, "permutation", lambda count: next(order)),
    ):
        model.learn(env.num_envs * model.n_steps)
    names = ("observation", "next_observation", "reward", "terminated", "truncated")
    trace = {"overrides": np.array(overrides)} | {name: getattr(env, name) for name in names}
    for name in ("actions", "log_probs", "values", "returns"):
        x = getattr(model.rollout_buffer, name)  # (n time, 1 or actions)
        x = x.reshape(env.num_envs, model.n_steps, -1).swapaxes(0, 1)
        trace[name] = x if name == "actions" else x[..., 0]
    trace |= {f"start/{name}": x for name, x in start.items()}
    for kind, found in zip(("param", "moment"), zip(*after, strict=True), strict=True):
        trace |= {f"{kind}/{name}": np.stack([x[name] for x in found]) for name in start}
    losses = {"policy_loss": policy_losses, "value_loss": value_losses}
    return trace | {name: np.float32(x) for name, x in losses.items()}


if __name__ == "__main__":
    np.savez_compressed(FILE, **make_trace(SMALL, observations=6, actions=2))
    print(f"{FILE}: {FILE.stat().st_size:,} bytes")
