"""Mistakes in a user's own functions and files: one line, and no folder of a run."""

import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import optax
import pytest

import quadjax
from quadjax import Learner, Memory, ObservedField, TrainState
from quadjax.config.assembly import make_params
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.evaluation.advice import look
from quadjax.training.inputs import without_gradient
from quadjax.training.run import train
from quadjax.vehicle.residual import read_residual, write_residual
from tests.commands import run
from tests.race.support import BLANK

SMALL = ["run.steps=64", "run.evaluate_every=64", "network.hidden=[8]", "run.devices=1"]


def vector(step):
    return jnp.zeros(4)


def attribute(step):
    return step.nosuch


THREE = ObservedField("three", 1, "m", "world", value=lambda view: [0.0] * 3)


class Own(Learner):
    steps_per_update = property(lambda self: 64)

    def init(self, task, key):
        w = task.network.init(key, jnp.zeros(task.environments.observation_size))["params"]
        return TrainState(w, optax.adam(1e-3).init(w), None, (), key, jnp.int32(0))


class NoSteps(Own):
    steps_per_update = property(lambda self: None)


class NoUpdate(Own):
    pass


class NoState(Own):
    def init(self, task, key):
        return 3


class NoMetrics(Own):
    def update(self, task, state):
        return (state,)


class Leaves(Own):
    def update(self, task, state):
        sys.exit(3)


class Divides(Own):
    def update(self, task, state):
        return state, {"reward": 1 / 0}


WRONG = """
reward.terms={OWN:vector: 1.0} | reward term OWN:vector gives an array of shape (4,), expected one
reward.terms={OWN:attribute: 1.0} | OWN:attribute: AttributeError: 'Step' object has no attribute 'n
rules.extra=['sys:exit'] | rule sys:exit: SystemExit:
learner.algorithm=OWN:Leaves | learner.algorithm OWN:Leaves: SystemExit: 3 (
observation.extra=['OWN:THREE'] | field 'three' gives 3 numbers, expected one number (its size)
observation.extra=['OWN:vector'] | OWN:vector is a function, expected a quadjax.ObservedField
learner.algorithm=OWN:NoSteps | steps_per_update of NoSteps is None, allowed: an integer, 1 to
learner.algorithm=OWN:NoUpdate | NoUpdate has no update(task, state), allowed
learner.algorithm=OWN:NoState | NoState: init gives ShapeDtypeStruct(
learner.algorithm=OWN:NoMetrics | learner.algorithm OWN:NoMetrics:
run.initial_policy=none.npz | none.npz
vehicle.residual=none.npz | none.npz
learner.algorithm=OWN:Divides | OWN:Divides: ZeroDivisionError: division
""".strip().splitlines()


@pytest.mark.parametrize("row", WRONG)
def test_a_mistake_is_one_line_before_the_folder_exists(row, tmp_path):
    override, _, message = row.replace("OWN", __name__).partition(" | ")
    config = load_config(BLANK, [*SMALL, override])
    with pytest.raises(InputError) as caught:
        train(config, tmp_path / "run", progress=False)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def far(step):
    """Of no gradient: one of two numbers."""
    return jnp.where(step.distance > 3.0, -1.0, 0.0)


def turned(step):
    return -jnp.abs(step.memories["turns"])


def counted(step):
    return -step.memories["turns"]


class Turns(Memory):
    name = "turns"

    def begin(self, model, params, state):
        return jnp.zeros(())

    def advance(self, value, step):
        return value + step.time_step * step.body_rates.z


class Count(Turns):
    def advance(self, value, step):
        return value + jnp.sign(step.body_rates.z)


def test_a_term_that_shac_cannot_differentiate_is_named():
    """Through a memory, too; PPO needs no gradient."""
    turned.memory, counted.memory = Turns(), Count()
    terms = [f"reward.terms={{{__name__}:{name}: 1.0}}" for name in ("far", "turned", "counted")]
    found = []
    for term in terms:
        config = load_config("e2e", [term])
        found += without_gradient(config, make_params(config))
    assert [line.partition(":")[2].partition(": ")[0] for line in found] == ["far", "counted"]
    assert "no gradient in 64 random steps: SHAC learns from it through the critic" in found[0]
    config = load_config("e2e_ppo", terms[:1])
    assert without_gradient(config, make_params(config)) == []


def test_an_error_of_a_users_learner_keeps_its_traceback(tmp_path, monkeypatch):
    (tmp_path / "late.py").write_text(
        "from quadjax import Learner\n\n\n"
        "class Late(Learner):\n"
        "    @property\n"
        "    def steps_per_update(self):\n"
        "        return undefined\n"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NameError, match="name 'undefined' is not defined"):
        run("train", BLANK, "learner.algorithm=late:Late", *SMALL)


def test_a_residual_of_zeros_says_how_to_train_without_it(tmp_path):
    zero = read_residual("standin_residual.npz").replace(gain=np.float32(0.0))
    write_residual(path := tmp_path / "residual.npz", zero, {})
    config = load_config("e2e +residual", [*SMALL, f"vehicle.residual={path}"])
    with pytest.raises(InputError, match="residual.npz adds nothing.*leave out"):
        train(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


class Stage(quadjax.SHAC):
    extra: float = 0.5


def test_a_stage_of_a_learner_keeps_the_hyperparameters_of_the_preset():
    name = f"{__name__}:Stage"
    config, preset = load_config("e2e", [f"learner.algorithm={name}"]), load_config("e2e")
    assert isinstance(config.learner, Stage) and config.learner.algorithm == name
    assert config.schedules == preset.schedules
    assert config.learner.model_dump(exclude={"algorithm", "extra"}) == preset.learner.model_dump(
        exclude={"algorithm"}
    )
    other = load_config("e2e_ppo", [f"learner.algorithm={name}"])
    assert other.learner == Stage(algorithm=name)


def test_the_next_command_of_a_run_names_the_config_with_the_users_code(tmp_path):
    """Reward terms have no effect on a flight."""
    config = load_config("e2e", [f"rules.extra=[{__name__}:vector]"])
    run_of = SimpleNamespace(folder=tmp_path, config=config)
    assert look(run_of).split(" --race ")[1].startswith(f"{tmp_path / 'config.yaml'} shows")
    for words in ([], [f"reward.terms={{{__name__}:vector: 1.0}}"]):
        run_of.config = load_config("e2e", words)
        assert "--race" not in look(run_of)
