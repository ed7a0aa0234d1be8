"""Policy and residual files: they come back as they went, and damage is one clear line."""

import dataclasses
import io
import json
import zipfile

import chex
import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz, whole_file, write_json, write_text
from quadjax.policy.file import Policy
from quadjax.vehicle.residual import read_residual, write_residual
from tests import reference as ref
from tests.convert import residual_of

FIELDS = (  # of the observation of a rate policy
    {"name": "position", "size": 3, "unit": "m", "frame": "gate"},
    {"name": "velocity", "size": 3, "unit": "m/s", "frame": "gate"},
    {"name": "attitude", "size": 3, "unit": "rad", "frame": "gate"},
    {"name": "rates", "size": 3, "unit": "rad/s", "frame": "body"},
    {"name": "thrust", "size": 1, "unit": "m/s^2", "frame": "body", "span": [[0, 15]]},
    {"name": "next_position", "size": 3, "unit": "m", "frame": "gate"},
    {"name": "next_yaw", "size": 1, "unit": "rad", "frame": "gate"},
)
POLICY_META = {
    "format": "quadjax-policy/2",
    "vehicle": "rate",
    "activation": "relu",
    "output": "clip",
    "command_low": [-3, -3, -3, 0],
    "command_high": [3, 3, 3, 15],
    "layout": FIELDS,
    "source": {"run": "test"},
}
RESIDUAL_META = {
    "format": "quadjax-residual/1",
    "rpm_min": 3000,
    "rpm_max": 11000,
    "thrust_sign": -1,
    "source": "a flight",
}


def policy_arrays():
    draw = np.random.default_rng(0)
    sizes = (17, 8, 6, 4)
    arrays = {"log_std": draw.normal(size=4).astype(np.float32)}
    for i, (rows, columns) in enumerate(zip(sizes, sizes[1:], strict=False)):
        arrays[f"kernel_{i}"] = draw.normal(size=(rows, columns)).astype(np.float32)
        arrays[f"bias_{i}"] = draw.normal(size=columns).astype(np.float32)
    return arrays


def residual_arrays():
    draw = np.random.default_rng(0)
    arrays = {}
    for name, (rows, columns) in {"thrust": (7, 1), "moment": (10, 3)}.items():
        for i, shape in enumerate([(rows, 32), (32, columns)]):
            arrays[f"{name}_kernel_{i}"] = draw.normal(size=shape).astype(np.float32)
            arrays[f"{name}_bias_{i}"] = draw.normal(size=shape[1]).astype(np.float32)
    return arrays


def save(path, arrays, meta):
    """As anybody would with NumPy alone."""
    text = meta if isinstance(meta, str) else json.dumps(meta)
    np.savez(path, **arrays, **({} if meta is None else {"meta": text}))
    return path


def refusal(read, path):
    with pytest.raises(InputError) as caught:
        read(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text, text
    return text


def test_policy_comes_back_as_it_went(tmp_path):
    bare = {key: value for key, value in POLICY_META.items() if key != "output"}
    value = ((np.ones((17, 8)), np.zeros(8)), (np.full((8, 1), 0.5), np.array([3.0])))
    first = Policy.load(save(tmp_path / "a.npz", policy_arrays(), bare))
    dataclasses.replace(first, value=value).save(tmp_path / "v.npz")
    chex.assert_trees_all_equal(Policy.load(tmp_path / "v.npz").value, value)
    assert first.layout.size == 17 and first.layout["thrust"].span == ((0.0, 15.0),)
    assert (first.vehicle, first.activation, first.config) == ("rate", "relu", None)
    np.testing.assert_array_equal(first.command_high, [3, 3, 3, 15])
    first.save(tmp_path / "new" / "b.npz")
    second = Policy.load(tmp_path / "new" / "b.npz")
    assert first.layout.to_meta() == second.layout.to_meta()
    for name in set(Policy.__dataclass_fields__) - {"layout"}:
        chex.assert_trees_all_equal(getattr(first, name), getattr(second, name))
    with np.load(tmp_path / "new" / "b.npz", allow_pickle=False) as file:
        assert set(file) == {*policy_arrays(), "meta"}
        for key, array in policy_arrays().items():
            np.testing.assert_array_equal(file[key], array)
    assert second.meta["format"] == "quadjax-policy/2"


def test_samples_have_the_noise_of_the_file(tmp_path):
    policy = Policy.load(save(tmp_path / "p.npz", policy_arrays(), POLICY_META))
    seen = np.random.default_rng(1).normal(size=(5, 17)).astype(np.float32)
    mean = np.asarray(policy.mean(seen))
    np.testing.assert_allclose(policy(seen[0]), mean[0], atol=1e-6)
    quiet = dataclasses.replace(policy, log_std=np.full(4, -20.0))
    np.testing.assert_allclose(quiet.sample(seen, jax.random.key(0)), mean, atol=1e-6)
    noisy = np.asarray(policy.sample(np.zeros((4000, 17), np.float32), jax.random.key(0)))
    assert noisy.min() >= -1 and noisy.max() <= 1 and noisy.std(axis=0).min() > 0.1


def test_a_policy_has_the_residual_that_it_was_trained_with(tmp_path):
    """It is also a residual file, and the config in it names the file itself."""
    first = Policy.load(save(tmp_path / "a.npz", policy_arrays(), POLICY_META))
    save(tmp_path / "r.npz", residual_arrays(), RESIDUAL_META)
    residual = read_residual(tmp_path / "r.npz")
    config = {"vehicle": {"residual": str(tmp_path / "r.npz")}}
    path = tmp_path / "b.npz"
    dataclasses.replace(first, config=config, residual=residual).save(path)
    (tmp_path / "r.npz").unlink()
    found = Policy.load(path)
    assert found.config == {"vehicle": {"residual": str(path)}}
    for again in (found.residual, read_residual(path)):
        chex.assert_trees_all_equal(again, residual)
    first.save(tmp_path / "c.npz")
    assert "without a residual" in refusal(read_residual, tmp_path / "c.npz")


def without(arrays, *names):
    return {key: value for key, value in arrays.items() if key not in names}


def poked(arrays, name, value):
    array = arrays[name].copy()
    array.flat[3] = value
    return arrays | {name: array}


def with_value(inputs, outputs):
    return {"value_kernel_0": np.zeros((inputs, outputs)), "value_bias_0": np.zeros(outputs)}


POLICY_DAMAGE = {
    "no bias": (lambda a: without(a, "bias_1"), {}, "bias_1 is missing"),
    "no log_std": (lambda a: without(a, "log_std"), {}, "log_std"),
    "nan": (lambda a: poked(a, "kernel_1", np.nan), {}, "layer 1, row 3: kernel_1[0, 3] is nan"),
    "large": (
        lambda a: poked(a, "kernel_1", -1e30),
        {},
        "kernel_1 has 1e+30, allowed: up to",
    ),
    "other inputs": (lambda a: a, {"layout": FIELDS[1:]}, "observes 14 numbers"),
    "a residual": (lambda a: a, {"format": "quadjax-residual/1"}, "quadjax-residual/1"),
    "another format": (lambda a: a, {"format": "quadjax-policy/1"}, "expected quadjax-policy/2"),
    "huge limits": (lambda a: a, {"command_high": [3, 3, 3, 10**400]}, "command_high"),
    "no layout": (lambda a: a, {"layout": None}, "meta 'layout' is None, expected a list"),
    "no field": (lambda a: a, {"layout": [1, 2]}, "meta 'layout'[0]"),
    "a value's outputs": (lambda a: a | with_value(17, 4), {}, "17 and 1"),
}
RESIDUAL_DAMAGE = {
    "no moment": (lambda a: without(a, "moment_kernel_0"), {}, "moment_kernel_0 is missing"),
    "inputs": (lambda a: a | {"thrust_kernel_0": np.zeros((8, 32))}, {}, "thrust network"),
    "sign": (lambda a: a, {"thrust_sign": 0}, "thrust_sign"),
    "huge rpm": (lambda a: a, {"rpm_max": 10**4000}, "rpm_max"),
    "crossed rpm": (lambda a: a, {"rpm_max": 2000}, "rpm_min"),
}


def test_damaged_arrays_and_meta_are_one_line_that_names_them(tmp_path):
    for read, arrays, whole, table in (
        (Policy.load, policy_arrays(), POLICY_META, POLICY_DAMAGE),
        (read_residual, residual_arrays(), RESIDUAL_META, RESIDUAL_DAMAGE),
    ):
        for damage, (change, meta, words) in table.items():
            path = save(tmp_path / "f.npz", change(arrays), whole | meta)
            assert words in refusal(read, path), damage


def archive_of(path, array):
    """An archive of one array, as bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("kernel_0.npy", array)


def header(shape):
    """The header of an array file, whose contents are missing."""
    stream = io.BytesIO()
    described = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, described)
    return stream.getvalue()


def with_an_array_twice(path):
    save(path, policy_arrays() | residual_arrays(), POLICY_META)
    with zipfile.ZipFile(path) as archive:
        again = archive.read("kernel_0.npy")
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("ballast.npy", b"not an array, and not of the format: it is not read")
        archive.writestr("kernel_0.npy", again)


def with_meta(meta):
    return lambda path: save(path, policy_arrays(), meta)


DIGITS = b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"9" * 5000 + b",)}\n"
DIGITS = b"\x93NUMPY\x01\x00" + len(DIGITS).to_bytes(2, "little") + DIGITS
ARCHIVES = (  # what writes a file, words of the refusal
    (lambda path: path.write_bytes(b""), ""),
    (lambda path: archive_of(path, b"\x93NUMPYgarbage"), ""),
    (lambda path: archive_of(path, DIGITS), ""),
    (lambda path: archive_of(path, header((2**20, 2**20))), "kernel_0 has 4,398,046,511,104 bytes"),
    (lambda path: path.write_bytes(header((3,)) + bytes(12)), ""),
    (with_an_array_twice, "kernel_0 is in the file more than once"),
    (with_meta(None), "meta"),
    (with_meta("{not json"), "JSON"),
    (with_meta("[1, 2]"), "JSON of an object"),
    (with_meta("[" * 100_000), "not JSON"),
    (with_meta('{"format": ' + "1" * 5000 + "}"), "format is inf"),
)


@pytest.mark.parametrize("read", [Policy.load, read_residual])
def test_archives_and_meta_that_are_none(tmp_path, read):
    path = tmp_path / "f.npz"
    for write, words in ARCHIVES:
        write(path)
        message = refusal(read, path)
        assert words in message and len(message) < 400 + len(str(path))


def test_residual_comes_back_as_it_went(tmp_path):
    residual = residual_of(ref.random_residual(-1.0))
    write_residual(tmp_path / "r.npz", residual, {"flights": 3})
    found = read_residual(tmp_path / "r.npz")
    chex.assert_trees_all_close(found, residual, rtol=1e-6)
    assert (found.rpm_min, found.rpm_max, found.thrust_sign) == (2500, 10500, -1)
    plain = read_residual(save(tmp_path / "n.npz", residual_arrays(), RESIDUAL_META))
    assert plain.thrust_sign == -1 and plain.moment["Dense_1"]["kernel"].shape == (32, 3)


def test_whole_file_leaves_the_old_one_when_writing_fails(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError), whole_file(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
    write_text(path, "new")
    assert path.read_text() == "new"
    with pytest.raises(ValueError):  # JSON has no NaN
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()


def test_a_shipped_residual_is_found_by_its_name(tmp_path, monkeypatch):
    """From any folder; a file of that name there comes first."""
    monkeypatch.chdir(tmp_path)
    shipped = read_residual("standin_residual.npz")
    assert shipped.thrust["Dense_0"]["kernel"].shape[0] == 7
    assert shipped.moment["Dense_1"]["kernel"].shape[1] == 3
    with pytest.raises(InputError, match=r"folder/standin_residual\.npz"):
        read_residual("folder/standin_residual.npz")
    (tmp_path / "standin_residual.npz").write_bytes(b"not a file of arrays")
    with pytest.raises(InputError, match="standin_residual"):
        read_residual("standin_residual.npz")


def test_an_array_with_a_header_of_version_3(tmp_path):
    path = save(tmp_path / "p.npz", {}, POLICY_META)
    with zipfile.ZipFile(path, "a") as archive, archive.open("kernel_0.npy", "w") as stream:
        np.lib.format.write_array(stream, np.ones((3, 2)), version=(3, 0))
    np.testing.assert_array_equal(read_npz(path, "quadjax-policy/2")[0]["kernel_0"], 1.0)
