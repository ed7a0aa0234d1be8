import sys

import jax
import numpy as np
import pytest

from benchmarks import recovery
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.simulate import random_residual
from quadjax.vehicle.residual import read_residual, residual_force_moment, write_residual
from tests.commands import run

from .conftest import REPOSITORY

OUTPUTS = jax.jit(jax.vmap(residual_force_moment, in_axes=(None, 0, 0, 0)))


def _outputs(residual, count=4000):
    random = np.random.default_rng(7)
    rpm = random.uniform(3000.0, 11000.0, (count, 4)).astype(np.float32)
    velocity = random.uniform(-8.0, 8.0, (count, 3)).astype(np.float32)
    rates = random.uniform(-6.0, 6.0, (count, 3)).astype(np.float32)
    force, moment = OUTPUTS(residual, Rotors.of(rpm), Vec3.of(velocity), Vec3.of(rates))
    return np.asarray(force), np.stack(moment.components(), axis=1)


def test_outputs_have_the_asked_spread_over_the_envelope():
    force, moment = _outputs(random_residual(3, 1.0, 0.015))
    assert abs(np.std(force) - 1.0) < 0.05 and abs(np.mean(force)) < 0.05
    np.testing.assert_allclose(np.std(moment, axis=0), 0.015, rtol=0.05)


def test_same_seed_same_residual_other_seed_another():
    first, again, other = (_outputs(random_residual(seed))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_survives_the_file(tmp_path):
    residual = random_residual(0)
    write_residual(tmp_path / "r.npz", residual, {})
    read = _outputs(read_residual(tmp_path / "r.npz"))
    for a, b in zip(_outputs(residual), read, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("arguments", [(0, -1.0), (0, 1.0, float("nan")), (0, 1.0, 0.1, 0)])
def test_impossible_sizes_are_refused(arguments):
    with pytest.raises(InputError):
        random_residual(*arguments)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["logs"], "--output"),
        (["logs", "--output", "logs", "--random-residual", "-1"], "--random-residual"),
        (["logs", "--output", "logs", "--moment-std", "nan"], "--moment-std"),
        (["logs", "--output", "logs", "--thrust-std", "1"], "without --random-residual"),
        (["logs", "--output", "logs", "--seconds", "0"], "--seconds"),
        (["logs", "--output", "/dev/null/logs"], "/dev/null/logs"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, arguments, names):
    assert run(*arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and names in lines[0]


@pytest.mark.slow
def test_logs_of_a_known_model_are_fitted_and_compared(tmp_path, monkeypatch, capsys):
    logs = tmp_path / "logs"
    arguments = ["--random-residual", 5, "--moment-std", 0.005, "--flights", 2, "--seconds", 5]
    assert run("logs", "--output", logs, *arguments) == 0
    first = (logs / "flight_0.csv").stat().st_mtime_ns
    assert run("logs", "--output", logs, *arguments) == 2  # earlier logs stay
    assert (logs / "flight_0.csv").stat().st_mtime_ns == first
    arguments = [
        f"logs.files=[{logs}/*.csv]",
        "figures=false",
        "--output",
        tmp_path,
        "--name",
        "known",
    ]
    fast = "residual={seeds: 1, epochs: 2}"
    assert run("fit", REPOSITORY / "configs/fit/paparazzi.yaml", *arguments, fast) == 0
    capsys.readouterr()
    arguments = ["--fit", tmp_path / "known", "--residual", logs / "residual.npz", "--flights", 1]
    monkeypatch.setattr(sys, "argv", ["recovery", *map(str, arguments)])
    recovery.main()
    output = capsys.readouterr().out
    assert "k_w" in output and "R^2 of residual" in output
