"""Actions that are sampled on board, with the noise of the training."""

import dataclasses

import numpy as np
import pytest

from quadjax.export import emulator
from quadjax.export.library import VEHICLE
from tests.export.support import convert, converted, library, made

COUNT = 20_000


def sampling(folder, name="indi", noise_on="mean", log_std=-1.0):
    policy, own = made(name)
    policy = dataclasses.replace(policy, log_std=np.full(4, log_std, np.float32), noise_on=noise_on)
    return convert(policy, own, folder, sampled=True)


def test_the_noise_is_normal_and_repeats_with_its_counter(tmp_path):
    of = sampling(tmp_path, log_std=-3.0)
    network, c = of.in_c.network, library(of, tmp_path / "c")
    q = np.repeat(np.zeros((1, network.inputs), np.int32), COUNT, axis=0)
    mean = emulator.forward_rows(network, q[:1])[0, :4] / 2.0**network.fraction_bits
    found = c.act(q, counter=7)
    np.testing.assert_array_equal(found, c.act(q, counter=7))
    assert not np.array_equal(found, c.act(q, counter=8))
    drawn = (found - mean) / of.in_c.noise
    assert np.abs(drawn.mean(axis=0)).max() < 4.0 / np.sqrt(COUNT)
    assert np.abs(drawn.std(axis=0) - 1.0).max() < 0.02
    assert np.abs((drawn**4).mean(axis=0) - 3.0).max() < 0.3
    assert np.abs(np.corrcoef(drawn.T) - np.eye(4)).max() < 0.03
    assert np.abs(np.corrcoef(drawn[1:, 0], drawn[:-1, 0])[0, 1]) < 0.03
    assert drawn.max() > 3.5 and np.isfinite(drawn).all()


@pytest.mark.parametrize("noise_on", ["mean", "clipped_mean"])
def test_a_mean_beyond_the_limits_is_clipped_where_training_did(noise_on, tmp_path):
    of = sampling(tmp_path, "e2e", noise_on, -2.0)
    network, c = of.in_c.network, library(of, tmp_path / "c")
    rng = np.random.default_rng(0)
    q = rng.integers(-(2**30), 2**30, (400, network.inputs)).astype(np.int32)
    sums = emulator.forward_traced(network, q)[1][-1]
    mean = sums / 2.0 ** (network.output_shift + network.fraction_bits)
    far = mean > 11_000.0 + 6.0 * of.in_c.noise[0]
    assert far.sum() > 50
    found = c.act(q, counter=1)
    below = (found[far] < 11_000.0).mean()
    assert below == 0.0 if noise_on == "mean" else 0.4 < below < 0.6
    assert found.min() >= 3000.0 and found.max() <= 11_000.0
    np.testing.assert_array_equal(found, np.rint(found))  # whole rpm


def test_the_mean_flies_unless_samples_are_asked_for(tmp_path):
    of = converted("indi", tmp_path)
    assert of.in_c.noise is None and "deterministic" in of.files["c/made.h"].decode()
    policy, own = made("indi")
    sampled = convert(policy, own, tmp_path / "s", sampled=True)
    assert "sampled actions" in sampled.files["c/made.h"].decode()
    pilots = [library(x, tmp_path / str(i)).pilot(100.0) for i, x in enumerate((of, sampled))]
    vehicle, commands = np.zeros((), VEHICLE), []
    for now in (0, 10_000):
        vehicle["time_us"] = vehicle["position_us"] = now
        commands.append([pilot.call(now, vehicle)[1] for pilot in pilots])
    np.testing.assert_array_equal(commands[0][0], commands[1][0])
    assert not np.array_equal(commands[0][1], commands[1][1])
