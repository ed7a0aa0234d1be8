"""Files damaged at random: each is read, or refused in one line. Nothing else is raised."""

import os
import random
from pathlib import Path

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.core.resources import CONFIGS
from quadjax.fitting.columns import WRITTEN
from quadjax.fitting.config import LogsConfig, load_fit_config
from quadjax.fitting.flight_log import read_log, write_log
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.sweeps.sweep import load_sweep
from quadjax.training.metrics import read_metrics
from quadjax.vehicle.residual import read_residual
from tests.sweeps.support import sweep_file
from tests.test_files import POLICY_META, RESIDUAL_META, policy_arrays, residual_arrays, save

NASTY = (
    [b"1e999", b"nan", b"-1", b"null", b"true", b"1e-400", b"9" * 5000, b"'", b"\n", b"\t", b","]
    + [b"[", b"{", b": ", b"- ", b"? ", b"|", b"&a [*a]", b"*b", b"!!python/object:os.system x"]
    + [b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"../../x", b"PK\x03\x04"]
)


def damaged(data: bytes, draw: random.Random) -> bytes:
    """The data with some bits flipped, bytes removed, repeated or replaced, or cut off."""
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 5, 50))):
        begin = draw.randrange(len(changed) + 1)
        end = min(len(changed), begin + draw.choice((1, 4, 30, 300)))
        kind = draw.randrange(6)
        if kind == 0 and begin < end:
            changed[begin] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del changed[begin:]
        elif kind == 2:
            del changed[begin:end]
        elif kind == 3:
            changed[begin:begin] = draw.choice(NASTY)
        elif kind == 4:
            changed[begin:begin] = changed[begin:end] * draw.choice((1, 3, 100))
        else:
            changed[begin:end] = draw.choice(NASTY)
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


KINDS = {  # suffix, what writes a whole file, what reads it
    "policy": (".npz", lambda p: save(p, policy_arrays(), POLICY_META), Policy.load),
    "residual": (".npz", lambda p: save(p, residual_arrays(), RESIDUAL_META), read_residual),
    "log": (
        ".csv",
        write_flight,
        lambda p: read_log(p, LogsConfig(format="paparazzi")),
    ),
    "config": (".yaml", lambda p: p.write_text(load_config("e2e").to_yaml()), load_config),
    "track": (
        ".yaml",
        lambda p: p.write_bytes((CONFIGS / "tracks/figure8.yaml").read_bytes()),
        lambda p: load_config("e2e", [f"track={p}"]),
    ),
    "vehicle": (
        ".yaml",
        lambda p: p.write_bytes((CONFIGS / "vehicles/bebop1.yaml").read_bytes()),
        lambda p: load_config("e2e", [f"vehicle={p}"]),
    ),
    "plant": (
        ".yaml",
        lambda p: p.write_bytes((CONFIGS / "plant/standin.yaml").read_bytes()),
        load_plant_config,
    ),
    "fit": (".yaml", lambda p: p.write_text("logs: {files: [a.csv]}\nseed: 1\n"), load_fit_config),
    "sweep": (
        ".yaml",
        lambda p: sweep_file(p.parent).rename(p),
        load_sweep,
    ),
    "metrics": (".csv", lambda p: p.write_text("steps,score\n100,1.5\n200,1.2\n"), read_metrics),
    "summary": (".json", lambda p: p.write_text('{"finished": true, "steps": 3}'), read_json),
}


DAMAGED_IN_READERS = ("policy", "residual", "config", "track", "vehicle")


def test_pipes_devices_folders_and_loops_of_links_are_refused_in_one_line(tmp_path):
    pipe, loop = tmp_path / "pipe.yaml", tmp_path / "loop.yaml"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for _, _, read in KINDS.values():
        for path in (pipe, loop, tmp_path, Path("/dev/zero"), tmp_path / ("n" * 300)):
            with pytest.raises(InputError) as caught:
                read(path)
            assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_skipped(tmp_path):
    for kind, (suffix, write, read) in KINDS.items():
        if suffix != ".npz":
            path = tmp_path / f"{kind}{suffix}"
            write(path)
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
            read(path)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in DAMAGED_IN_READERS])
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path, kind):
    """The other kinds are damaged in tests/surface/test_readers.py."""
    suffix, write, read = KINDS[kind]
    path, draw, refused = tmp_path / f"file{suffix}", random.Random(kind), 0
    write(path)
    read(path)
    whole = path.read_bytes()
    for _ in range(50):
        path.write_bytes(damaged(whole, draw))
        try:
            read(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 1000
    assert refused > 10
