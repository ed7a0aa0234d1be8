"""Files of PyTorch and Stable-Baselines3, where they are installed: nothing is executed in them."""

import base64
import io
import json
import os
import pickle
import zipfile

import chex
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadjax.core.errors import InputError
from quadjax.core.mlp import to_layers
from quadjax.policy.file import Policy
from quadjax.policy.network_files import read_network
from quadjax.vehicle.residual import read_residual
from tests.commands import run
from tests.policy.writers import forward, relu
from tests.test_damaged_files import SETTINGS, damaged

torch = pytest.importorskip("torch", reason="the extra torch is not installed")

SEEN = np.random.default_rng(0).normal(size=(9, 24)).astype(np.float32)
SAYS = "or with objects other than named tensors"


def network(*sizes, activation=torch.nn.Tanh):
    """Linear layers with activations between them."""
    torch.manual_seed(0)
    pairs = zip(sizes, sizes[1:], strict=False)
    layers = [x for pair in pairs for x in (torch.nn.Linear(*pair), activation())]
    return torch.nn.Sequential(*layers[:-1])


def equal(policy, module):
    """The mean action is the output of a module."""
    expected = np.clip(module(torch.from_numpy(SEEN)).detach().numpy(), -1, 1)
    np.testing.assert_allclose(policy(SEEN), expected, atol=1e-5)


def test_linear_layers_of_a_state_dict(tmp_path):
    """In any floating type and any order in memory, also within a checkpoint."""
    module, path = network(24, 6, 4), tmp_path / "net.pt"
    tensors = module.state_dict()
    double = {name: tensor.double().t().contiguous().t() for name, tensor in tensors.items()}
    noise = {"log_std": torch.full((4,), -1.0)}
    for saved in (tensors | noise, {"epoch": 3, "model_state_dict": double | noise}):
        torch.save(saved, path)
        policy = Policy.load(path, "e2e_paper", activation="tanh")
        equal(policy, module)
        np.testing.assert_array_equal(policy.log_std, -1.0)
    torch.save(tensors, path)
    out = tmp_path / "policy.npz"
    words = ("--activation", "tanh", "--std", 0.1, "--output", out)
    assert run("import", "e2e_paper", path, *words) == 0
    equal(Policy.load(out), module)


def test_a_residual_of_two_state_dicts(tmp_path):
    names, modules = ("thrust", "moment"), (network(7, 5, 1), network(10, 5, 3))
    files = [tmp_path / "thrust.pt", tmp_path / "moment.pth"]
    for file, module in zip(files, modules, strict=True):
        torch.save(module.state_dict(), file)
    out = tmp_path / "residual.npz"
    assert run("import", "e2e_paper", *files, "--thrust-sign", 1, "--output", out) == 0
    residual = read_residual(out)
    for name, module in zip(names, modules, strict=True):
        arrays = [tensor.detach().numpy().T for tensor in module.parameters()]
        layers = [array for layer in to_layers(getattr(residual, name)) for array in layer]
        chex.assert_trees_all_equal(layers, arrays)


class Evil:
    """Runs a command when it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch executed",)


def saved(value):
    """What ``torch.save`` writes."""
    stream = io.BytesIO()
    torch.save(value, stream)
    return stream.getvalue()


NET = network(24, 6, 4).state_dict()
SHARED = {"mlp_extractor.shared_net.0.weight": torch.zeros(3, 3)}
REFUSED = {
    "a command": (saved({"0.weight": Evil()}), SAYS),
    "a bare pickle of a command": (pickle.dumps(Evil()), SAYS),
    "a whole module": (saved(network(24, 6, 4)), SAYS),
    "no tensors": (saved({"0.weight": [1.0, 2.0]}), SAYS),
    "a tensor": (saved(torch.zeros(3)), SAYS),
    "too large to copy": (saved({"0.weight": torch.zeros(1).expand(2**45)}), SAYS),
    "cut short": (saved(NET)[:-100], "is a zip archive that is cut short, expected a state dict"),
    "no bias": (saved({k: v for k, v in NET.items() if k != "2.bias"}), "2.weight has no 2.bias"),
    "another layer": (saved(NET | {"embedding": torch.zeros(3)}), "embedding does not belong"),
    "a norm of a layer": (
        saved(NET | {"1.weight": torch.ones(6), "1.bias": torch.zeros(6)}),
        "1.weight has no 1.bias with a number for each of its rows",
    ),
    "statistics": (
        saved(NET | {"obs_rms.mean": torch.zeros(24)}),
        "has obs_rms.mean, statistics of the inputs, which a policy file cannot have: fold them",
    ),
    "statistics next to the layers": (
        saved({"model_state_dict": NET, "running_mean_std": {"count": torch.ones(1)}}),
        "has running_mean_std, statistics of the inputs",
    ),
    "a shared extractor": (saved(SHARED), "has mlp_extractor.shared_net.0.weight, expected"),
    "no noise": (saved(NET), "no log_std or output_std, give the noise's std"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_other_contents_are_refused_in_one_line(what, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path, (data, says) = tmp_path / "net.pt", REFUSED[what]
    path.write_bytes(data)
    assert run("import", "e2e_paper", path, "--activation", "relu", "--output", "a.npz") == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and "weights_only" not in error
    assert [each.name for each in tmp_path.iterdir()] == ["net.pt"]  # nothing was executed


@SETTINGS
@given(data=st.data())
def test_damaged_state_dicts_are_read_or_refused_in_one_line(data, tmp_path):
    path = tmp_path / "net.pt"
    path.write_bytes(data.draw(damaged(saved(NET))))
    try:
        read_network(path)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000


@pytest.fixture(scope="module")
def model_of():
    """What makes a model of Stable-Baselines3 with untrained networks and some action range."""
    sb3 = pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")
    spaces = pytest.importorskip("gymnasium").spaces

    class Env(pytest.importorskip("gymnasium").Env):
        observation_space = spaces.Box(-1.0, 1.0, (24,))
        action_space = spaces.Box(-1.0, 1.0, (4,))

    class Extractor(sb3.common.torch_layers.FlattenExtractor):
        pass

    def make(algorithm="PPO", activation=None, low=-1.0, own_extractor=False, **options):
        if algorithm == "PPO":
            kwargs = {"net_arch": {"pi": [7, 8], "vf": [5, 6]}, "log_std_init": -1.5}
            kwargs |= {} if activation is None else {"activation_fn": activation}
            kwargs |= {"features_extractor_class": Extractor} if own_extractor else {}
            options |= {"policy_kwargs": kwargs}
        env = Env()
        env.action_space = spaces.Box(low, 1.0, (4,))
        return getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu", **options)

    return make


@pytest.mark.slow
@pytest.mark.parametrize("activation", [torch.nn.ReLU, None], ids=["relu", "default"])
def test_a_model_of_stable_baselines3(model_of, activation, tmp_path):
    model, path = model_of(activation=activation), tmp_path / "model.zip"
    model.save(path)
    policy = Policy.load(path, "e2e_paper")
    assert policy.activation == ("relu" if activation else "tanh")
    assert policy.vehicle == "motor" and policy.noise_on == "mean"
    np.testing.assert_array_equal(policy.log_std, np.float32(-1.5))
    expected, _ = model.predict(SEEN, deterministic=True)
    np.testing.assert_allclose(policy(SEEN), expected, atol=1e-5)
    critic = {f"{i}.weight": kernel.T for i, (kernel, _) in enumerate(policy.value)}
    critic |= {f"{i}.bias": bias for i, (_, bias) in enumerate(policy.value)}
    found = forward(critic, SEEN, "012", relu if activation else np.tanh)
    values = model.policy.predict_values(torch.from_numpy(SEEN)).detach().numpy()
    np.testing.assert_allclose(found, values, atol=1e-5)
    policy.save(tmp_path / "policy.npz")
    again = Policy.load(tmp_path / "policy.npz")
    assert again.layout.labels == policy.layout.labels and again.config["name"] == "e2e_paper"
    torch.save(model.policy.state_dict(), tmp_path / "policy.pt")
    other = Policy.load(tmp_path / "policy.pt", "e2e_paper", activation=policy.activation)
    np.testing.assert_array_equal(other(SEEN), policy(SEEN))


def with_member(model, name, change):
    """A model's archive with another content of one of its files."""
    stream, changed = io.BytesIO(), io.BytesIO()
    model.save(stream)
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(changed, "w") as new:
        for each in old.namelist():
            new.writestr(each, change(old.read(each)) if each == name else old.read(each))
    return changed.getvalue()


def evil_data(data):
    """The JSON of a model whose pickled objects run a command."""
    pickled = base64.b64encode(pickle.dumps(Evil())).decode()
    whole = json.loads(data)
    whole["policy_class"][":serialized:"] = pickled
    return json.dumps(whole)


@pytest.mark.slow
def test_pickled_objects_of_a_model_are_not_executed(model_of, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model, path = model_of(activation=torch.nn.ReLU), tmp_path / "model.zip"
    path.write_bytes(with_member(model, "data", evil_data))
    assert Policy.load(path, "e2e_paper").activation == "relu"
    path.write_bytes(with_member(model, "data", lambda data: b"{"))
    assert Policy.load(path, "e2e_paper", activation="relu").activation == "relu"
    for content in (saved({"log_std": Evil()}), pickle.dumps(Evil()), b""):
        path.write_bytes(with_member(model, "policy.pth", lambda _, new=content: new))
        assert run("import", "e2e_paper", path, "--output", "a.npz") == 2
        error = capsys.readouterr().err
        assert f"not a model of Stable-Baselines3: damaged, {SAYS}" in error
        assert error.count("\n") == 1 and "weights_only" not in error
    assert [each.name for each in tmp_path.iterdir()] == ["model.zip"]


@pytest.mark.slow
def test_other_models_are_refused_in_one_line(model_of, tmp_path, capsys):
    path, out = tmp_path / "model.zip", tmp_path / "a.npz"
    for options, words, says in (
        ({"algorithm": "SAC", "buffer_size": 10}, (), "expected a model of PPO or A2C"),
        ({"activation": torch.nn.ELU}, (), "the activation is elu, allowed: relu, tanh"),
        ({"use_sde": True}, (), "expected a number per action (no gSDE)"),
        ({"low": 0.0}, (), "action_space.low is [0. 0. 0. 0.], expected -1 of every action"),
        ({"own_extractor": True}, (), "Extractor'>, expected none"),
        ({}, ("--activation", "relu"), "its activation is tanh, not relu"),
        (
            {},
            ("observation.actuators=false",),
            "takes 24 numbers, policies of e2e_paper observe 20",
        ),
        ({}, ("--std", 0.1), "has a standard deviation, so std 0.1 has no effect"),
    ):
        model_of(**options).save(path)
        assert run("import", "e2e_paper", path, *words, "--output", out) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1 and not out.exists()
