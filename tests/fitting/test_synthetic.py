import runpy
import sys

import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.synthetic import make_residual
from quadjax.vehicle.residual import residual_force_moment
from quadjax.vehicle.residual_file import read_residual, write_residual


def _outputs(residual, count=4000):
    random = np.random.default_rng(7)
    rpm = random.uniform(3000.0, 11000.0, (count, 4)).astype(np.float32)
    velocity = random.uniform(-8.0, 8.0, (count, 3)).astype(np.float32)
    rates = random.uniform(-6.0, 6.0, (count, 3)).astype(np.float32)
    force, moment = jax.vmap(residual_force_moment, in_axes=(None, 0, 0, 0))(
        residual, Rotors.of(rpm), Vec3.of(velocity), Vec3.of(rates)
    )
    return np.asarray(force), np.asarray(moment.array())


def test_outputs_have_the_asked_spread_over_the_envelope():
    force, moment = _outputs(make_residual(3, 1.0, 0.015))
    assert abs(np.std(force) - 1.0) < 0.05 and abs(np.mean(force)) < 0.05
    np.testing.assert_allclose(np.std(moment, axis=0), 0.015, rtol=0.05)


def test_same_seed_same_residual_other_seed_another():
    first, again, other = (_outputs(make_residual(seed), 10)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_survives_the_file(tmp_path):
    residual = make_residual(0)
    write_residual(tmp_path / "r.npz", residual, {})
    read = _outputs(read_residual(tmp_path / "r.npz"), 10)
    for a, b in zip(_outputs(residual, 10), read, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("arguments", [(0, -1.0), (0, 1.0, float("nan")), (0, 1.0, 0.1, 0)])
def test_impossible_sizes_are_refused(arguments):
    with pytest.raises(InputError):
        make_residual(*arguments)


@pytest.mark.parametrize(
    ("command", "arguments", "names"),
    [
        ("synthetic", [], "--out"),
        ("synthetic", ["--out", "r.npz", "--seed", "-1"], "--seed"),
        ("synthetic", ["--out", "r.npz", "--width", "0"], "--width"),
        ("synthetic", ["--out", "/dev/null/r.npz"], "/dev/null/r.npz"),
        ("synthetic", ["--out", "r.txt"], ".npz"),
        ("synthetic_log", ["--out", "logs", "--seconds", "0"], "--seconds"),
        ("synthetic_log", ["--out", "/dev/null/logs"], "/dev/null/logs"),
        ("recovery", ["--fit", "none", "--flights", "none"], "--flights"),
    ],
)
def test_bad_input_is_one_line_and_status_2(monkeypatch, capsys, command, arguments, names):
    monkeypatch.setattr(sys, "argv", [command, *arguments])
    monkeypatch.delitem(sys.modules, f"quadjax.fitting.{command}", raising=False)
    with pytest.raises(SystemExit) as end:
        runpy.run_module(f"quadjax.fitting.{command}", run_name="__main__")
    lines = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2 and len(lines) == 1 and names in lines[0]
