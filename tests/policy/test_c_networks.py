"""Networks in C as the authors of the paper publish them: read as text.

The authors' files are not in this repository: tests of them run where they are in ``../shared``.
"""

import hashlib
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from quadjax.core.vectors import Rotors, Vec3
from quadjax.evaluation import published as table_1
from quadjax.policy.file import Policy
from quadjax.policy.inference import mean_action, policy_params
from quadjax.vehicle.residual import digest, read_residual, residual_force_moment
from tests.commands import run
from tests.policy.writers import c_source, forward, linear, relu

ROOT = Path(__file__).resolve().parents[2]
AUTHORS = ROOT.parent / "shared" / "authors"
PAGE = ROOT / "docs" / "guide" / "other_trainers.md"
E2E = [AUTHORS / "e2e" / name for name in ("neural_network.c", "nn_controller.c")]
INDI = [AUTHORS / "indi" / name for name in ("neural_network.c", "nn_controller.c")]
RESIDUAL = [AUTHORS / "residual" / name for name in ("nn_thrust.c", "nn_moment.c")]
published = pytest.mark.skipif(not AUTHORS.is_dir(), reason="no files of the authors")

CONTROLLER = """#include "nn_controller.h"
const float output_std[4] = {
    0.1,
    0.2, // of the second
    0.3,
    0.4,
};
const float gate_pos[NUM_GATES][3] = { {2.0, -1.5, -1.5}, };
void nn_control(const float world_state[16], float rpms[4]) {
    float pos[3] = {world_state[0], world_state[1], world_state[2]};
}
"""


def write_c(path: Path, sizes: tuple[int, int, int], prefix: str = "", body: str = "relu(x);"):
    """A network of two layers in the authors' form, and its arrays."""
    arrays = linear(sizes)
    path.write_text(c_source(arrays, prefix, body=body))
    return arrays


def flight_inputs(count: int = 50):
    """rpm (n, 4), velocity (n, 3), rates (n, 3), and the first two as the networks take them."""
    draw = np.random.default_rng(0)
    rpm, velocity = draw.uniform(3000, 11000, (count, 4)), draw.normal(size=(count, 3)) * 5
    scaled = np.concatenate([(rpm - 3000) * 2 / 8000 - 1, velocity], axis=1)
    return rpm, velocity, draw.normal(size=(count, 3)) * 3, scaled


def residual_outputs(residual, rpm, velocity, rates):
    """Force along body z (n,) and moment (n, 3)."""

    def one(w, v, r):
        force, moment = residual_force_moment(residual, Rotors.of(w), Vec3.of(v), Vec3.of(r))
        return force, moment.array()

    outputs = jax.jit(jax.vmap(one))(*(np.float32(x) for x in (rpm, velocity, rates)))
    return [np.asarray(x) for x in outputs]


@pytest.fixture
def files(tmp_path):
    """Policy, standard deviations, thrust and moment, and the arrays of the three networks."""
    names = ("neural_network.c", "nn_controller.c", "nn_thrust.c", "nn_moment.c")
    paths = [tmp_path / name for name in names]
    paths[1].write_text(CONTROLLER)
    arrays = [
        write_c(paths[0], (24, 6, 4)),
        write_c(paths[2], (7, 5, 1), "nn_thrust_"),
        write_c(paths[3], (10, 5, 3), "nn_moment_"),
    ]
    return paths, arrays


@pytest.mark.parametrize("with_policy", [False, True])
def test_a_residual_of_two_c_files(tmp_path, files, with_policy):
    """Also in one file with the policy, in place of a residual of the config that is not there."""
    names, (policy_arrays, force_arrays, moment_arrays) = files
    out = tmp_path / "residual.npz"
    words = (*(names if with_policy else names[2:]), "--thrust-sign", 1, "--output", out)
    assert run("import", "e2e_table1", *words) == 0
    rpm, velocity, rates, scaled = flight_inputs(9)
    force, moments = residual_outputs(read_residual(out), rpm, velocity, rates)
    equal(force, forward(force_arrays, scaled, activation=relu)[:, 0])
    both = np.concatenate([scaled, rates], axis=1)
    equal(moments, forward(moment_arrays, both, activation=relu))
    if with_policy:
        policy = Policy.load(out)
        assert policy.config["vehicle"]["residual"] == str(out) and policy.activation == "relu"
        np.testing.assert_allclose(np.exp(policy.log_std), [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
        x = np.random.default_rng(1).normal(size=(9, 24))
        own = mean_action(policy_params(policy), np.float32(x))
        equal(own, forward(policy_arrays, x, activation=relu))


def test_c_files_that_do_not_fit_are_one_line(tmp_path, files, capsys):
    (network, controller, thrust, moment), _ = files
    write_c(tmp_path / "tanh.c", (7, 5, 1), "nn_thrust_", "tanh(x);")
    (tmp_path / "both.c").write_text(thrust.read_text() + moment.read_text())
    (tmp_path / "whole.c").write_text(network.read_text() + CONTROLLER)
    (tmp_path / "three.c").write_text("const float output_std[3] = {0.1, 0.1, 0.1};")
    sign = ("--thrust-sign", 1)
    for arguments, says in (
        ((network,), "no log_std or output_std"),
        ((tmp_path / "whole.c", controller), "has a standard deviation, so"),
        ((network, controller, "--std", 0.1), "--std has no effect"),
        ((network, tmp_path / "three.c"), "3 standard deviations, expected 4"),
        ((thrust, moment), "--thrust-sign is missing"),
        ((moment, thrust, *sign), "the thrust network maps 10 inputs to 3 outputs"),
        ((tmp_path / "both.c", moment, *sign), "has nn_thrust_weights_fc1, nn_thrust_weights"),
        ((tmp_path / "tanh.c", moment, *sign), "its activation is tanh, a residual has relu"),
    ):
        assert run("import", "e2e_paper", *arguments, "--output", tmp_path / "out.npz") == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1, error
    assert not (tmp_path / "out.npz").exists()


def equal(own, wanted):
    """Equal to 1e-5 of the largest output."""
    np.testing.assert_allclose(own, wanted, rtol=1e-5, atol=1e-5 * np.abs(wanted).max())


@published
def test_the_authors_residual_is_the_one_of_table_1(tmp_path):
    out = tmp_path / "residual.npz"
    assert run("import", "e2e_table1", *RESIDUAL, "--thrust-sign", 1, "--output", out) == 0
    assert digest(read_residual(out)) == table_1.RESIDUAL


@published
def test_the_guide_has_the_digests_of_the_authors_files():
    page = PAGE.read_text()
    for path in (*E2E, *INDI, *RESIDUAL):
        assert hashlib.sha256(path.read_bytes()).hexdigest() in page, path


@published
@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "trained", "race", "row"),
    [
        (
            [*E2E, *RESIDUAL, "--thrust-sign", 1],
            "e2e_paper +authors_code",
            "e2e_table1",
            table_1.E2E,
        ),
        (INDI, "indi_table1", "indi_table1", table_1.INDI),
    ],
    ids=["E2E", "INDI"],
)
def test_the_authors_policies_fly_the_times_of_table_1(tmp_path, capsys, files, trained, race, row):
    """The two commands of the guide."""
    out, laps = tmp_path / "policy.npz", tmp_path / "laps.json"
    assert run("import", trained, *files, "--output", out) == 0
    residual = [f"vehicle.residual={out}"] if "--thrust-sign" in files else []
    arguments = (race, *residual, "--policy", out, "--runs", 20, "--json", laps)
    assert run("evaluate", *arguments) == 0
    result = json.loads(laps.read_text())
    assert result["finished"] == result["runs"] == 20 and not result["deterministic"]
    assert np.mean(result["totals"]) == pytest.approx(row.total, abs=0.1)
    assert row.policy in capsys.readouterr().out
