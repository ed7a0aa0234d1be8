"""Policies and residuals of other projects, as C arrays; PyTorch's are in ``test_torch_files``."""

import sys
import types
import zipfile

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.policy.file import Policy
from quadjax.policy.network_files import read_network
from quadjax.policy.race import race_of_policy
from quadjax.vehicle.residual import read_residual, residual_force_moment
from tests.commands import run
from tests.policy.writers import (
    CONTROLLER,
    c_source,
    forward,
    linear,
    relu,
    write_authors_files,
)

OF_ROTORS = "tests.policy.writers:OF_ROTORS"
STD = "{0.1f, 0.2f, 0.3f, 0.4f}"


def equal(found, wanted):
    """Equal to 1e-5 of the largest output."""
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5 * np.abs(wanted).max())


RACES = {  # with what they observe of each motor
    "e2e_paper": (["rpm"], []),
    "e2e_race": (
        ["rotor_speed", "last_action", "squares"],
        ["vehicle=5inch", "observation.last_action=true", f"observation.extra=[{OF_ROTORS}]"],
    ),
}


@pytest.mark.parametrize("race", RACES)
def test_motors_in_another_order_command_the_same_in_every_state(race, tmp_path):
    """INDIflight numbers rear-right, front-right, rear-left, front-left."""
    fields, changes = RACES[race]
    layout = make_race(load_config(race, changes))[0].layout
    arrays, path, out = linear((layout.size, 6, 4)), tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(arrays, std=STD, flat=False))
    options = ("--motors", 4, 2, 1, 3, "--activation", "relu", "--output", out)
    assert run("import", race, path, *changes, *options) == 0
    policy, plain = Policy.load(out), Policy.load(path, load_config(race, changes))
    np.testing.assert_allclose(np.exp(plain.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    seen = np.random.default_rng(0).normal(size=(3, layout.size)).astype(np.float32)
    there = seen.copy()
    for start in (layout.slice(name).start for name in fields):
        for front, other in enumerate((3, 1, 0, 2)):
            there[:, start + other] = seen[:, start + front]
    wanted = np.clip(forward(arrays, there, activation=relu), -1, 1)[:, [3, 1, 0, 2]]
    np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)
    np.testing.assert_allclose(policy.log_std, plain.log_std[[3, 1, 0, 2]])


def test_the_range_of_the_actuators_is_that_of_the_config_that_is_stored(tmp_path):
    path, out = tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(linear((24, 4)), std=STD))
    words = ("--activation", "relu", "--output", out, "--actuator-range")
    assert run("import", "e2e_paper", path, *words, 0, 12000) == 0
    policy = Policy.load(out)
    assert policy.layout["rpm"].span == ((0.0, 12000.0),) * 4
    assert policy.config["observation"]["actuator_range"] == [0.0, 12000.0]
    assert race_of_policy(policy)[0].observation.actuator_range == (0.0, 12000.0)


SQUARE = "is square, and no other layer tells whether its rows are inputs or outputs"
DECLARED = {  # sizes of the weights of layers 3 -> 2 -> 2, as they are stored; or what is refused
    "[3][2] [2][2]": "ok",
    "[2][3] [2][2]": "ok",
    "[IN][2] [2][2]": "ok",
    "[IN][OUT] [N][N]": "ok",
    "[2*1][3] [4]": "ok",
    "[6] [2][2]": f"weights_fc2 {SQUARE}, expected weights_fc2[4] with a row for each output",
    "[1][2][3] [4]": "weights_fc1 has other dimensions than are read, expected rows of equal",
}


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("sizes", DECLARED)
def test_arrays_with_a_row_for_each_input(sizes, nested, tmp_path):
    """The declared sizes and the biases tell; square weights follow the others."""
    first, second = np.arange(1.0, 7.0).reshape(3, 2), np.array([[7.0, 8.0], [9.0, 10.0]])
    by_input = sizes.startswith(("[3]", "[IN]"))
    text = ["relu(x)"]
    for number, (kernel, size) in enumerate(zip((first, second), sizes.split(), strict=False), 1):
        stored = kernel if by_input else kernel.T
        rows = [", ".join(map(str, row)) for row in stored]
        body = ", ".join(f"{{{row},}}" for row in rows) if nested else ", ".join(rows)
        text.append(f"float weights_fc{number}{size} = {{{body}}};")
        text.append(f"float biases_fc{number}[2] = {{0, 0}};")
    path = tmp_path / "a.c"
    path.write_text("\n".join(text))
    says = DECLARED[sizes]
    if not nested and "[IN][OUT]" in sizes:
        says = "weights_fc1 has other dimensions"
    if says != "ok":
        with pytest.raises(InputError) as caught:
            read_network(path)
        assert says in str(caught.value)
        return
    found = [kernel for kernel, _ in read_network(path).layers]
    for kernel, wanted in zip(found, (first, second), strict=False):
        np.testing.assert_array_equal(kernel, wanted)


def residual_outputs(residual, rpm, velocity, rates):
    """Force along body z (n,) and moment (n, 3)."""

    def one(w, v, r):
        force, moment = residual_force_moment(residual, Rotors.of(w), Vec3.of(v), Vec3.of(r))
        return force, moment.array()

    outputs = jax.jit(jax.vmap(one))(*(np.float32(x) for x in (rpm, velocity, rates)))
    return [np.asarray(x) for x in outputs]


@pytest.mark.parametrize("with_policy", [False, True])
def test_a_residual_of_two_files(tmp_path, monkeypatch, with_policy):
    """Also in one file with the policy, in place of a residual of the config that is not there."""
    monkeypatch.chdir(tmp_path)
    of_policy, _, of_force, of_moment = write_authors_files()
    files = ["nn_thrust.c", "nn_moment.c"]
    if with_policy:
        files = ["E2Enet/neural_network.c", "E2Enet/nn_controller.c", *files]
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
    if with_policy:
        policy, x = Policy.load("a.npz"), draw.normal(size=(9, 24))
        assert policy.config["vehicle"]["residual"] == "a.npz" and policy.activation == "relu"
        np.testing.assert_allclose(np.exp(policy.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
        wanted = np.clip(forward(of_policy, x, activation=relu), -1, 1)
        np.testing.assert_allclose(policy(np.float32(x)), wanted, atol=1e-5)


LIBRARIES = {  # suffix: what is missing or old, the name of its extra, and what is needed
    ".pt": ("torch", "2.5.1", "torch", "PyTorch 2.6"),
    ".zip": ("stable_baselines3", "2.7.1", "sb3", "Stable-Baselines3 2.8"),
}


@pytest.mark.parametrize("found", [False, True], ids=["missing", "old"])
@pytest.mark.parametrize("suffix", LIBRARIES)
def test_a_library_that_is_missing_or_old_is_one_line(suffix, found, tmp_path, monkeypatch, capsys):
    """Older versions may execute what is in a file."""
    module, version, extra, needed = LIBRARIES[suffix]
    monkeypatch.setitem(sys.modules, "torch", types.SimpleNamespace(__version__="2.6.0+cpu"))
    old = types.SimpleNamespace(__version__=version)
    monkeypatch.setitem(sys.modules, module, old if found else None)
    path = tmp_path / f"network{suffix}"
    with zipfile.ZipFile(path, "w") as archive:
        for name in {".pt": ("net/data.pkl",), ".zip": ("policy.pth", "data")}[suffix]:
            archive.writestr(name, b"")
    assert run("import", "e2e_paper", path, "--output", tmp_path / "a.npz") == 2
    error = capsys.readouterr().err
    says = f"this needs {needed} or newer: pip install 'quadjax[{extra}]'"
    assert error == f"error: {path}: {says}\n"


NET = linear((24, 6, 4))
FILES = {
    "one_bias.c": c_source(NET, std=STD).replace("biases_fc2", "offsets"),
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
std.c --config indi_paper | takes 24 numbers, policies of indi_paper observe 17: posi
std.c --activation tanh | its activation is relu, not tanh
std.c --thrust-sign 1 | --thrust-sign has no effect on a policy
std.c std.c std.c std.c | 4 networks and 0 files
std.c --motors 1 2 3 3 | expected each of 1 to 4 once
one_bias.c | weights_fc2 has no biases_fc2
zero.c | expected numbers above 0
size.c | says 7
std.c --actuator-range 2 1 | actuator_range is [2, 1], allowed: [lowest, highest]
std.c observation.actuators=false --actuator-range 0 1 | null without observation.actuators
std.c {RESIDUAL} --thrust-sign 1 --motors 4 2 1 3 | --motors has no effect on a residual
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
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    command, _, says = row.partition(" | ")
    command, _, config = command.partition(" --config ")
    assert run("import", config or "e2e_paper", *command.split(), "--output", "a.npz") == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not (tmp_path / "a.npz").exists()


CALLS = {  # the body of ..forward of two layers, and the activation; or what is refused
    "nn_relu(h);": "relu",
    "act_tanhf(h);": "tanh",
    "leaky_relu(h);": "leaky_relu",
    "nn_relu(h); nn_tanh(o);": "forward calls nn_relu, nn_tanh, expected one activation of the 1",
    "nn_tanh(h); nn_tanh(o);": "and none of the output",
}


@pytest.mark.parametrize("body", CALLS)
def test_a_network_whose_output_is_squashed_is_refused(body, tmp_path):
    path, wanted = tmp_path / "a.c", CALLS[body]
    forward = f"void nn_forward(float* x, float* o) {{ {body} }}"
    path.write_text(c_source(NET, body="") + "\nvoid nn_relu(float* x) {}\n" + forward)
    if " " in wanted:
        with pytest.raises(InputError, match=wanted):
            read_network(path)
    else:
        assert read_network(path).activation == wanted


def test_what_no_file_says_is_said_and_stacked_observations_are_named(tmp_path, capsys):
    path, out = tmp_path / "a.c", tmp_path / "a.npz"
    path.write_text(c_source(NET, std=STD))
    assert run("import", "e2e_paper", path, "--output", out) == 0
    assert "without statistics of its own (VecNormalize" in capsys.readouterr().err
    path.write_text(c_source(linear((72, 6, 3)), std=STD))
    assert run("import", "e2e_paper", path, "--output", out) == 2
    error = capsys.readouterr().err
    assert "takes 72 numbers, policies of e2e_paper observe 24: " in error
    assert error.endswith("; 3 stacked observations are not supported\n")
