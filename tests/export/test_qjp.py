"""A policy as a file: the same bits in Python and C, and whatever was changed is rejected."""

import ctypes
import dataclasses
import hashlib
import re

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.export.fixed import convert
from quadjax.export.qjp.policy import HASH_BYTES, make_qjp, qjp_bytes
from quadjax.export.qjp.read import parse_qjp, read_qjp
from quadjax.export.race_tables import make_tables, track_ranges
from quadjax.export.verify import checks_qjp
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.loader import QjpContext
from quadjax.export.verify.toolchain import host
from tests.commands import run
from tests.export.support import random_states
from tests.export.test_layouts import made

HEADER = 50  # words


def file_of(name, round_gates=False):
    """The file of an untrained policy."""
    policy, own = made(name)
    network = convert(policy, track_ranges(policy.layout, own.params.track) | {"position": 32.0})
    race = make_tables(network.box, policy, own.choices, own.params)
    if round_gates:
        race = dataclasses.replace(race, circle=np.arange(race.gates) % 2 == 0)
    rng = np.random.default_rng(0)
    states = random_states(rng, 20, own, policy.command_low, policy.command_high)
    targets = rng.integers(0, race.gates, 20)
    parts = (network, race, "ab" * 32, own.time_step, None, states, targets)
    return qjp_bytes(make_qjp("made", *parts))


@pytest.fixture(scope="module")
def data():
    return file_of("published racing")


@pytest.fixture(scope="module")
def context(data, tmp_path_factory):
    return QjpContext.make(data, tmp_path_factory.mktemp("qjp"), 1000, 1000, ("Cortex-M4",))


@pytest.fixture(scope="module")
def library(context):
    return context.library.library


def edited(data, changes):
    """The file with other words, and the hash of what it then is."""
    words = np.frombuffer(data, "<i4").copy()
    for at, value in changes.items():
        words[at] = value
    body = words.tobytes()[:-HASH_BYTES]
    return body + hashlib.sha256(body).digest()


def load(library, data):
    words = np.frombuffer(data, np.int32).copy()
    return library.harness_load(words.ctypes.data_as(ctypes.c_void_p), len(data))


@pytest.mark.parametrize(
    "name",
    [
        "racing, axes and more",
        *(
            pytest.param(x, marks=pytest.mark.slow)
            for x in ("e2e with quaternions", "indi and more")
        ),
    ],
)
def test_the_loader_gives_the_bits_of_the_emulator(name, tmp_path):
    data = file_of(name, round_gates=name.startswith("racing"))
    read = parse_qjp(data)
    assert qjp_bytes(read) == data and read.name == "made" and read.policy_hash == "ab" * 32
    context = QjpContext.make(data, tmp_path, 1000, 1000, ())
    figure = checks_qjp.check_host(context)
    passed, missed = (int(x) for x in re.findall(r"(\d+) (?:gates passed|missed)", figure))
    assert "inputs and 1000 states the same" in figure and min(passed, missed) > 20


def test_sha256_is_that_of_hashlib(library):
    rng, digest = np.random.default_rng(0), np.zeros(32, np.uint8)
    for size in (*range(0, 200), 1000, 4096, 65537):
        data = rng.integers(0, 256, size, dtype=np.uint8)
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (data, digest)]
        library.qjp_sha256(pointers[0], size, pointers[1])
        assert digest.tobytes() == hashlib.sha256(data.tobytes()).digest(), size


def test_every_flipped_bit_is_refused(data, library):
    rng = np.random.default_rng(1)
    for _ in range(300):
        changed = bytearray(data)
        changed[rng.integers(len(data))] ^= 1 << rng.integers(8)
        assert load(library, bytes(changed)) != 0
        with pytest.raises(InputError):
            parse_qjp(bytes(changed))
    for size in (0, 4, 200, len(data) - 4, len(data) - 1):
        assert load(library, data[: size // 4 * 4] or bytes(4)) == 1


def at_of(data, part):
    """The first word of a part of the file."""
    words = np.frombuffer(data, "<i4")
    inputs, layers, state, fields, parts, gates, constants = words[[3, 5, 6, 7, 8, 9, 10]]
    sizes = {
        "certificate": 5 * layers,
        "fields": 3 * fields,
        "exponents": state,
        "parts": 10 * parts,
        "inputs": 4 * inputs,
        "gates": (19 + constants) * gates,
        "weights": 0,
    }
    return HEADER + sum(list(sizes.values())[: list(sizes).index(part)])


EDITS = {  # what is changed: part of the file, word of it, value, error of the loader
    "magic": ("header", 0, 1, 2),
    "version": ("header", 1, 2, 3),
    "size": ("header", 2, 400, 1),
    "inputs": ("header", 3, 4000, 5),
    "outputs": ("header", 4, 3, 6),
    "layers": ("header", 5, 9, 5),
    "no gates": ("header", 9, 0, 6),
    "more gates": ("header", 9, 4000, 1),
    "shift": ("header", 13, 33, 6),
    "fraction": ("header", 14, 31, 6),
    "name without an end": ("header", 33, -1, 6),
    "no time step": ("header", 15, 0, 6),
    "two rotors at one place": ("header", 38, 1, 6),
    "low above high": ("header", 42, 2**31 - 1, 6),
    "rows": ("certificate", 0, 500, 5),
    "columns": ("certificate", 1, 21, 6),
    "largest sum": ("certificate", 2, 1, 11),
    "largest output": ("certificate", 4, 1, 11),
    "an unknown field": ("fields", 0, 12, 7),
    "a field of five": ("fields", 2, 5, 7),
    "a range of 2^40": ("exponents", 0, 40, 7),
    "an unknown input": ("parts", 0, 8, 8),
    "an input elsewhere": ("parts", 1, 1, 8),
    "a source beyond the state": ("inputs", 0, 99, 8),
    "a shift of 61": ("inputs", 4 * 12 + 3, 61, 8),
    "a cosine above 1": ("gates", 12, 2**30 + 1, 9),
    "a negative width": ("gates", 14, -1, 9),
    "a gate elsewhere": ("gates", 0, 12345, 12),
}


def test_what_a_new_hash_does_not_hide(data, library):
    for name, (part, word, value, error) in EDITS.items():
        start = 0 if part == "header" else at_of(data, part)
        changed = edited(data, {start + word: value})
        assert load(library, changed) == error, name
        with pytest.raises(InputError):
            parse_qjp(changed)


def test_weights_that_may_overflow_are_refused(data, library):
    start = at_of(data, "weights")
    largest = {start + 4 * column: 2**31 - 1 for column in range(20)}
    assert load(library, edited(data, largest)) == 11
    with pytest.raises(InputError, match="layer 0, row 0: .* allowed"):
        parse_qjp(edited(data, largest))
    assert load(library, edited(data, {start + 4 * 20: 1})) == 10  # of the padding
    flipped = {start: int(np.frombuffer(data, "<i4")[start]) ^ 1}
    assert load(library, edited(data, flipped)) in (11, 12)  # by its proof or its self-tests


def test_a_policy_larger_than_the_macros_is_refused(context, data, tmp_path):
    small = load_library(host(), context.harness, tmp_path / "small.so", ["-DQJP_MAX_WIDTH=16"])
    assert load(small, data) == 5


def test_a_damaged_file_is_named(data, tmp_path, capsys):
    path = tmp_path / "racer.qjp"
    path.write_bytes(data)
    assert read_qjp(path).race.gates == parse_qjp(data).race.gates
    path.write_bytes(data[:-1] + b"\0")
    with pytest.raises(InputError, match="racer.qjp: changed since it was written"):
        read_qjp(path)
    assert run("verify", path, "--runs", 1) == 2
    assert "--runs has no effect on a .qjp file" in capsys.readouterr().err


@pytest.mark.slow
def test_mutated_files_are_refused_and_the_emulated_processors(tmp_path):
    context = QjpContext.make(
        file_of("racing, axes and more"), tmp_path, 1000, 20_000, ("Cortex-M7", "Cortex-M4")
    )
    figures = [check(context) for check in checks_qjp.QJP_CHECKS.values()]
    assert sum("20,000 mutants" in figure for figure in figures) == 1
