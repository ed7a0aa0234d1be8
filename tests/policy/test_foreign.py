"""Policies and residuals of other projects are read without executing anything."""

import os
import pickle

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.policy.file import Policy
from quadjax.policy.foreign import residual_of
from quadjax.policy.network_files import read_state_dict
from quadjax.vehicle.residual import read_residual
from tests.commands import run
from tests.policy.writers import (
    archive,
    c_source,
    forward,
    linear,
    relu,
    sb3_model,
    sb3_tensors,
    state_dict,
)

RELU = {"policy_kwargs": {":type:": "<class 'dict'>", ":serialized:": "gASVAAAAAAAAAAAu"}}
RELU["policy_kwargs"]["activation_fn"] = "<class 'torch.nn.modules.activation.ReLU'>"


@pytest.mark.parametrize(
    ("data", "kind", "activation"),
    [(RELU, "relu", relu), ({"policy_kwargs": {}}, "tanh", np.tanh)],
)
def test_a_model_of_stable_baselines3(tmp_path, data, kind, activation):
    arrays = sb3_tensors()
    policy = Policy.load(sb3_model(tmp_path / "model.zip", arrays, data), "e2e_paper")
    assert policy.activation == kind and policy.vehicle == "motor" and policy.noise_on == "mean"
    np.testing.assert_array_equal(policy.log_std, arrays["log_std"])
    x = np.random.default_rng(0).normal(size=(9, 24))
    names = ["mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"]
    wanted = np.clip(forward(arrays, x, names, activation), -1, 1)
    np.testing.assert_allclose(policy(x.astype(np.float32)), wanted, atol=1e-5)
    names = ["mlp_extractor.value_net.0", "mlp_extractor.value_net.2", "value_net"]
    critic = {f"{i}.weight": k.T for i, (k, _) in enumerate(policy.value)}
    critic |= {f"{i}.bias": b for i, (_, b) in enumerate(policy.value)}
    own = forward(critic, x, "012", activation)
    np.testing.assert_allclose(own, forward(arrays, x, names, activation), atol=1e-5)
    policy.save(tmp_path / "policy.npz")
    again = Policy.load(tmp_path / "policy.npz")
    assert again.layout.labels == policy.layout.labels and again.config["name"] == "e2e_paper"


STD = "{0.1f, 0.2f, 0.3f, 0.4f}"


def test_motors_and_their_range_in_another_order(tmp_path):
    """INDIflight numbers rear-right, front-right, rear-left, front-left."""
    arrays, path, out = linear((24, 6, 4)), tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(arrays, std=STD, flat=False))
    options = ("--motors", 4, 2, 1, 3, "--actuator-range", 0, 12000, "--output", out)
    assert run("import", "e2e_paper", path, *options) == 0
    policy, plain = Policy.load(out), Policy.load(path, "e2e_paper")
    assert policy.layout["rpm"].span == ((0.0, 12000.0),) * 4
    np.testing.assert_allclose(np.exp(plain.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    for index, (kernel, bias) in enumerate(plain.layers):
        np.testing.assert_array_equal(kernel, arrays[f"{2 * index}.weight"].T)
        np.testing.assert_array_equal(bias, arrays[f"{2 * index}.bias"])
    seen = np.random.default_rng(0).normal(size=(3, 24)).astype(np.float32)
    there, where = seen.copy(), policy.layout.slice("rpm").start
    for own, other in enumerate((3, 1, 0, 2)):
        there[:, where + other] = seen[:, where + own]
    np.testing.assert_allclose(policy(seen), np.asarray(plain(there))[:, [3, 1, 0, 2]], atol=1e-6)
    np.testing.assert_allclose(policy.log_std, plain.log_std[[3, 1, 0, 2]])


@pytest.fixture
def residual_files(tmp_path):
    for name, sizes in (("thrust.pt", (7, 32, 1)), ("moment.pth", (10, 32, 3))):
        (tmp_path / name).write_bytes(state_dict(linear(sizes)))
    return tmp_path / "thrust.pt", tmp_path / "moment.pth"


def test_a_residual_of_two_state_dicts(tmp_path, residual_files, capsys):
    out = tmp_path / "residual.npz"
    arguments = ("import", "e2e_paper", *residual_files, "--output", out)
    assert run(*arguments) == 2
    assert "--thrust-sign is missing" in capsys.readouterr().err
    assert run(*arguments, "--thrust-sign", "-1", "vehicle.constants.rpm_max=12000") == 0
    residual, arrays = read_residual(out), linear((10, 32, 3))
    assert (residual.rpm_min, residual.rpm_max, residual.thrust_sign) == (3000, 12000, -1)
    np.testing.assert_array_equal(residual.moment[0][0], arrays["0.weight"].T)
    with pytest.raises(InputError, match=r"moment\.pth: the thrust network maps 10 inputs to 3"):
        residual_of(load_config("e2e_paper").vehicle, residual_files[::-1], 1)


def test_torch_reads_and_writes_the_same(tmp_path):
    """Where PyTorch is installed: its files are read, and it reads those of the tests."""
    torch = pytest.importorskip("torch")
    arrays, path = sb3_tensors(), tmp_path / "own.pt"
    path.write_bytes(state_dict(arrays))
    theirs = torch.load(path, weights_only=True)
    assert list(theirs) == list(arrays)
    torch.save({name: tensor.T.contiguous().T for name, tensor in theirs.items()}, path)
    for name, array in read_state_dict(path).items():
        np.testing.assert_array_equal(array, arrays[name])


class Evil:
    """Runs a command when it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch executed",)


def evil_pickle():
    return pickle.dumps({"0.weight": Evil()}, protocol=2)


HUGE = {"size": (2**20, 2**20), "stride": (0, 0)}
REFUSED = {
    "a pickle that runs a command": (archive(evil_pickle(), {}), "which is not loaded"),
    "the legacy format": (pickle.dumps(0x1950A86A20F9469CFC6C), "legacy format"),
    "beyond its storage": (state_dict(linear((7, 1)), offset=1), "larger than its storage"),
    "repeated storage": (state_dict(linear((7, 1)), **HUGE), "larger than its storage"),
    "a short storage": (state_dict(linear((7, 1)), count=9), "expected 9"),
}


def test_harmful_and_damaged_files_are_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "network.pt"
    for what, (data, expected) in REFUSED.items():
        path.write_bytes(data)
        with pytest.raises(InputError) as error:
            Policy.load(path, "e2e_paper", activation="relu", std=0.1)
        assert expected in str(error.value) and "\n" not in str(error.value), what
        assert [each.name for each in tmp_path.iterdir()] == ["network.pt"]  # nothing was executed


def as_model(path, arrays=None, data=RELU):
    return sb3_model(path.with_suffix(".zip"), sb3_tensors() if arrays is None else arrays, data)


def as_dict(path, arrays):
    path.with_suffix(".pt").write_bytes(state_dict(arrays))
    return path.with_suffix(".pt")


def as_c(path, text):
    path.with_suffix(".c").write_text(text)
    return path.with_suffix(".c")


NET = linear((24, 6, 4))
ONE_BIAS = {name: array for name, array in NET.items() if name != "2.bias"}
SHARED = sb3_tensors() | {"mlp_extractor.shared_net.0.weight": np.zeros((3, 3), np.float32)}
ELU = {"policy_kwargs": {"activation_fn": "<class 'x.ELU'>"}}
SAC = linear((24, 6, 4), prefix="actor.latent_pi.")


MISFITS = [  # file, options, what the message says
    (as_model, {}, {"config": "indi_paper"}, "takes 24 numbers, .* observe 17: posi"),
    (as_model, {}, {"activation": "tanh"}, "its activation is relu, not tanh"),
    (as_model, {"arrays": SAC}, {}, "PPO or A2C"),
    (as_model, {"arrays": SHARED}, {}, "shared_net"),
    (as_model, {"data": ELU}, {}, "the activation is elu, allowed: relu, tanh"),
    (as_dict, {"arrays": NET}, {"activation": "relu"}, "give the noise's std"),
    (as_dict, {"arrays": ONE_BIAS}, {}, "2.weight has no 2.bias"),
    (as_c, {"text": c_source(NET, std="{0, 1, 1, 1}")}, {}, "expected numbers above 0"),
    (as_c, {"text": c_source(NET, std=STD).replace("s_fc1[6]", "s_fc1[7]")}, {}, "says 7"),
]


def test_networks_that_do_not_fit_are_refused_in_one_line(tmp_path):
    for make, content, options, expected in MISFITS:
        path = make(tmp_path / "network", **content)
        with pytest.raises(InputError, match=expected) as error:
            Policy.load(path, **{"config": "e2e_paper"} | options)
        assert "\n" not in str(error.value) and path.name in str(error.value)


def test_options_without_effect_are_refused(tmp_path, residual_files, capsys):
    model = sb3_model(tmp_path / "model.zip", sb3_tensors(), RELU)
    own = ("import", "e2e_paper", "--output", tmp_path / "a.npz")
    for arguments, says in (
        ((model, "--thrust-sign", 1), "--thrust-sign has no effect on a policy"),
        ((*residual_files, "--activation", "relu"), "--activation has no effect on a residual"),
        ((model,) * 4, "4 networks and 0 files"),
        ((model, "--motors", 1, 2, 3, 3), "expected each of 1 to 4 once"),
    ):
        assert run(*own, *arguments) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1
    assert not (tmp_path / "a.npz").exists()
