"""Mistakes in a user's own functions and files: one line, and no folder of a run."""

import sys

import jax.numpy as jnp
import optax
import pytest

from quadjax import Field, Learner, LearnerSection, TrainState
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.training.run import train
from quadjax.vehicle.residual import read_residual, scale_residual, write_residual
from tests.commands import run
from tests.race.support import BLANK

SMALL = ["run.steps=64", "run.evaluate_every=64", "network.hidden=[8]", "run.devices=1"]


def vector(step):
    return jnp.zeros(4)


def attribute(step):
    return step.nosuch


THREE = Field("three", 1, "m", "world", value=lambda view: [0.0] * 3)


def learner(init, update):
    class Own(LearnerSection):
        def make(self, environment, network, num_updates):
            def begin(hyper, params, key):
                w = network.init(key, jnp.zeros(environment.observation_size))["params"]
                adam = optax.adam(1e-3).init(w)
                return TrainState(w, adam, None, (), key, jnp.int32(0))

            return Learner(init or begin, update, {}, 64)

    return Own


class NoLearner(LearnerSection):
    def make(self, environment, network, num_updates):
        return None


NO_STATE = learner(lambda hyper, params, key: 3, lambda hyper, params, state: state)
NO_METRICS = learner(None, lambda hyper, params, state: (state,))
LEAVES = learner(None, lambda hyper, params, state: sys.exit(3))
DIVIDES = learner(None, lambda hyper, params, state: (state, {"reward": 1 / 0}))


WRONG = """
reward.terms={OWN:vector: 1.0} | reward term OWN:vector gives an array of shape (4,), expected one
reward.terms={OWN:attribute: 1.0} | OWN:attribute: AttributeError: 'Step' object has no attribute 'n
rules.extra=['sys:exit'] | rule sys:exit: SystemExit:
learner.algorithm=OWN:LEAVES | learner.algorithm OWN:LEAVES: SystemExit: 3 (
observation.extra=['OWN:THREE'] | field 'three' gives 3 numbers, expected one number (its size)
observation.extra=['OWN:vector'] | OWN:vector is a function, expected a quadjax.Field
learner.algorithm=OWN:NoLearner | make() gives a NoneType, expected a quadjax.L
learner.algorithm=OWN:NO_STATE | NO_STATE: init gives ShapeDtypeStruct(
learner.algorithm=OWN:NO_METRICS | learner.algorithm OWN:NO_METRICS:
run.initial_policy=none.npz | none.npz
vehicle.residual=none.npz | none.npz
learner.algorithm=OWN:DIVIDES | OWN:DIVIDES: ZeroDivisionError: division
""".strip().splitlines()


@pytest.mark.parametrize("row", WRONG)
def test_a_mistake_is_one_line_before_the_folder_exists(row, tmp_path):
    override, _, message = row.replace("OWN", __name__).partition(" | ")
    config = load_config(BLANK, [*SMALL, override])
    with pytest.raises(InputError) as caught:
        train(config, tmp_path / "run", progress=False)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_an_error_of_a_users_learner_keeps_its_traceback(tmp_path, monkeypatch):
    (tmp_path / "late.py").write_text(
        "from quadjax import LearnerSection\n\n\n"
        "class Late(LearnerSection):\n"
        "    def make(self, environment, networks, num_updates):\n"
        "        return undefined\n"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NameError, match="name 'undefined' is not defined"):
        run("train", BLANK, "learner.algorithm=late:Late", *SMALL)


def test_a_residual_of_zeros_says_how_to_train_without_it(tmp_path):
    zero = scale_residual(read_residual("standin_residual.npz"), 0.0)
    write_residual(path := tmp_path / "residual.npz", zero, {})
    config = load_config("e2e +residual", [*SMALL, f"vehicle.residual={path}"])
    with pytest.raises(InputError, match="residual.npz adds nothing.*leave out"):
        train(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
