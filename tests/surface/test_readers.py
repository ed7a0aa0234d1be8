"""Every file that a user hands over, damaged: it is read, or refused in one line."""

import functools
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import quadjax

ROOT = Path(__file__).resolve().parents[2]
PIECES = (
    [b"1e999", b"nan", b"-1", b"null", b"true", b"9" * 5000, b"'", b"\n", b"\t", b",", b"[", b"{"]
    + [b": ", b"- ", b"? ", b"|", b"&a [*a]", b"*b", b"!!python/object:os.system x"]
    + [b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"../../x", b"PK\x03\x04"]
)


def npz(**arrays: object) -> bytes:
    """Arrays as the bytes of an archive."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@functools.cache
def example(kind: str) -> bytes:
    """A whole file of a kind."""
    if kind == "policy":
        return (ROOT / "quadjax/pretrained/indi.npz").read_bytes()
    if kind == "residual":
        return (ROOT / "quadjax/pretrained/standin_residual.npz").read_bytes()
    if kind == "config":
        return quadjax.load("e2e").to_yaml().encode()
    folder = {"track": "tracks/figure8.yaml", "vehicle": "vehicles/bebop1.yaml"}[kind]
    return (ROOT / "configs" / folder).read_bytes()


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "policy": (".npz", quadjax.Policy.load),
    "residual": (
        ".npz",
        lambda p: quadjax.make_race(quadjax.load("e2e", [f"vehicle.residual={p}"])),
    ),
    "config": (".yaml", quadjax.load),
    "track": (".yaml", lambda p: quadjax.load("e2e", [f"track={p}"])),
    "vehicle": (".yaml", lambda p: quadjax.load("e2e", [f"vehicle={p}"])),
}


@st.composite
def damages(draw: st.DrawFn, size: int) -> list[tuple[int, int, bytes]]:
    """Places (begin, end) of a file and what replaces them."""
    changes = []
    for _ in range(draw(st.integers(1, 5))):
        begin = draw(st.integers(0, size))
        length = draw(st.sampled_from((0, 1, 4, 30, 300, size)))
        piece = draw(st.one_of(st.sampled_from(PIECES), st.binary(max_size=8), st.just(b"")))
        changes.append((begin, begin + length, piece))
    return changes


@pytest.mark.parametrize("kind", READERS)
@settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_in_one_line(kind, data, tmp_path):
    suffix, reader = READERS[kind]
    whole = example(kind)
    changed = bytearray(whole)
    for begin, end, piece in data.draw(damages(len(whole))):
        changed[begin:end] = piece
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(bytes(changed))
    try:
        reader(path)
    except quadjax.InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 2_000


def test_the_examples_are_read(tmp_path):
    for kind, (suffix, reader) in READERS.items():
        path = tmp_path / f"{kind}{suffix}"
        path.write_bytes(example(kind))
        reader(path)


def test_an_archive_with_pickled_objects_is_refused(tmp_path):
    path = tmp_path / "pickled.npz"
    path.write_bytes(npz(kernel_0=np.array([print], dtype=object), meta=json.dumps({})))
    with pytest.raises(quadjax.InputError, match="pickled"):
        quadjax.Policy.load(path)
