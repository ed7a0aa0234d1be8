"""Fits of simulated rows, what is selected on held-out folds, the folds, and mirror images."""

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.axes import fit_axes, with_estimates
from quadjax.fitting.config import ResidualConfig, SplitConfig
from quadjax.fitting.nominal import AXES, ModelInputs, nominal, regressors, residual_output
from quadjax.fitting.regression import r_squared
from quadjax.fitting.residual import ResidualFits, select
from quadjax.fitting.residual_training import MIRROR_OUTPUT, NETWORKS, mirrored
from quadjax.fitting.samples import GUARD_ROW, TEST_ROW, Samples, make_split

from .flights import random_residual

RATE = 50.0  # Hz
NOISE = np.array([0.3, 0.3, 0.3, 5e-3, 5e-3, 2e-3])  # m/s^2 and N m


def fitted(base, truth, noise, flights, seconds, **config):
    """Fits of smooth random motions, and of each of them the constants; measured with noise."""
    random, count = np.random.default_rng(0), round(seconds * RATE)
    time = np.arange(count)[:, None] / RATE
    waves = np.zeros((flights, count, 10))
    for flight in np.repeat(np.arange(flights), 3):
        turns, phase, size = random.uniform([[0.1], [0.0], [0.3]], [[1.5], [1.0], [1.0]], (3, 10))
        waves[flight] += size * np.sin(2.0 * np.pi * (turns * time + phase))
    change = np.gradient(waves[..., :4], 1.0 / RATE, axis=1)
    parts = (7000.0 + 1200.0 * waves[..., :4], 1200.0 * change, 2.0 * waves[..., 4:7])
    parts = (*parts, 1.5 * waves[..., 7:])
    motion = ModelInputs(*(part.reshape(flights * count, -1) for part in parts))
    measured = nominal(base, motion) + noise * NOISE * random.normal(size=(flights * count, 6))
    measured[:, 2:] += residual_output(truth, motion)
    columns = regressors(motion, base)
    exact = {axis: np.zeros_like(values) for axis, values in columns.items()}
    number, time = np.repeat(np.arange(flights), count), np.tile(time[:, 0], flights)
    samples = Samples(motion, columns, exact, measured, number, time, RATE)
    split = make_split(np.split(time, flights), list("abc"[:flights]), SplitConfig())

    def constants(folds):
        return with_estimates(base, fit_axes(samples[split.rows(folds)], base))

    fit = ResidualFits(samples, split, base, constants, ResidualConfig(**config), 0)
    fits = [split.all, *(split.all - {fold} for fold in split.all)]
    return motion, split, {folds: (constants(folds), fit(folds)) for folds in fits}


def explained(base, truth, motion, constants, residual):
    """R^2 of each output; the nominal fit has a share of the residual: the sum must be right."""
    share = nominal(constants, motion) - nominal(base, motion)
    found = share[:, 2:] + residual_output(residual, motion)
    return r_squared(residual_output(truth, motion), found)


@pytest.mark.slow
def test_a_known_residual_is_recovered_on_held_out_flights(bebop):
    truth = random_residual(4, 0.8, (0.01, 0.01, 0.004))
    training = {"epochs": 30, "batch_size": 64, "mirror": False, "weight_decay": 1e-4}
    motion, split, fits = fitted(bebop, truth, 0.1, 3, 40.0, input_noise=0.0, **training)
    for number in range(3):
        rows = motion[split.fold == number]
        constants, fit = fits[split.all - {number}]
        assert (explained(bebop, truth, rows, constants, fit.residual) > 0.95).all()


PUBLISHED = {  # training of Ferede et al., arXiv 2311.16948 and 2410.21609
    **{"learning_rate": 1e-3, "batch_size": 64, "epochs": 20, "weight_decay": 0.0},
    **{"input_noise": 0.0, "mirror": False, "select": False},
}


@pytest.mark.slow
def test_the_published_training_chooses_nothing(bebop):
    truth = random_residual(4, 0.8, (0.01, 0.01, 0.004))
    motion, _, fits = fitted(bebop, truth, 0.1, 2, 40.0, **PUBLISHED)
    for constants, fit in fits.values():  # one of them without a flight to choose on
        assert all((x.epochs, x.scale, x.rejected) == (20, 1.0, None) for x in fit.choices.values())
        assert (explained(bebop, truth, motion, constants, fit.residual) > 0.5).all()


@pytest.mark.slow
def test_noise_is_rejected_and_so_is_what_nothing_validates(bebop):
    motion, split, fits = fitted(bebop, random_residual(0, 0.0, 0.0), 1.0, 2, 8.0, epochs=40)
    for folds, (_, fit) in fits.items():
        assert len(fit.choices) == 4 and not residual_output(fit.residual, motion).any()
        # Without one of two flights there is none left to choose on.
        reason = "below 1%" if folds == split.all else "no second"
        assert all(x.rejected and reason in x.rejected for x in fit.choices.values())
        assert all(choice.scale == 0.0 for choice in fit.choices.values())


def chosen(*epochs, **config):
    """The choice of one axis by the moments (cross, square) of folds, after each epoch."""
    scores = np.array([[[moments] for moments in fold] for fold in zip(*epochs, strict=True)])
    (choice,) = select(scores, ResidualConfig(**config))
    return choice


def test_no_fold_is_harmed_by_more_than_the_limit():
    """The mean over the folds alone would choose the largest scale."""
    folds = [(0.9, 0.9)] * 9 + [(-0.2, 0.3)]
    free, limited = (chosen(folds, max_harm=harm) for harm in (1.0, 0.1))
    assert min(free.gains) < -0.1 <= min(limited.gains)
    assert 0.0 < limited.scale < free.scale


def test_training_stops_where_the_folds_are_predicted_best():
    good, bad = [(0.5, 0.5)] * 2, [(0.1, 0.5)] * 2
    curve = [bad] * 10 + [good] * 10 + [bad] * 10
    assert 10 < chosen(*curve).epochs <= 20
    last = chosen(*curve, select=False)
    assert (last.epochs, last.scale) == (30, 1.0) and last.gain < 0.0


@pytest.mark.parametrize("moments", [(0.005, 0.005), (-0.2, 0.2)])
def test_small_gains_are_rejected(moments):
    choice = chosen([moments, moments])
    assert choice.scale == 0.0 and "below 1%" in choice.rejected


def test_mirror_image_is_one_of_the_nominal_model(bebop):
    """The model is left-right symmetric, so it must agree with its own mirror image."""
    random = np.random.default_rng(0)
    rpm, rpm_rate = random.uniform(4000, 9000, (20, 4)), random.normal(size=(20, 4))
    velocity, rates = random.normal(size=(20, 3)), random.normal(size=(20, 3))
    network = NETWORKS[1]
    image = mirrored(np.concatenate([rpm, velocity, rates], axis=1))
    swapped = ModelInputs(image[:, :4], rpm_rate[:, [1, 0, 3, 2]], image[:, 4:7], image[:, 7:])
    moment = nominal(bebop, ModelInputs(rpm, rpm_rate, velocity, rates))
    sign = np.array([1.0, -1.0, 1.0, *(MIRROR_OUTPUT[axis] for axis in network.axes)])
    np.testing.assert_allclose(nominal(bebop, swapped), moment * sign, atol=1e-12)
    assert [AXES[i] for i in network.columns] == ["Mx", "My", "Mz"]


def test_split_by_flight_and_by_time():
    time, flights = np.arange(1000) / 50.0, ["a", "b", "c"]

    def split(names=flights, **config):
        return make_split([time] * len(names), names, SplitConfig(**config))

    by_flight = split(test_flights=["b"])
    assert by_flight.by == "flight" and by_flight.names == ("a", "c")
    assert (by_flight.fold[1000:2000] == TEST_ROW).all()
    for fold in split(by="time", test_fraction=0.25).fold.reshape(3, 1000):
        assert abs((fold == TEST_ROW).mean() - 0.25) < 0.01
        order = fold[(fold != GUARD_ROW) & (fold != TEST_ROW)]
        assert (np.diff(order) >= 0).all() and set(order) == {0, 1, 2, 3}
        assert (fold == GUARD_ROW).sum() == 5  # 0.1 s before the test rows
    assert split(["a"]).by == "time"
    for config in (
        {"test_flights": ["d"]},
        {"test_flights": flights},
        {"by": "flight", "test_flights": ["a", "b"]},
    ):
        with pytest.raises(InputError, match="split"):
            split(**config)
