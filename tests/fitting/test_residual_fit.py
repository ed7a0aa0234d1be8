import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.config import PrepareConfig, ResidualConfig, SplitConfig
from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.nominal import AXES, ModelInputs, nominal, regressors, residual_output
from quadjax.fitting.prediction import predict
from quadjax.fitting.prepare import Samples, join
from quadjax.fitting.residual_fit import ALL, fit_residuals, zero_residual
from quadjax.fitting.selection import FoldMoments, select
from quadjax.fitting.simulate import random_residual
from quadjax.fitting.split import NOWHERE, TEST, make_split
from quadjax.fitting.tasks import NETWORKS, mirrored
from quadjax.vehicle.residual import read_residual, residual_force_moment, write_residual

FAST = ResidualConfig(seeds=2, epochs=12, distill_epochs=40, batch=256)


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
        columns = regressors(motion)
        nothing = {axis: np.zeros_like(c) for axis, c in columns.items()}
        parts.append(
            Samples(motion, columns, nothing, truth, np.full(len(time), flight), time, rate)
        )
    return join(parts)


@pytest.fixture(scope="module")
def recovered(bebop):
    truth = random_residual(4, 0.8, (0.01, 0.01, 0.004))
    samples = _samples(bebop, truth, noise=0.1)
    split = make_split(samples, ["a", "b", "c"], SplitConfig())
    config = FAST.replace(epochs=40, mirror="off")
    return truth, samples, split, fit_residuals(samples, split, bebop, config, 0, True)


@pytest.mark.slow
def test_a_known_residual_is_recovered_on_held_out_flights(bebop, recovered):
    truth, samples, split, fits = recovered
    for number in range(3):
        rows = split.fold == number
        fit = fits[frozenset({number})]
        motion = samples.motion[rows]
        expected = residual_output(truth, motion)
        got = residual_output(fit.residual, motion)
        # The nominal fit takes its share of the residual: the sum is what must come back.
        got = got + (nominal(fit.constants, motion) - nominal(bebop, motion))[:, 2:]
        found = r_squared(expected, got)
        print("held-out R^2 of the residual", found)
        assert (found > 0.95).all()


@pytest.mark.slow
def test_the_file_is_what_was_fitted(tmp_path, bebop, recovered):
    _, samples, _, fits = recovered
    residual = fits[ALL].residual
    assert residual.thrust[0][0].shape == (7, 32) and residual.moment[1][0].shape == (32, 3)
    write_residual(tmp_path / "residual.npz", residual, {})
    read = read_residual(tmp_path / "residual.npz")
    motion = samples.motion[:50]
    expected = residual_output(residual, motion)
    force, moment = jax.vmap(residual_force_moment, in_axes=(None, 0, 0, 0))(
        read,
        Rotors.of(motion.rpm.astype(np.float32)),
        Vec3.of(motion.body_velocity.astype(np.float32)),
        Vec3.of(motion.rates.astype(np.float32)),
    )
    np.testing.assert_allclose(force, expected[:, 0], atol=1e-3)
    np.testing.assert_allclose(moment.array(), expected[:, 1:], atol=1e-5)


@pytest.mark.slow
def test_noise_is_rejected_and_so_is_what_nothing_validates(bebop):
    samples = _samples(bebop, zero_residual(bebop), noise=1.0, flights=2, seconds=20.0)
    split = make_split(samples, ["a", "b"], SplitConfig())
    fits = fit_residuals(samples, split, bebop, FAST, 0, True)
    fit = fits[ALL]
    for axis, choice in fit.choices.items():
        assert choice.rejected and choice.scale == 0.0, axis
    assert not residual_output(fit.residual, samples.motion).any()
    assert np.abs(predict("", samples, split.fold >= 0, fit).change).max() < 1e-9
    # Without one of two flights there is none left to choose on.
    for left_out in (frozenset({0}), frozenset({1})):
        assert all("no second" in c.rejected for c in fits[left_out].choices.values())


def _score(cross, square, spread=0.0):
    """One epoch, one axis, two seeds about the same moments."""
    seeds = np.array([cross - spread, cross + spread])[:, None, None]
    return FoldMoments(np.array([[cross]]), np.array([[square]]), seeds, np.full((2, 1, 1), square))


def test_selection_shrinks_for_the_flight_that_gets_worse():
    helped, harmed = _score(0.5, 0.5), _score(0.05, 0.3)
    bold = select(("az",), {False: [helped, harmed]}, ResidualConfig(caution=0.0))[0]
    wary = select(("az",), {False: [helped, harmed]}, ResidualConfig(caution=3.0))[0]
    assert 0.0 < wary.scale < bold.scale
    assert min(wary.gains) > min(bold.gains)


def test_small_and_insignificant_gains_are_rejected():
    small = select(("az",), {False: [_score(0.05, 0.1)] * 2}, ResidualConfig(min_gain=0.05))[0]
    assert small.scale == 0.0 and "min_gain" in small.rejected
    insignificant = select(("az",), {False: [_score(0.2, 0.2, spread=0.3)] * 2}, ResidualConfig())[
        0
    ]
    assert insignificant.scale == 0.0 and "seeds" in insignificant.rejected
    useless = select(("az",), {False: [_score(-0.2, 0.2)] * 2}, ResidualConfig())[0]
    assert useless.scale == 0.0 and "no better" in useless.rejected


def test_a_candidate_that_is_rejected_does_not_displace_an_accepted_one():
    """The mirrored one has the lower error, but its seeds disagree by more than its gain."""
    noisy, sound = [_score(0.3, 0.3, spread=0.4)] * 2, [_score(0.2, 0.2)] * 2
    chosen = select(("az",), {True: noisy, False: sound}, ResidualConfig())[0]
    assert chosen.rejected is None and chosen.scale > 0.0 and not chosen.mirror


def test_one_seed_has_no_spread():
    moments = np.array([[0.2]])
    one = FoldMoments(moments, moments, moments[None], moments[None])
    chosen = select(("az",), {False: [one, one]}, ResidualConfig(seeds=1))[0]
    assert np.isnan(chosen.seed_spread) and chosen.rejected is None


def test_mirror_image_is_one_of_the_nominal_model(bebop):
    """The model is left-right symmetric, so it must agree with its own mirror image."""
    random = np.random.default_rng(0)
    rpm, rpm_rate = random.uniform(4000, 9000, (20, 4)), random.normal(size=(20, 4))
    velocity, rates = random.normal(size=(20, 3)), random.normal(size=(20, 3))
    network = NETWORKS["moment"]
    image = mirrored(network, np.concatenate([rpm, velocity, rates], axis=1))
    swapped = ModelInputs(image[:, :4], rpm_rate[:, [1, 0, 3, 2]], image[:, 4:7], image[:, 7:])
    moment = nominal(bebop, ModelInputs(rpm, rpm_rate, velocity, rates))
    sign = np.array([1.0, -1.0, 1.0, *network.mirror_output])
    np.testing.assert_allclose(nominal(bebop, swapped), moment * sign, atol=1e-12)
    assert [AXES[i] for i in network.columns] == ["Mx", "My", "Mz"]


def test_split_by_flight_and_by_time(bebop):
    samples = _samples(bebop, zero_residual(bebop), noise=0.1, seconds=20.0)
    flights = ["a", "b", "c"]
    split = make_split(samples, flights, SplitConfig(test_flights=["b"]))
    assert split.by == "flight" and split.names == ("a", "c")
    assert (split.fold[samples.flight == 1] == TEST).all()
    split = make_split(samples, flights, SplitConfig(by="time", test_fraction=0.25))
    for flight in range(3):
        fold = split.fold[samples.flight == flight]
        assert abs((fold == TEST).mean() - 0.25) < 0.01
        order = fold[(fold != NOWHERE) & (fold != TEST)]
        assert (np.diff(order) >= 0).all() and set(order) == {0, 1, 2, 3}
    one = samples[samples.flight == 0]
    assert make_split(one, ["a"], SplitConfig()).by == "time"
    for config in (
        SplitConfig(test_flights=["d"]),
        SplitConfig(test_flights=flights),
        SplitConfig(by="flight", test_flights=["a", "b"]),
    ):
        with pytest.raises(InputError):
            make_split(samples, flights, config)


def test_prepare_config_has_the_published_filter():
    assert PrepareConfig().cutoff == 16.0
