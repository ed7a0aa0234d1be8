"""Words of a policy with other numbers, and the C runtime that loads them."""

import ctypes
import shutil
import zlib
from pathlib import Path

import numpy as np

from quadjax.export.targets import RUNTIME
from quadjax.export.verify.build import load_library, pointers
from quadjax.export.verify.toolchain import host
from quadjax.export.words import STRUCTS

FILES = sorted(path for path in RUNTIME.glob("qj_*.c") if path.name != "qj_angles.c")


def edited(data: bytes, changes: dict[int, int]) -> bytes:
    """The words with other numbers, and the checksum of what they then are."""
    words = np.frombuffer(data, "<i4").copy()
    for at, value in changes.items():
        words[at] = value
    body = words.tobytes()[:-4]
    return body + zlib.crc32(body).to_bytes(4, "little")


def at_of(data: bytes, part: str, field: str | None = None, row: int = 0) -> int:
    """The place of a word: of a structure's field, or of a part's first word."""
    size = {name: struct.itemsize // 4 for name, struct in STRUCTS.items()}
    header = np.frombuffer(data, STRUCTS["header"], 1)[0]
    parts = {"header": size["header"], "layer": size["layer"] * header["layers"]}
    parts |= {"field": size["field"] * header["fields"], "exponents": header["state_size"]}
    parts |= {"part": size["part"] * header["parts"], "input": size["input"] * header["inputs"]}
    parts |= {"gate": (size["gate"] + header["constants"]) * header["gates"], "weights": 0}
    start = sum(int(x) for x in list(parts.values())[: list(parts).index(part)])
    place = STRUCTS[part].fields[field][1] // 4 + row * size[part] if field else row
    return start + place


def with_flipped_weight(data: bytes) -> bytes:
    """Words with one bit of a weight changed, and their own checksum."""
    at = at_of(data, "weights")
    return edited(data, {at: int(np.frombuffer(data, "<i4")[at]) ^ 1})


def runtime_of(folder: Path, change: tuple[str, str, str] | None = None, *options: str):
    """A copy of the runtime as a library; a change is a file, a text in it, and another text."""
    folder.mkdir()
    for path in RUNTIME.glob("qj*.[ch]"):
        shutil.copy(path, folder)
    if change:
        file, old, new = change
        text = (folder / file).read_text()
        assert old in text, old
        (folder / file).write_text(text.replace(old, new, 1))
    files = [folder / path.name for path in FILES]
    return load_library(host(), files, folder / "runtime.so", [f"-I{folder}", *options])


def load(runtime: ctypes.CDLL, data: bytes) -> int:
    """The error of ``qj_load``."""
    words = np.frombuffer(data, np.int32).copy()
    return runtime.qj_load(*pointers(np.zeros(4096, np.uint8), words), len(data))
