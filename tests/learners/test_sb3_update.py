"""One update of PPO on the same rollout is that of Stable-Baselines3, minibatch by minibatch.

With the hyperparameters of ``e2e_paper``: on a stored trace, and where Stable-Baselines3 is
installed, on a new one with the published networks and minibatches of 5,000 rows.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict, unflatten_dict

from quadjax.config.loading import load_config
from quadjax.core.environment import Environment
from quadjax.core.traced import as_leaves
from quadjax.learners.networks import mean_action, predict_value
from quadjax.learners.ppo import PPO, log_probability
from quadjax.learners.rollout import Trajectory, td_lambda
from quadjax.learners.state import Task

TOLERANCE = 1e-5
FILE = Path(__file__).with_name("sb3_update.npz")  # of ``python -m tests.learners.sb3_update``


@dataclasses.dataclass(frozen=True)
class Still(Environment):
    """An environment that is never simulated."""

    observation_size: int
    action_size: int

    def reset(self, params, key):
        return jnp.zeros(())

    def observe(self, params, state):
        return jnp.zeros(self.observation_size)

    def step(self, params, state, action):
        return state, jnp.zeros(()), jnp.bool_(0), jnp.bool_(0)


@pytest.fixture(scope="module", params=["stored", pytest.param("live", marks=pytest.mark.slow)])
def trace(request):
    if request.param == "stored":
        with np.load(FILE) as file:
            return dict(file)
    pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")
    from tests.learners.sb3_update import PUBLISHED, make_trace

    return make_trace(PUBLISHED, observations=24, actions=4)


def under(trace, kind):
    """The arrays of a kind, by the name of their parameter."""
    return {name: x for key, x in trace.items() for k, _, name in [key.partition("/")] if k == kind}


def parameters(trace):
    """Those before the update, as quadjax has them."""
    return jax.tree.map(jnp.asarray, unflatten_dict(under(trace, "start"), sep="/"))


def rollout_of(trace, network):
    """The steps, and the log densities of their actions by Stable-Baselines3."""
    steps = Trajectory(
        observation=trace["observation"][:-1],
        action=trace["actions"],
        reward=trace["reward"],
        next_value=predict_value(network, parameters(trace), trace["next_observation"]),
        terminated=trace["terminated"],
        truncated=trace["truncated"],
        completed=None,
    )
    return jax.tree.map(jnp.asarray, (steps, trace["log_probs"]))


def prepare(trace):
    """The PPO of the trace and its network."""
    config = load_config("e2e_paper", trace["overrides"].tolist())
    return config.learner, config.network.make(trace["actions"].shape[-1])


def update(trace):
    """An update by quadjax on the rollout of a trace: what the trace has of every minibatch."""
    learner, network = prepare(trace)
    rows, fed = [], rollout_of(trace, network)

    class Watched(PPO):
        """Learns from the steps of the trace, and keeps what each minibatch changes."""

        def collect(self, task, state, key):
            return state.env_states, fed

        def gradient_step(self, network, carry, batch):
            carry, metrics = super().gradient_step(network, carry, batch)
            losses = {name: metrics[name] for name in ("policy_loss", "value_loss")}
            seen = {"param": carry[0], "moment": carry[1][0].mu} | losses
            jax.debug.callback(lambda x: rows.append(jax.tree.map(np.array, x)), seen, ordered=True)
            return carry, metrics

    size, count = trace["observation"].shape[-1], trace["actions"].shape[-1]
    learner = as_leaves(Watched(**learner.model_dump()))
    task = Task.of(Still(size, count), network, ())
    state = learner.init(task, jax.random.key(0))
    state = dataclasses.replace(state, params=parameters(trace), key=jax.random.key(0))
    learner.update(task, state)
    jax.effects_barrier()
    found = jax.tree.map(lambda *x: np.stack(x), *rows)
    return flatten_dict(found, sep="/")


def differences(found, trace, kind):
    """Of each minibatch: the largest of any array of a kind, relative to its largest entry."""

    def largest(arrays):
        return np.max([np.abs(x).reshape(len(x), -1).max(axis=1) for x in arrays], axis=0)

    wanted = under(trace, kind)
    off = largest([found[f"{kind}/{name}"] - x for name, x in wanted.items()])
    return off / largest(wanted.values())


def test_log_densities_values_and_targets(trace):
    section, network = prepare(trace)
    params, (steps, _) = parameters(trace), rollout_of(trace, network)
    mean = mean_action(network, params, steps.observation)
    density = log_probability(steps.action, mean, params["log_std"])
    target = td_lambda(steps, jnp.float32(section.discount), jnp.float32(section.gae_lambda))
    value = predict_value(network, params, steps.observation)
    found = {"log_probs": density, "values": value, "returns": target}
    for name, x in found.items():
        np.testing.assert_allclose(x, trace[name], atol=TOLERANCE * np.abs(trace[name]).max())


def test_every_minibatch_with_the_standard_deviation_of_a_sample(trace, monkeypatch):
    """The single difference: quadjax divides advantages by that of the minibatch itself."""
    monkeypatch.setattr(jnp, "std", functools.partial(jnp.std, ddof=1))
    found = update(trace)
    for name in ("policy_loss", "value_loss"):
        np.testing.assert_allclose(found[name], trace[name], rtol=TOLERANCE, atol=TOLERANCE)
    assert np.max(differences(found, trace, "moment")) < TOLERANCE  # of clipped gradients
    assert np.max(differences(found, trace, "param")) < TOLERANCE
    # In a first step, the rounding of the largest parameter is 2e-4 of the change.
    start = under(trace, "start")
    changes = {f"param/{name}": found[f"param/{name}"] - x for name, x in start.items()}
    wanted = {f"param/{name}": trace[f"param/{name}"] - x for name, x in start.items()}
    assert np.max(differences(changes, wanted, "param")) < 5e-4


def test_every_minibatch_as_it_is(trace):
    found = update(trace)
    assert np.max(differences(found, trace, "param")) < TOLERANCE
    np.testing.assert_allclose(found["value_loss"], trace["value_loss"], rtol=TOLERANCE)
