"""Policies that sample their actions on board: the noise, its bits in C, and its statistics."""

import dataclasses
import json

import numpy as np
import pytest
from scipy import stats

from quadjax.core.errors import InputError
from quadjax.export.convert import export_c
from quadjax.export.emulator import forward_traced
from quadjax.export.integers import quantize
from quadjax.export.noise import advanced, make_noise, noise, sample
from quadjax.export.read import read_qjp, unpack
from quadjax.export.verify import run
from quadjax.export.verify.result import PASSED
from quadjax.export.words import SAMPLED_VERSION, STRUCTS, VERSION, pack
from tests.export.support import fixed, library, made, observations
from tests.export.words import edited, load, runtime_of

UNIT = 2**16
STD = np.array([0.3, 0.5, 0.05, 1.0])
SAMPLED = "-DQJ_SAMPLED=1"


def sampling(name="e2e", noise_on="mean"):
    """A policy, and the same as integers with its noise."""
    changes = {"log_std": np.log(STD).astype(np.float32), "noise_on": noise_on}
    policy = dataclasses.replace(made(name, (16,))[0], **changes)
    mean = fixed(name, (16,))
    return policy, dataclasses.replace(mean, noise=make_noise(policy, mean.network))


def by_hand(counter, count):
    """Numbers of the generator in Python's own integers, and its counter after them."""
    numbers = []
    for _ in range(count):
        total = 0
        for _ in range(6):
            counter = (counter + 0x9E3779B9) % 2**32
            x = counter
            for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
                x = (x ^ x >> shift) * factor % 2**32
            x ^= x >> 16
            total += x % 2**16 + x // 2**16
        numbers.append(total - 12 * (2**16 - 1) // 2)
    return numbers, counter


def test_the_generator_is_the_one_by_hand():
    numbers, counter = by_hand(2**32 - 7, 40)
    assert noise((UNIT,) * 4, 2**32 - 7, 10).ravel().tolist() == numbers
    assert advanced(2**32 - 7, 10, 4) == counter
    found = noise((2 * UNIT, UNIT, 0, 1), 2**32 - 7, 10)
    assert found[:, 0].tolist() == [2 * x for x in numbers[::4]] and not found[:, 2].any()
    assert found[:, 3].tolist() == [(x + 2**15) >> 16 for x in numbers[3::4]]


def test_the_noise_is_normal_and_white():
    steps = 60_000
    x = noise((UNIT,) * 4, 12345, steps) / UNIT
    assert np.abs(x.mean(axis=0)).max() < 5 / steps**0.5
    assert np.abs(x.std(axis=0) - 1.0).max() < 5 / (2 * steps) ** 0.5
    assert np.abs(stats.kurtosis(x) + 0.1).max() < 0.08
    assert np.abs(stats.skew(x)).max() < 0.05 and np.abs(x).max() < 6.0
    assert stats.kstest(x.ravel(), "norm").statistic < 0.005  # 0.0023, and that of a sample
    apart = np.corrcoef(np.concatenate([x[1:], x[:-1]], axis=1).T) - np.eye(8)
    assert np.abs(apart).max() < 5 / steps**0.5


@pytest.mark.parametrize("noise_on", ["mean", "clipped_mean"])
@pytest.mark.parametrize("name", ["e2e", "indi"])
def test_commands_are_distributed_as_those_of_the_float_policy(name, noise_on):
    policy, integers = sampling(name, noise_on)
    network, rng, count = integers.network, np.random.default_rng(0), 20_000
    low, high = policy.command_low, policy.command_high
    half, ends = 0.5 * (high - low), 0
    for number, size in enumerate((0.02, 0.1, 0.3, 0.9)):
        x = (rng.uniform(-size, size, network.inputs) * network.box.ranges).astype(np.float32)
        y = x.astype(float)
        for layer, (kernel, bias) in enumerate(policy.layers):
            y = (np.maximum(y, 0.0) if layer else y) @ kernel + bias
        y = np.clip(y, -1.0, 1.0) if noise_on == "clipped_mean" else y
        y = np.clip(y + STD * rng.standard_normal((count, 4)), -1.0, 1.0)
        q = quantize(np.tile(x, (count, 1)), network.box.exponents)
        found = sample(network, integers.noise, q, 1000 * number) / 2.0**network.fraction_bits
        found = (found - low) / half - 1.0
        assert np.abs(found).max() <= 1.0 + 1e-6
        assert np.abs(found.mean(axis=0) - y.mean(axis=0)).max() < 0.03
        assert np.abs(found.std(axis=0) - y.std(axis=0)).max() < 0.02
        for i in range(4):
            assert stats.ks_2samp(found[:, i].round(6), y[:, i].round(6)).statistic < 0.025
        ends += np.sum((np.abs(y) == 1.0).mean(axis=0) % 1.0 > 0.05)
    assert ends > 2  # in some cases the clipping matters


@pytest.mark.parametrize("case", [("e2e", "mean"), ("indi", "clipped_mean")])
def test_the_c_has_the_bits_of_numpy(case, tmp_path):
    _, policy = sampling(*case)
    network, counter = policy.network, 2**32 - 1000
    q = quantize(observations(network, 2000), network.box.exponents).astype(np.int32)
    bits = np.random.default_rng(0).integers(-(2**31), 2**31, (500, network.inputs), np.int32)
    q, c = np.concatenate([q, bits]), library(policy, tmp_path)
    np.testing.assert_array_equal(c.sample(q, counter), sample(network, policy.noise, q, counter))
    mean = forward_traced(network, q)[0]
    np.testing.assert_array_equal(c.forward(q)[:, :4], mean)
    silent = dataclasses.replace(policy.noise, factors=(0,) * 4)
    np.testing.assert_array_equal(sample(network, silent, q, 5), mean)


def test_the_loader_checks_the_noise(tmp_path):
    _, policy = sampling()
    words, mean = pack(policy), pack(dataclasses.replace(policy, noise=None))
    assert len(words) == len(mean) + STRUCTS["noise"].itemsize
    assert unpack(words).noise == policy.noise
    assert np.frombuffer(mean, "<i4")[1] == VERSION != SAMPLED_VERSION == policy.version
    right, plain = runtime_of(tmp_path / "right", None, SAMPLED), runtime_of(tmp_path / "plain")
    assert load(right, words) == load(right, mean) == load(plain, mean) == 0
    assert load(plain, words) == 3  # of another version: it could not sample
    at = words.index(np.array(policy.noise.factors, "<i4").tobytes()) // 4
    for change, error in (({at: -1}, 11), ({at + 1: 5}, 13), ({at + 4: 5}, 11), ({at + 5: 5}, 13)):
        assert load(right, edited(words, change)) == error
        with pytest.raises(InputError):
            unpack(edited(words, change))


CHANGES = {  # in qj_network.c
    "0x9E3779B9": "0x9E3779BB",
    "0x846CA68B": "0x846CA68D",
    "x >> 15": "x >> 14",
    "i < 6U; ++i": "i < 5U; ++i",
    "qj_round_shift((int64_t)sum * factor, 16)": "((int64_t)sum * factor >> 16)",
    "QJ_NOISE_FACTOR + i % QJ_COMMANDS": "QJ_NOISE_FACTOR",
}


@pytest.mark.slow
def test_the_self_test_sees_a_change_of_the_noise(tmp_path):
    words = pack(sampling()[1])
    for number, (old, new) in enumerate(CHANGES.items()):
        changed = runtime_of(tmp_path / str(number), ("qj_network.c", old, new), SAMPLED)
        assert load(changed, words) == 13, old


def test_an_export_samples_only_if_asked(no_flights, tmp_path):
    made("indi")[0].save(tmp_path / "policy.npz")
    files = {}
    for sampled in (False, True):
        out = tmp_path / f"{sampled}"
        options = {"allow_unfinished": True, "sampled": sampled}
        result = export_c(tmp_path / "policy.npz", out, name="made", **options)
        files[sampled] = result.converted.files()
        assert (read_qjp(out / "made.qjp").noise is not None) == sampled
        assert json.loads((out / "made_report.json").read_text())["deterministic"] is not sampled
        assert ("Sampled: noise of standard deviation" in result.text) == sampled
        assert (b"QJ_SAMPLED" in files[sampled]["paparazzi/qj_sizes.h"]) == sampled
        assert (b"; sampled actions" in files[sampled]["paparazzi/made.h"]) == sampled
        results = run.verify(out, 400, only=("NumPy = C",))
        assert [x.verdict for x in results] == [PASSED] * 2
    apart = {name for name in files[True] if files[True][name] != files[False][name]}
    assert apart == {"paparazzi/qj_sizes.h", "paparazzi/made.h", "made.qjp"}
