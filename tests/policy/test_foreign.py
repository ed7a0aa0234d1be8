"""Policies and residuals of other projects are read without executing anything."""

import os
import pickle

import numpy as np
import pytest

import quadjax
from quadjax.core.errors import InputError
from quadjax.policy.file import Policy
from quadjax.policy.foreign import policy_of
from quadjax.policy.foreign_residual import import_residual
from quadjax.policy.torch_files import LEGACY, read_state_dict
from quadjax.vehicle.residual import read_residual
from tests.commands import run
from tests.policy.torch_writer import archive, linear, sb3_model, sb3_tensors, state_dict

RELU = {"policy_kwargs": {":type:": "<class 'dict'>", ":serialized:": "gASVAAAAAAAAAAAu"}}
RELU["policy_kwargs"]["activation_fn"] = "<class 'torch.nn.modules.activation.ReLU'>"


def forward(arrays, names, x, activation):
    """The network in NumPy, from its PyTorch arrays."""
    for index, name in enumerate(names):
        x = x @ arrays[f"{name}.weight"].T.astype(float) + arrays[f"{name}.bias"]
        x = activation(x) if index < len(names) - 1 else x
    return x


@pytest.mark.parametrize(
    ("data", "kind", "activation"),
    [(RELU, "relu", lambda x: np.maximum(x, 0)), ({"policy_kwargs": {}}, "tanh", np.tanh)],
)
def test_a_model_of_stable_baselines3(tmp_path, data, kind, activation):
    arrays = sb3_tensors()
    policy = Policy.load(sb3_model(tmp_path / "model.zip", arrays, data), "e2e_paper")
    assert policy.activation == kind and policy.vehicle == "motor" and policy.noise_on == "mean"
    np.testing.assert_array_equal(policy.log_std, arrays["log_std"])
    x = np.random.default_rng(0).normal(size=(9, 24))
    names = ["mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"]
    wanted = np.clip(forward(arrays, names, x, activation), -1, 1)
    np.testing.assert_allclose(policy(x.astype(np.float32)), wanted, atol=1e-5)
    names = ["mlp_extractor.value_net.0", "mlp_extractor.value_net.2", "value_net"]
    critic = {f"{i}.weight": k.T for i, (k, _) in enumerate(policy.value)}
    critic |= {f"{i}.bias": b for i, (_, b) in enumerate(policy.value)}
    own = forward(critic, "012", x, activation)
    np.testing.assert_allclose(own, forward(arrays, names, x, activation), atol=1e-5)
    policy.save(tmp_path / "policy.npz")
    again = Policy.load(tmp_path / "policy.npz")
    assert again.layout.labels == policy.layout.labels and again.config["name"] == "e2e_paper"


def c_source(arrays, std="{0.1f, 0.2f, 0.3f, 0.4f}", flat=True, body="return relu(x);"):
    """C arrays as INDIflight has them: row by row per output."""
    lines = ["// weights_fake[2] = {1, 2};", "#include <math.h>"]
    for number in range(1, len(arrays) // 2 + 1):
        weight, bias = arrays[f"{2 * number - 2}.weight"], arrays[f"{2 * number - 2}.bias"]
        rows = [", ".join(f"{x:.9g}f" for x in row) for row in weight]
        inner = ", ".join(rows) if flat else ", ".join(f"{{{row}}}" for row in rows)
        shape = "[]" if flat else f"[{weight.shape[0]}][{weight.shape[1]}]"
        lines.append(f"static const float weights_fc{number}{shape} = {{{inner}}};")
        numbers = ", ".join(f"{x:.9g}" for x in bias)
        lines.append(f"const float biases_fc{number}[{len(bias)}] = {{\n{numbers},\n}};")
    return "\n".join([*lines, f"const float output_std[4] = {std};", f"void f() {{ {body} }}"])


@pytest.mark.parametrize("flat", [True, False])
def test_arrays_of_c_source(tmp_path, flat):
    arrays, path = linear((24, 6, 5, 4)), tmp_path / "neural_network.c"
    path.write_text(c_source(arrays, flat=flat))
    policy = Policy.load(path, "e2e_paper")
    assert policy.activation == "relu"
    np.testing.assert_allclose(np.exp(policy.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    for index, (kernel, bias) in enumerate(policy.layers):
        np.testing.assert_array_equal(kernel, arrays[f"{2 * index}.weight"].T)
        np.testing.assert_array_equal(bias, arrays[f"{2 * index}.bias"])


def test_motors_and_their_range_in_another_order(tmp_path):
    """INDIflight numbers rear-right, front-right, rear-left, front-left."""
    arrays, path, out = linear((24, 6, 4)), tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(arrays))
    options = ("--motors", 4, 2, 1, 3, "--actuator-range", 0, 12000, "--output", out)
    assert run("import", "e2e_paper", path, *options) == 0
    policy, plain = Policy.load(out), Policy.load(path, "e2e_paper")
    assert policy.layout["rpm"].span == ((0.0, 12000.0),) * 4
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
        import_residual(residual_files[1], residual_files[0], (3000, 11000), 1)


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
    "a bare pickle": (evil_pickle(), "not a PyTorch state dict"),
    "a builtin": (archive(b"cbuiltins\neval\n(X\x01\x00\x00\x001tR.", {}), "builtins.eval"),
    "the legacy format": (LEGACY + b"rest", "legacy format"),
    "beyond its storage": (state_dict(linear((7, 1)), offset=1), "larger than its storage"),
    "repeated storage": (state_dict(linear((7, 1)), **HUGE), "larger than its storage"),
    "negative strides": (state_dict(linear((7, 1)), stride=(-1, 1)), "impossible shape"),
    "a short storage": (state_dict(linear((7, 1)), count=9), "expected 9"),
    "no tensors": (archive(b"\x80\x02K\x01.", {}), "holds a int"),
    "no pickle": (archive(b"", {}), "not a PyTorch state dict"),
    "empty": (b"", "not a PyTorch state dict"),
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


def test_files_damaged_at_random_are_read_or_refused(tmp_path):
    rng, refused, path = np.random.default_rng(0), 0, tmp_path / "a.pt"
    whole = np.frombuffer(state_dict(linear((24, 4))), np.uint8)
    for _ in range(150):
        changed = whole.copy()
        changed[rng.integers(len(whole), size=rng.choice([1, 5, 50]))] = rng.integers(256)
        begin = rng.integers(len(whole))
        end = rng.choice([begin, begin + 4, len(whole)])
        path.write_bytes(np.delete(changed, slice(begin, end)).tobytes())
        try:
            read_state_dict(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 1000
    assert refused > 10


def without(arrays, *names):
    return {name: array for name, array in arrays.items() if name not in names}


def as_model(path, arrays=None, data=RELU):
    return sb3_model(path.with_suffix(".zip"), sb3_tensors() if arrays is None else arrays, data)


def as_dict(path, arrays):
    path.with_suffix(".pt").write_bytes(state_dict(arrays))
    return path.with_suffix(".pt")


def as_c(path, text):
    path.with_suffix(".c").write_text(text)
    return path.with_suffix(".c")


NET = linear((24, 6, 4))
SHARED = sb3_tensors() | {"mlp_extractor.shared_net.0.weight": np.zeros((3, 3), np.float32)}
SAC = linear((24, 6, 4), prefix="actor.latent_pi.")
GSDE = sb3_tensors() | {"log_std": np.zeros((8, 4), np.float32)}
CONV = {"0.weight": np.zeros((2, 2, 3, 3), np.float32), "0.bias": np.zeros(2, np.float32)}
ELU = {"policy_kwargs": {"activation_fn": "<class 'x.ELU'>"}}
NAN = NET | {"2.bias": np.array([0, np.nan, 0, 0], np.float32)}


MISFITS = [  # file, options, what the message says
    (as_model, {}, {"config": "indi_paper"}, "takes 24 numbers, .* observe 17: posi"),
    (as_model, {}, {"activation": "tanh"}, "its activation is relu, not tanh"),
    (as_model, {}, {"std": 0.1}, "has a standard deviation"),
    (as_model, {"arrays": sb3_tensors(actions=3)}, {}, "3 standard deviations"),
    (as_model, {"arrays": SAC}, {}, "PPO or A2C"),
    (as_model, {"arrays": GSDE}, {}, "no gSDE"),
    (as_model, {"arrays": SHARED}, {}, "shared_net"),
    (as_model, {"data": ELU}, {}, "the activation is elu, allowed: relu, tanh"),
    (as_dict, {"arrays": NET}, {"activation": "relu"}, "give the noise's std"),
    (as_dict, {"arrays": NET}, {"std": 0.1}, "not in the file, give it"),
    (as_dict, {"arrays": without(NET, "2.bias")}, {}, "2.weight has no 2.bias"),
    (as_dict, {"arrays": CONV}, {}, "kernel_0 has shape"),
    (as_dict, {"arrays": NAN}, {}, r"bias_1\[1\] is nan"),
    (as_c, {"text": c_source(NET, std="{0, 1, 1, 1}")}, {}, "expected numbers above 0"),
    (as_c, {"text": c_source(NET, std="{1, 1, 1, system(1)}")}, {}, "expected a number"),
    (as_c, {"text": c_source(NET).replace("biases_fc1[6]", "biases_fc1[7]")}, {}, "says 7"),
    (as_c, {"text": "int main() { return 0; }"}, {}, "no array weights_"),
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


@pytest.mark.slow
def test_an_imported_policy_flies_like_the_original(tmp_path):
    """A shipped policy, written as a state dict and imported, has the same laps."""
    own = Policy.load("quadjax/pretrained/e2e_nominal.npz")
    arrays = {}
    for index, (kernel, bias) in enumerate(own.layers):
        arrays |= {f"{index}.weight": kernel.T.copy(), f"{index}.bias": bias}
    path = as_dict(tmp_path / "a", {"log_std": own.log_std, **arrays})
    config = quadjax.load("e2e")
    same = Policy.load(path, config, activation="relu")
    laps = [quadjax.evaluate(p, config, runs=1, deterministic=True).totals for p in (own, same)]
    np.testing.assert_allclose(laps[0], laps[1], atol=0.011)


def test_the_ends_of_an_actuator_range_are_in_order(tmp_path):
    path = as_dict(tmp_path / "net", NET)
    with pytest.raises(InputError, match="the lowest below the highest"):
        policy_of(path, "e2e", "relu", 0.1, None, (3000.0, 0.0))
