"""Files damaged at random: each is read, or refused in one line. Nothing else is raised."""

import builtins
import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import quadjax
from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.fitting.config import LogsConfig, load_fit_config
from quadjax.fitting.flight_log import read_log, write_log
from quadjax.fitting.formats import WRITTEN
from quadjax.plant.config import load_plant_config
from quadjax.policy.network_files import read_network
from quadjax.sweeps.sweep import load_sweep
from quadjax.training.result import read_metrics
from quadjax.vehicle.residual import read_residual
from tests.policy.writers import c_source, linear
from tests.sweeps.stand_in import sweep_file

PIECES = (
    [b"1e999", b"nan", b"-1", b"null", b"true", b"9" * 5000, b"'", b"\n", b"\t", b",", b"[", b"{"]
    + [b": ", b"- ", b"? ", b"|", b"&a [*a]", b"*b", b"!!python/object:os.system x"]
    + [b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"../../x", b"PK\x03\x04"]
)
SETTINGS = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """The contents of a file with some of its bytes replaced."""
    changed = bytearray(whole)
    for _ in range(draw(st.integers(1, 5))):
        begin = draw(st.integers(0, len(whole)))
        length = draw(st.sampled_from((0, 1, 4, 30, 300, len(whole))))
        piece = draw(st.one_of(st.sampled_from(PIECES), st.binary(max_size=8), st.just(b"")))
        changed[begin : begin + length] = piece
    return bytes(changed)


def write_flight(path: Path) -> None:
    """A short log of a drone that hovers."""
    time = np.arange(0.0, 3.0, 0.002)
    noise = np.random.default_rng(0).normal(size=(len(WRITTEN), 4, len(time)))
    columns = {
        name: 0.01 * noise[i, j]
        for i, names in enumerate(WRITTEN.values())
        for j, name in enumerate(names)
    }
    for name in (*WRITTEN["rpm"], *WRITTEN["rpm_command"]):
        columns[name] += 7000.0
    columns[WRITTEN["acceleration"][2]] -= 9.81
    write_log(path, columns | {"time": time, "autopilot_mode": np.ones(len(time))})


def copy(source: Path):
    """What writes the contents of another file."""
    return lambda path: path.write_bytes(source.read_bytes())


KINDS = {  # suffix, what writes a whole file, what reads it
    "policy": (".npz", copy(PRETRAINED / "indi.npz"), quadjax.Policy.load),
    "residual": (".npz", copy(PRETRAINED / "standin_residual.npz"), read_residual),
    "config": (".yaml", lambda p: p.write_text(quadjax.load("e2e").to_yaml()), quadjax.load),
    "track": (
        ".yaml",
        copy(CONFIGS / "tracks/figure8.yaml"),
        lambda p: quadjax.load("e2e", [f"track={p}"]),
    ),
    "vehicle": (
        ".yaml",
        copy(CONFIGS / "vehicles/bebop1.yaml"),
        lambda p: quadjax.load("e2e", [f"vehicle={p}"]),
    ),
    "C arrays": (".c", lambda p: p.write_text(c_source(linear((24, 4)))), read_network),
    "log": (
        ".csv",
        write_flight,
        lambda p: read_log(p, LogsConfig(format="paparazzi")),
    ),
    "plant": (".yaml", copy(CONFIGS / "plant/standin.yaml"), load_plant_config),
    "fit": (".yaml", lambda p: p.write_text("logs: {files: [a.csv]}\nseed: 1\n"), load_fit_config),
    "sweep": (
        ".yaml",
        lambda p: sweep_file(p.parent).rename(p),
        load_sweep,
    ),
    "metrics": (".csv", lambda p: p.write_text("steps,score\n100,1.5\n200,1.2\n"), read_metrics),
    "summary": (".json", lambda p: p.write_text('{"finished": true, "steps": 3}'), read_json),
}


def test_pipes_devices_folders_and_loops_of_links_are_refused_in_one_line(tmp_path):
    pipe, loop = tmp_path / "pipe.yaml", tmp_path / "loop.yaml"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for _, _, read in KINDS.values():
        for path in (pipe, loop, tmp_path, Path("/dev/zero"), tmp_path / ("n" * 300)):
            with pytest.raises(InputError) as caught:
                read(path)
            assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The contents of a file of each kind."""
    folder, contents = tmp_path_factory.mktemp("whole"), {}
    for kind, (suffix, write, _) in KINDS.items():
        path = folder / f"{kind}{suffix}"
        write(path)
        KINDS[kind][2](path)
        contents[kind] = path.read_bytes()
    return contents


@pytest.mark.parametrize("kind", ["policy", "residual", "C arrays"])
def test_a_file_without_permission_is_not_called_damaged(kind, tmp_path, whole, monkeypatch):
    def refused(*arguments, **options):
        raise PermissionError(errno.EACCES, "Permission denied")

    path = tmp_path / f"file{KINDS[kind][0]}"
    path.write_bytes(whole[kind])
    monkeypatch.setattr(builtins, "open", refused)
    with pytest.raises(InputError, match=r"file\..*: cannot be read \(Permission denied\)"):
        KINDS[kind][2](path)


@pytest.mark.parametrize("kind", KINDS)
@SETTINGS
@given(data=st.data())
def test_damaged_files_are_read_or_refused_in_one_line(kind, data, tmp_path, whole):
    suffix, _, read = KINDS[kind]
    path = tmp_path / f"file{suffix}"
    path.write_bytes(data.draw(damaged(whole[kind])))
    try:
        read(path)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000


def test_an_archive_with_pickled_objects_is_refused(tmp_path):
    path = tmp_path / "pickled.npz"
    np.savez(path, kernel_0=np.array([print], dtype=object), meta=json.dumps({}))
    with pytest.raises(InputError, match="pickled"):
        quadjax.Policy.load(path)
