"""Training on any environment in memory: by PPO, by SHAC and by own learners."""

import contextlib
import dataclasses
import io
import runpy
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from quadjax.core.errors import InputError
from quadjax.learners.learner import Learner, Network
from quadjax.learners.networks import ActorCritic, initial_params, mean_action
from quadjax.learners.schedules import Schedule
from quadjax.learners.state import TrainState
from tests.learners.probes import ENVIRONMENT, ProbeEnvironment, observations, probe
from tests.learners.support import DEFAULTS

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NETWORK = Network(hidden=(16, 16), activation="tanh")


SCHEDULES = {
    "ppo": {"learner.learning_rate": [1e-2, 1e-3]},
    "shac": {"learning_rate": Schedule(linear=("value", 1e-3)), "std": [0.2, 0.1]},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "shac"])
def test_training_finds_the_best_action(name):
    """With one trace of the updates."""
    chex.clear_trace_counter()
    rows, environment = [], ProbeEnvironment()
    object.__setattr__(environment, "step", chex.assert_max_traces(environment.step, n=1))
    arguments = environment, probe(best=1.0), 40_000, 0, NETWORK, SCHEDULES[name], rows.append
    result = DEFAULTS[name].train(*arguments)
    batch = np.stack([observations(1.0), observations(-1.0)])
    np.testing.assert_allclose(result.policy(batch), 0.5, atol=0.1)
    per_update = DEFAULTS[name].num_envs * (8 if name == "ppo" else 4)
    updates = result.steps // per_update
    assert result.steps % per_update == 0 and abs(result.steps - 40_000) <= 20 * per_update
    assert {value.shape for value in result.metrics.values()} == {(updates,)}
    rates = result.metrics["learning_rate"]
    np.testing.assert_allclose(rates[0], 1e-2 if name == "ppo" else 5e-3, rtol=1e-5)
    assert np.all(np.diff(rates) < 0) and rates[-1] == pytest.approx(1e-3, rel=0.2)
    if name == "shac":
        last = 0.2 - 0.1 * (updates - 1) / updates
        np.testing.assert_allclose(np.exp(result.parameters["log_std"]), last, rtol=1e-5)
    assert rows[-1]["steps"] == result.steps and len(rows) <= 21
    assert np.mean(result.metrics["reward"][-5:]) > np.mean(result.metrics["reward"][:5])
    assert result.parameters["actor"]["Dense_0"]["kernel"].shape == (3, 16)


@dataclasses.dataclass
class Unhashable(ProbeEnvironment):
    """An environment whose fields could change."""

    number: int = 1


def test_an_environment_that_could_change_is_refused_in_one_line():
    with pytest.raises(InputError, match="Unhashable is not hashable, allowed: a frozen dataclass"):
        DEFAULTS["ppo"].train(Unhashable(), probe(), 100)


class Constant(nn.Module):
    """Numbers that do not depend on the input."""

    outputs: int

    @nn.compact
    def __call__(self, inputs):
        number = self.param("number", nn.initializers.zeros, (self.outputs,))
        return jnp.broadcast_to(number, (*inputs.shape[:-1], self.outputs))


class Constants(ActorCritic):
    """Networks of the user's own."""

    def make_network(self, outputs, last_scale):
        return Constant(outputs)


WRONG = (
    ({"steps": 0}, "steps is 0, allowed: an integer, 1 "),
    (
        {"schedules": {"learning_rat": [1.0, 0.0]}},
        "learning_rat cannot be.*mean learning_rate",
    ),
    ({"schedules": {"num_epochs": [2, 3]}}, "num_epochs cannot be scheduled"),
    ({"schedules": {"learning_rate": 3e-3}}, "learning_rate is 0.003, allowed: a list of values"),
    ({"network": Constants}, "network is <class .*Constants.>, expected a Network or an ActorC"),
    ({"network": Constants(3)}, "network.action_size is 3, the environment takes 1"),
)


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_wrong_arguments_are_one_line(arguments, message):
    arguments = {"steps": 1000, "network": NETWORK} | arguments
    with pytest.raises(InputError, match=message):
        DEFAULTS["ppo"].train(ENVIRONMENT, probe(), **arguments)


class Ascent(Learner):
    """Moves the last bias of the policy along the gradient of one step's reward."""

    num_envs: int = 4

    @property
    def steps_per_update(self):
        return self.num_envs

    def init(self, task, key):
        weights = initial_params(task.network, key, task.environments.observation_size)
        return TrainState(weights, (), None, (), key, jnp.int32(0))

    def update(self, task, state):
        def reward(weights):
            start = task.environments.reset(task.env_params, keys)
            seen = task.environments.observe(task.env_params, start)
            action = mean_action(task.network, weights, seen)
            return task.environments.step(task.env_params, start, action)[1].mean()

        keys = jax.random.split(state.key, self.num_envs)
        slope = jax.grad(reward)(state.params)
        weights = jax.tree.map(lambda w, g: w + 0.1 * g, state.params, slope)
        new = state.next_state((), keys[0], params=weights)
        return new, {"reward": reward(weights)}


@pytest.mark.parametrize("network", [NETWORK, Constants(1)], ids=["a perceptron", "own networks"])
def test_an_own_learner(network):
    result = Ascent().train(ENVIRONMENT, probe(best=1.0), 800, network=network)
    batch = np.stack([observations(1.0), observations(-1.0)])
    np.testing.assert_allclose(result.policy(batch), 0.5, atol=0.05)
    assert result.steps == 800


def test_numbers_of_the_environment_follow_schedules_as_in_a_config():
    """A constant reward of 0, from the middle of the run rising to 4, in environment steps."""
    schedules = {"constant": Schedule(linear=(0.0, 4.0), start=0.5)}
    arguments = ENVIRONMENT, probe(constant=1.0), 60 * 4, 0, NETWORK, schedules
    reward = Ascent().train(*arguments).metrics["reward"]
    np.testing.assert_allclose(reward[:30], 0.0, atol=1e-6)
    np.testing.assert_allclose(reward[30:], np.arange(30) * 4.0 / 30.0, atol=1e-5)


@pytest.mark.slow
def test_the_pendulum_learns_to_stand(optimized):
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        runpy.run_path(str(EXAMPLES / "07_pendulum.py"), run_name="__main__")
    lines = output.getvalue().splitlines()
    assert len(lines) == 2
    for line in lines:
        first, last = (float(word) for word in line.split() if word.lstrip("-")[0].isdigit())
        assert first < 0.0 and last > 0.5
