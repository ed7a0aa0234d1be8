import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.axes import Prediction, fit_axes, with_estimates
from quadjax.fitting.config import ResidualConfig, SplitConfig
from quadjax.fitting.nominal import AXES, ModelInputs, nominal, regressors, residual_output
from quadjax.fitting.regression import r_squared
from quadjax.fitting.residual import fit_residuals, select, zero_residual
from quadjax.fitting.residual_training import MIRROR_OUTPUT, NETWORKS, mirrored
from quadjax.fitting.samples import ALL, NOWHERE, TEST, Samples, make_split
from quadjax.fitting.signals import concatenated

from .flights import random_residual

FAST = ResidualConfig(seeds=2, epochs=12)


def _split(samples, flights, **config):
    times = [samples.time[samples.flight == i] for i in np.unique(samples.flight)]
    return make_split(times, flights, SplitConfig(**config))


def _fitted(samples, split, base, config):
    """The constants and the residual of each complete fit."""

    def constants(left_out):
        return with_estimates(base, fit_axes(samples[split.learned(left_out)], base))

    fits = fit_residuals(samples, split, base, constants, config, 0)
    return {left_out: (constants(left_out), fit) for left_out, fit in fits.items()}


def _samples(constants, residual, noise, flights=3, seconds=40.0, seed=0):
    """Flights as smooth random motions; what is measured is the model's, plus noise."""
    random = np.random.default_rng(seed)
    rate, parts = 50.0, []
    time = np.arange(int(seconds * rate)) / rate
    for flight in range(flights):
        waves = [
            np.sin(
                2 * np.pi * random.uniform(0.1, 1.5, 10) * time[:, None] + random.uniform(0, 6, 10)
            )
            * random.uniform(0.3, 1.0, 10)
            for _ in range(3)
        ]
        wave = sum(waves)
        motion = ModelInputs(
            7000.0 + 1200.0 * wave[:, :4],
            np.gradient(1200.0 * wave[:, :4], 1 / rate, axis=0),
            2.0 * wave[:, 4:7],
            1.5 * wave[:, 7:10],
        )
        truth = nominal(constants, motion)
        truth[:, 2:] += residual_output(residual, motion)
        truth += noise * random.normal(size=truth.shape) * [0.3, 0.3, 0.3, 5e-3, 5e-3, 2e-3]
        columns = regressors(motion, constants)
        nothing = {axis: np.zeros_like(c) for axis, c in columns.items()}
        parts.append(
            Samples(motion, columns, nothing, truth, np.full(len(time), flight), time, rate)
        )
    return concatenated(parts)


@pytest.fixture(scope="module")
def recovered(bebop):
    truth = random_residual(4, 0.8, (0.01, 0.01, 0.004))
    samples = _samples(bebop, truth, noise=0.1)
    split = _split(samples, ["a", "b", "c"])
    config = FAST.replace(epochs=20, mirror="off")
    return truth, samples, split, _fitted(samples, split, bebop, config)


@pytest.mark.slow
def test_a_known_residual_is_recovered_on_held_out_flights(bebop, recovered):
    truth, samples, split, fits = recovered
    for number in range(3):
        rows = split.fold == number
        constants, fit = fits[frozenset({number})]
        motion = samples.motion[rows]
        expected = residual_output(truth, motion)
        got = residual_output(fit.residual, motion)
        # The nominal fit takes its share of the residual: the sum is what must come back.
        got = got + (nominal(constants, motion) - nominal(bebop, motion))[:, 2:]
        found = r_squared(expected, got)
        print("held-out R^2 of the residual", found)
        assert (found > 0.95).all()


@pytest.mark.slow
def test_noise_is_rejected_and_so_is_what_nothing_validates(bebop):
    samples = _samples(bebop, zero_residual(bebop).residual, noise=1.0, flights=2, seconds=20.0)
    split = _split(samples, ["a", "b"])
    fits = _fitted(samples, split, bebop, FAST)
    constants, fit = fits[ALL]
    for axis, choice in fit.choices.items():
        assert choice.rejected and choice.scale == 0.0, axis
    assert not residual_output(fit.residual, samples.motion).any()
    assert (
        np.abs(Prediction.of("", samples, split.fold >= 0, constants, fit.residual).change).max()
        < 1e-9
    )
    # Without one of two flights there is none left to choose on.
    for left_out in (frozenset({0}), frozenset({1})):
        assert all("no second" in c.rejected for c in fits[left_out][1].choices.values())


def _scores(*folds, spread=0.0):
    """Of one epoch and axis, with two seeds about the same moments (cross, square) of each fold."""
    members = [[(c, q), (c - spread, q), (c + spread, q)] for c, q in folds]
    return np.array(members)[:, None, :, None, :]


HELPED, HARMED = (0.5, 0.5), (0.05, 0.3)


def test_no_fold_is_harmed_by_more_than_the_limit():
    """The mean over the folds alone would choose the largest scale."""
    folds = [(0.9, 0.9)] * 9 + [(-0.2, 0.3)]
    free, limited = (select(("az",), {False: _scores(*folds)}, harm)[0] for harm in (1.0, 0.1))
    assert min(free.gains) < -0.1 <= min(limited.gains)
    assert 0.0 < limited.scale < free.scale


def test_small_and_insignificant_gains_are_rejected():
    small = select(("az",), {False: _scores((0.005, 0.005), (0.005, 0.005))}, 0.1)[0]
    assert small.scale == 0.0 and "below 1%" in small.rejected
    unsure = select(("az",), {False: _scores((0.2, 0.2), (0.2, 0.2), spread=0.3)}, 0.1)[0]
    assert unsure.scale == 0.0 and "seeds" in unsure.rejected
    useless = select(("az",), {False: _scores((-0.2, 0.2), (-0.2, 0.2))}, 0.1)[0]
    assert useless.scale == 0.0 and "no better" in useless.rejected


def test_a_candidate_that_is_rejected_does_not_displace_an_accepted_one():
    """The mirrored one has the lower error, but its seeds disagree by more than its gain."""
    noisy = _scores((0.3, 0.3), (0.3, 0.3), spread=0.4)
    chosen = select(("az",), {True: noisy, False: _scores((0.2, 0.2), (0.2, 0.2))}, 0.1)[0]
    assert chosen.rejected is None and chosen.scale > 0.0 and not chosen.mirror


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


def test_split_by_flight_and_by_time(bebop):
    samples = _samples(bebop, zero_residual(bebop).residual, noise=0.1, seconds=20.0)
    flights = ["a", "b", "c"]
    split = _split(samples, flights, test_flights=["b"])
    assert split.by == "flight" and split.names == ("a", "c")
    assert (split.fold[samples.flight == 1] == TEST).all()
    split = _split(samples, flights, by="time", test_fraction=0.25)
    for flight in range(3):
        fold = split.fold[samples.flight == flight]
        assert abs((fold == TEST).mean() - 0.25) < 0.01
        order = fold[(fold != NOWHERE) & (fold != TEST)]
        assert (np.diff(order) >= 0).all() and set(order) == {0, 1, 2, 3}
    one = samples[samples.flight == 0]
    assert _split(one, ["a"]).by == "time"
    for config in (
        {"test_flights": ["d"]},
        {"test_flights": flights},
        {"by": "flight", "test_flights": ["a", "b"]},
    ):
        with pytest.raises(InputError):
            _split(samples, flights, **config)
