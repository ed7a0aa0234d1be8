"""Files that are something else than their names say: each reader says what they are."""

import io
import zipfile

import numpy as np
import pytest

import quadjax
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.policy.network_files import read_network

POLICY = (PRETRAINED / "indi.npz").read_bytes()


def zipped(*names):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"content")
    return stream.getvalue()


def array():
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    return stream.getvalue()


CONTENTS = {  # what a file holds, and what its message says
    "pointer": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        "a pointer of Git LFS, not the file itself (git lfs pull gets it)",
    ),
    "page": (b"\n<!DOCTYPE html><html>", "an HTML page, perhaps the page of a download"),
    "empty": (b"", "empty"),
    "half": (POLICY[: len(POLICY) // 2], "a zip archive that is cut short"),
    "blackbox": (b"H Product:Blackbox flight data\nH Data version:2\nI\x00\xff", "blackbox_decode"),
    "array": (array(), "one NumPy array (.npy)"),
    "gzip": (b"\x1f\x8b\x08\x00abc", "compressed by gzip"),
    "utf16": ("time,p".encode("utf-16"), "text in UTF-16"),
    "binary": (b"ab\x00cd", "binary data"),
    "torch": (zipped("archive/data.pkl"), "a file of PyTorch (.pt)"),
    "sb3": (zipped("data", "policy.pth"), "a model of Stable-Baselines3 (.zip)"),
    "ulog": (b"ULog\x01\x12\x35\x01" + bytes(8), "a ULog file of PX4 (.ulg)"),
    "text": (b"no: mapping\n", "text"),
}
READERS = {  # suffix, what reads it, and the contents that are what it expects
    ".npz": (quadjax.Policy.load, ()),
    ".pt": (read_network, ("torch",)),
    ".ckpt": (read_network, ("torch",)),
    ".zip": (read_network, ("sb3",)),
    ".c": (read_network, ("text",)),
    ".csv": (lambda path: read_log(path, LogsConfig(format="paparazzi")), ("text",)),
    ".ulg": (lambda path: read_log(path, LogsConfig(format="ulog")), ("ulog",)),
    ".yaml": (quadjax.load, ("text",)),
}


@pytest.mark.parametrize("kind", CONTENTS)
@pytest.mark.parametrize("suffix", READERS)
def test_a_file_that_is_something_else_is_called_what_it_is(suffix, kind, tmp_path):
    path, (content, says) = tmp_path / f"file{suffix}", CONTENTS[kind]
    path.write_bytes(content)
    read, allowed = READERS[suffix]
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert (f"{path}: is " in message and says in message) != (kind in allowed), message
    assert "torch.save" not in message and "\n" not in message
