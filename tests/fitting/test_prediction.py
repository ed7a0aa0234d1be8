"""Limits on how much a residual may increase the error of flights that it has not seen."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from quadjax.fitting.config import load_fit_config
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.nominal import ModelInputs, nominal, regressors, residual_output
from quadjax.fitting.pipeline import run_fit
from quadjax.fitting.prediction import (
    Prediction,
    harmful_constants,
    harmless_gains,
    limited_by_others,
    with_gains,
)
from quadjax.fitting.prepare import Samples
from quadjax.fitting.report import tables
from quadjax.fitting.simulate import random_residual, simulate_flight
from quadjax.vehicle.protocol import VehicleParams

from .conftest import REPOSITORY
from .flights import NOISE, RATE, SECONDS

AZ, MZ = 2, 5


def flight(name, factor):
    """The nominal model is off by noise; the residual on az is that times a factor."""
    error = np.random.default_rng(0).normal(size=(50, 6))
    full = np.zeros((50, 6))
    full[:, AZ] = factor * error[:, AZ]
    return Prediction(name, np.arange(50), error, np.zeros((50, 6)), full)


def test_the_worst_flight_limits_the_residual():
    helped = [flight(name, 0.9) for name in "abc"]
    np.testing.assert_array_equal(harmless_gains(helped, 0.1, 0.01), np.ones(4))
    gains = harmless_gains([*helped, flight("d", -0.5)], 0.1, 0.01)
    np.testing.assert_allclose(gains, [0.2, 1.0, 1.0, 1.0])
    assert flight("d", -0.5).change[AZ] == pytest.approx(0.5)
    assert flight("d", -0.5).scaled(gains).change[AZ] == pytest.approx(0.1)


def test_the_factor_on_a_flight_is_that_of_the_other_flights():
    """A flight that the residual harms is reported with its harm, and limits the others."""
    parts = [flight(name, 0.9) for name in "abc"] + [flight("d", -0.5)]
    found = limited_by_others(parts, 0.1, 0.01)
    assert found[3].change[AZ] == pytest.approx(0.5)
    for part in found[:3]:
        assert part.change[AZ] == pytest.approx(-0.18)  # 0.2 of 0.9
    alone = limited_by_others([flight("d", -0.5)], 0.1, 0.01)
    assert alone[0].change[AZ] == pytest.approx(0.5)


def test_a_residual_that_is_of_no_use_within_the_limit_is_dropped():
    gains = harmless_gains([flight("a", 0.3), flight("b", -0.5)], 0.1, 0.01)
    np.testing.assert_array_equal(gains, [0.0, 1.0, 1.0, 1.0])


def test_constants_that_harm_a_flight_are_named(bebop):
    """On the second flight the base vehicle's are right, and those fitted without it are not."""
    random = np.random.default_rng(0)
    motion = ModelInputs(random.uniform(3e3, 9e3, (40, 4)), *random.normal(size=(3, 40, 4)))
    motion = replace(motion, body_velocity=motion.body_velocity[:, :3], rates=motion.rates[:, :3])
    columns = regressors(motion)
    truth = nominal(bebop, motion) + 1e-3 * random.normal(size=(40, 6))
    flights, nothing = np.repeat([0, 1], 20), {axis: 0.0 * c for axis, c in columns.items()}
    samples = Samples(motion, columns, nothing, truth, flights, np.arange(40) / 50, 50.0)
    wrong = bebop.replace(k_x=2.0 * bebop.k_x)
    held_out = {"a": (flights == 0, bebop), "b": (flights == 1, wrong)}
    found = harmful_constants(samples, held_out, bebop, 0.1)
    assert list(found) == ["ax"] and "fitted without b" in found["ax"]


def test_gains_scale_the_outputs_of_the_networks():
    residual = random_residual(3)
    random = np.random.default_rng(0)
    inputs = ModelInputs(random.uniform(3e3, 9e3, (9, 4)), *random.normal(size=(3, 9, 4))[:, :, :3])
    gains = np.array([0.5, 0.0, 1.0, 0.25])
    found = residual_output(with_gains(residual, gains), inputs)
    np.testing.assert_allclose(found, gains * residual_output(residual, inputs), rtol=1e-6)


@pytest.mark.slow
def test_an_unlike_flight_is_not_harmed(bebop, tmp_path):
    """Of one flight the residual has the opposite sign: what fits the others harms it."""
    residual = random_residual(5, 1.0, (0.008, 0.008, 0.003))
    opposite = with_gains(residual, np.full(4, -1.0))
    for seed in range(4):
        drone = VehicleParams(bebop, opposite if seed == 3 else residual)
        write_log(
            tmp_path / f"flight_{seed}.csv", simulate_flight(drone, seed, SECONDS, RATE, NOISE)
        )
    training = "residual={seeds: 2, epochs: 10, distill_epochs: 20, batch: 256}"
    arguments = [f"logs.files=[{tmp_path}/*.csv]", training]
    config = load_fit_config(REPOSITORY / "configs/fit/paparazzi.yaml", arguments)
    result = run_fit(config, tmp_path)
    assert max(part.change.max() for part in result.unlimited) > 0.2
    scaled = [part.scaled(result.gains) for part in result.unlimited]
    assert max(part.change.max() for part in scaled) <= 0.1 + 1e-9
    assert "chosen on these flights" in tables(result)
    assert any("flight_3, held out" in line for line in result.warnings)
    written = result.fits[frozenset()].residual
    zeroed = np.asarray(jax.tree.leaves(written.thrust[-1])[0])
    assert (result.gains[0] > 0.0) == bool(np.abs(zeroed).max() > 0.0)
