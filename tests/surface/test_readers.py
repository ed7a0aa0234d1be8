"""Every file that a user hands over, damaged: it is read, or refused in one line."""

import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import quadjax
from tests.surface.damage import SETTINGS, damaged

ROOT = Path(__file__).resolve().parents[2]


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


@pytest.mark.parametrize("kind", READERS)
@SETTINGS
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_in_one_line(kind, data, tmp_path):
    suffix, reader = READERS[kind]
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(data.draw(damaged(example(kind))))
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
    np.savez(path, kernel_0=np.array([print], dtype=object), meta=json.dumps({}))
    with pytest.raises(quadjax.InputError, match="pickled"):
        quadjax.Policy.load(path)
