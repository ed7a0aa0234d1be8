"""Policies and residuals of other projects are read without executing anything."""

import os
import pickle

import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.policy.file import Policy
from quadjax.policy.network_files import read_state_dict
from quadjax.vehicle.residual import read_residual, residual_force_moment
from tests.commands import run
from tests.policy.writers import (
    CONTROLLER,
    archive,
    c_source,
    forward,
    linear,
    relu,
    sb3_model,
    sb3_tensors,
    state_dict,
    write_authors_files,
)

RELU = {"policy_kwargs": {":type:": "<class 'dict'>", ":serialized:": "gASVAAAAAAAAAAAu"}}
RELU["policy_kwargs"]["activation_fn"] = "<class 'torch.nn.modules.activation.ReLU'>"
STD = "{0.1f, 0.2f, 0.3f, 0.4f}"


def equal(found, wanted):
    """Equal to 1e-5 of the largest output."""
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5 * np.abs(wanted).max())


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
    equal(forward(critic, x, "012", activation), forward(arrays, x, names, activation))
    policy.save(tmp_path / "policy.npz")
    again = Policy.load(tmp_path / "policy.npz")
    assert again.layout.labels == policy.layout.labels and again.config["name"] == "e2e_paper"


def test_motors_and_their_range_in_another_order(tmp_path):
    """INDIflight numbers rear-right, front-right, rear-left, front-left."""
    arrays, path, out = linear((24, 6, 4)), tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(arrays, std=STD, flat=False))
    options = ("--motors", 4, 2, 1, 3, "--actuator-range", 0, 12000, "--output", out)
    assert run("import", "e2e_paper", path, *options) == 0
    policy, plain = Policy.load(out), Policy.load(path, "e2e_paper")
    assert policy.layout["rpm"].span == ((0.0, 12000.0),) * 4
    np.testing.assert_allclose(np.exp(plain.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    seen = np.random.default_rng(0).normal(size=(3, 24)).astype(np.float32)
    there, where = seen.copy(), policy.layout.slice("rpm").start
    for front, other in enumerate((3, 1, 0, 2)):
        there[:, where + other] = seen[:, where + front]
    wanted = np.clip(forward(arrays, there, activation=relu), -1, 1)[:, [3, 1, 0, 2]]
    np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)
    np.testing.assert_allclose(policy.log_std, plain.log_std[[3, 1, 0, 2]])


def residual_outputs(residual, rpm, velocity, rates):
    """Force along body z (n,) and moment (n, 3)."""

    def one(w, v, r):
        force, moment = residual_force_moment(residual, Rotors.of(w), Vec3.of(v), Vec3.of(r))
        return force, moment.array()

    outputs = jax.jit(jax.vmap(one))(*(np.float32(x) for x in (rpm, velocity, rates)))
    return [np.asarray(x) for x in outputs]


@pytest.mark.parametrize("kind", ["state dicts", "C", "C with a policy"])
def test_a_residual_of_two_files(tmp_path, monkeypatch, kind):
    """Also in one file with the policy, in place of a residual of the config that is not there."""
    monkeypatch.chdir(tmp_path)
    of_policy, _, of_force, of_moment = write_authors_files()
    files = ["nn_thrust.c", "nn_moment.c"]
    if kind == "state dicts":
        files = ["thrust.pt", "moment.pth"]
        for name, arrays in zip(files, (of_force, of_moment), strict=True):
            (tmp_path / name).write_bytes(state_dict(arrays))
    if kind == "C with a policy":
        files += ["E2Enet/neural_network.c", "E2Enet/nn_controller.c"]
        files = files[2:] + files[:2]
    words = ("vehicle.constants.rpm_max=12000", "--thrust-sign", -1, "--output", "a.npz")
    assert run("import", "e2e_table1", *files, *words) == 0
    residual, draw = read_residual("a.npz"), np.random.default_rng(0)
    assert (residual.rpm_min, residual.rpm_max, residual.thrust_sign) == (3000, 12000, -1)
    rpm, velocity = draw.uniform(3000, 12000, (9, 4)), draw.normal(size=(9, 3)) * 5
    rates = draw.normal(size=(9, 3)) * 3
    force, moment = residual_outputs(residual, rpm, velocity, rates)
    scaled = np.concatenate([(rpm - 3000) * 2 / 9000 - 1, velocity], axis=1)
    equal(force, -forward(of_force, scaled, activation=relu)[:, 0])
    equal(moment, forward(of_moment, np.concatenate([scaled, rates], axis=1), activation=relu))
    if kind == "C with a policy":
        policy, x = Policy.load("a.npz"), draw.normal(size=(9, 24))
        assert policy.config["vehicle"]["residual"] == "a.npz" and policy.activation == "relu"
        np.testing.assert_allclose(np.exp(policy.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
        wanted = np.clip(forward(of_policy, x, activation=relu), -1, 1)
        np.testing.assert_allclose(policy(np.float32(x)), wanted, atol=1e-5)


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


HUGE = {"size": (2**20, 2**20), "stride": (0, 0)}
HARMFUL = {
    "a pickle that runs a command": (
        archive(pickle.dumps({"0.weight": Evil()}, protocol=2), {}),
        "which is not loaded",
    ),
    "the legacy format": (pickle.dumps(0x1950A86A20F9469CFC6C), "legacy format"),
    "beyond its storage": (state_dict(linear((7, 1)), offset=1), "larger than its storage"),
    "repeated storage": (state_dict(linear((7, 1)), **HUGE), "larger than its storage"),
    "a short storage": (state_dict(linear((7, 1)), count=9), "expected 9"),
}


@pytest.mark.parametrize("what", HARMFUL)
def test_harmful_and_damaged_files_are_refused_in_one_line(tmp_path, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    path, (data, words) = tmp_path / "network.pt", HARMFUL[what]
    path.write_bytes(data)
    with pytest.raises(InputError) as error:
        Policy.load(path, "e2e_paper", activation="relu", std=0.1)
    assert words in str(error.value) and "\n" not in str(error.value)
    assert [each.name for each in tmp_path.iterdir()] == ["network.pt"]  # nothing was executed


NET = linear((24, 6, 4))
ONE_BIAS = {name: array for name, array in NET.items() if name != "2.bias"}
SHARED = sb3_tensors() | {"mlp_extractor.shared_net.0.weight": np.zeros((3, 3), np.float32)}
ELU = {"policy_kwargs": {"activation_fn": "<class 'x.ELU'>"}}
MODELS = {  # of Stable-Baselines3
    "model.zip": (sb3_tensors(), RELU),
    "sac.zip": (linear((24, 6, 4), prefix="actor.latent_pi."), RELU),
    "shared.zip": (SHARED, RELU),
    "elu.zip": (sb3_tensors(), ELU),
}
FILES = {
    "net.pt": state_dict(NET),
    "one_bias.pt": state_dict(ONE_BIAS),
    "zero.c": c_source(NET, std="{0, 1, 1, 1}"),
    "size.c": c_source(NET, std=STD).replace("s_fc1[6]", "s_fc1[7]"),
    "std.c": c_source(NET, std=STD),
    "three.c": "const float output_std[3] = {0.1, 0.1, 0.1};",
    "controller.c": CONTROLLER,
    "tanh.c": c_source(linear((7, 5, 1)), "nn_thrust_", body="tanh(x);"),
    "both.c": c_source(linear((7, 5, 1)), "nn_thrust_")
    + c_source(linear((10, 5, 3)), "nn_moment_"),
}
NETWORK, RESIDUAL = "E2Enet/neural_network.c", "nn_thrust.c nn_moment.c"
REFUSED = f"""
model.zip --config indi_paper | takes 24 numbers, policies of indi_paper observe 17: posi
model.zip --activation tanh | its activation is relu, not tanh
sac.zip | PPO or A2C
shared.zip | shared_net
elu.zip | the activation is elu, allowed: relu, tanh
model.zip --thrust-sign 1 | --thrust-sign has no effect on a policy
model.zip model.zip model.zip model.zip | 4 networks and 0 files
model.zip --motors 1 2 3 3 | expected each of 1 to 4 once
net.pt --activation relu | give the noise's std
one_bias.pt | 2.weight has no 2.bias
zero.c | expected numbers above 0
size.c | says 7
{NETWORK} | no log_std or output_std
std.c controller.c | has a standard deviation, so
{NETWORK} controller.c --std 0.1 | --std has no effect
{NETWORK} three.c | 3 standard deviations, expected 4
{RESIDUAL} | --thrust-sign is missing
{RESIDUAL} --activation relu | --activation has no effect on a residual
nn_moment.c nn_thrust.c --thrust-sign 1 | the thrust network maps 10 inputs to 3 outputs
both.c nn_moment.c --thrust-sign 1 | has nn_thrust_weights_fc1, nn_thrust_weights
tanh.c nn_moment.c --thrust-sign 1 | its activation is tanh, a residual has relu
""".strip().splitlines()


@pytest.mark.parametrize("row", REFUSED)
def test_networks_that_do_not_fit_are_refused_in_one_line(row, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_authors_files()
    for name, model in MODELS.items():
        sb3_model(tmp_path / name, *model)
    for name, data in FILES.items():
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    command, _, says = row.partition(" | ")
    command, _, config = command.partition(" --config ")
    assert run("import", config or "e2e_paper", *command.split(), "--output", "a.npz") == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not (tmp_path / "a.npz").exists()
