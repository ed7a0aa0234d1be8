"""Policy and value networks of the user's own class: training, file, flight, refusals."""

import json

import chex
import numpy as np
import pytest
from flax import linen as nn

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.export.network import check_policy
from quadjax.learners.networks import ActorCritic
from quadjax.policy.file import Policy
from quadjax.training import run as training
from quadjax.training.build import (
    first_params,
    initial_policy,
    make_policy,
    make_training,
    start_state,
    with_policy,
)
from quadjax.training.fine_tuning import fine_tuning
from tests.race.support import BLANK

HERE = "tests.training.test_own_network"
SMALL = ["run.steps=64", "run.evaluate_every=64", "run.devices=1", "learner.num_envs=8"]
SHAC = [
    "learner={algorithm: shac, num_envs: 8, horizon: 8, critic_minibatches: 2, optimizer: muon}",
    "learner.critic_epochs=1",
]
LAYERS = (("Dense_0", "kernel"), ("LayerNorm_0", "scale"), ("Dense_1", "kernel"))
PPO = ["learner.rollout_length=8", "learner.num_minibatches=2"]


class Normed(nn.Module):
    outputs: int
    last_scale: float

    @nn.compact
    def __call__(self, inputs):
        hidden = nn.silu(nn.LayerNorm()(nn.Dense(8)(inputs)))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.last_scale))(
            hidden
        )


class Own(ActorCritic):
    def make_network(self, outputs, last_scale):
        return Normed(outputs, last_scale)


class Wider(ActorCritic):
    """Its mean action has one number too many."""

    def make_network(self, outputs, last_scale):
        return Normed(outputs + 1, last_scale)


class Raises(ActorCritic):
    def make_network(self, outputs, last_scale):
        return undefined  # noqa: F821


class Shares(ActorCritic):
    """Parameters of other names, which no learner would train."""

    def setup(self):
        super().setup()
        self.body = nn.Dense(8)

    def value(self, observation):
        return self.critic(self.body(observation))[..., 0]


def config_of(*overrides, module="Own", learner=PPO):
    return load_config(BLANK, [*SMALL, *learner, f"network.module={HERE}:{module}", *overrides])


@pytest.mark.slow
@pytest.mark.parametrize("learner", [PPO, SHAC], ids=["ppo", "shac"])
def test_it_is_trained_saved_and_flown(learner, tmp_path):
    config = config_of(learner=learner)
    run = training.train(config, tmp_path / "run", progress=False)
    assert run.finished and run.policy.describe() == f"{HERE}:Own" and not run.policy.layers
    with np.load(tmp_path / "run/policy.npz") as file:
        first, norm, last = (
            {name: file[f"actor/{layer}/{name}"] for name in (kind, "bias")}
            for layer, kind in LAYERS
        )
    seen = np.linspace(-1, 1, first["kernel"].shape[0], dtype=np.float32)
    hidden = seen @ first["kernel"] + first["bias"]
    hidden = (hidden - hidden.mean()) / np.sqrt(hidden.var() + 1e-6) * norm["scale"] + norm["bias"]
    mean = hidden / (1.0 + np.exp(-hidden)) @ last["kernel"] + last["bias"]
    np.testing.assert_allclose(run.policy.mean(seen), np.clip(mean, -1, 1), atol=1e-5)
    read = Policy.load(tmp_path / "run/policy.npz", config)
    np.testing.assert_array_equal(read.mean(seen), run.policy.mean(seen))


def test_its_class_is_imported_only_from_a_config_that_the_user_names(tmp_path):
    file = tmp_path / "own.npz"
    make_policy(config_of(), first_params(config_of(), 0)).save(file)
    with pytest.raises(InputError, match=f"class {HERE}:Own; to import it, name a config"):
        Policy.load(file).mean(np.zeros(24, np.float32))
    with pytest.raises(InputError, match=f"its network is {HERE}:Own, the config has .*=null"):
        Policy.load(file, load_config(BLANK))
    with pytest.raises(InputError, match="activation relu, the config has network.activation=tanh"):
        Policy.load(file, config_of("network.activation=tanh"))


def test_a_training_starts_from_its_parameters(tmp_path):
    file, config = tmp_path / "own.npz", config_of()
    params = first_params(config, 3)
    make_policy(config, params).save(file)
    tuned = config_of(f"run.initial_policy={file}")
    state = start_state(tuned, make_training(tuned)[0], initial_policy(tuned))
    chex.assert_trees_all_equal(dict(state.params), dict(params))
    assert fine_tuning(config, file).run.initial_policy == str(file)
    scaled = config_of("learner.reward_scale=0.5")
    found = with_policy(first_params(scaled, 0), Policy.load(file), 0.5)
    chex.assert_trees_all_equal(found["actor"], params["actor"])
    chex.assert_trees_all_equal(found["critic"], first_params(scaled, 0)["critic"])  # a new one
    with pytest.raises(InputError, match=f"its network is {HERE}:Own, the config has"):
        initial_policy(load_config(BLANK, [*SMALL, *PPO, f"run.initial_policy={file}"]))


def test_a_critic_that_observes_more_than_the_policy_is_left_out(tmp_path):
    config = config_of("randomization.all=0.1", "observation.critic_constants=true")
    make_policy(config, first_params(config, 0)).save(tmp_path / "own.npz")
    read = Policy.load(tmp_path / "own.npz", config)
    assert not read.has_critic and read.mean(np.zeros(read.layout.size)).shape == (4,)


@pytest.mark.parametrize("module", [5, [], "", "no colon", "a:" + 5000 * "b"])
def test_a_file_names_a_class_by_a_short_text(module, tmp_path):
    make_policy(config_of(), first_params(config_of(), 0)).save(tmp_path / "own.npz")
    with np.load(tmp_path / "own.npz") as file:
        arrays = dict(file)
    meta = json.loads(str(arrays["meta"])) | {"module": module}
    np.savez(tmp_path / "other.npz", **arrays | {"meta": json.dumps(meta)})
    with pytest.raises(InputError, match="other.npz: meta: module is ") as caught:
        Policy.load(tmp_path / "other.npz")
    assert len(str(caught.value)) < 300
    np.savez(tmp_path / "both.npz", **arrays | {"actor/Dense_0/kernel/x": np.zeros(1)})
    with pytest.raises(InputError, match="kernel is an array and a group of arrays"):
        Policy.load(tmp_path / "both.npz")


def test_it_is_not_converted_to_c():
    with pytest.raises(InputError, match=f"network is {HERE}:Own, allowed: a perceptron"):
        check_policy(make_policy(config_of(), first_params(config_of(), 0)))


WRONG = {
    "Wider": "the network Wider has the shape (5,) and the type float32, expected (4,) and float",
    "Raises": "NameError: name 'undefined' is not defined",
    "Shares": "variables actor, body, critic, log_std, expected the parameters actor, critic",
    "Normed": "expected a subclass of quadjax.ActorCritic",
}


@pytest.mark.parametrize("module", WRONG)
def test_a_mistake_is_one_line(module, tmp_path):
    with pytest.raises(InputError) as caught:
        training.train(config_of(module=module), tmp_path / "run", progress=False)
    assert WRONG[module] in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_lengths_in_legs_are_for_perceptrons():
    with pytest.raises(InputError, match="normalize is true, allowed: false with network.module"):
        config_of("network.normalize=true")
