"""What a file is, from its first bytes, whatever its name says."""

import re
import zipfile
from pathlib import Path

from quadjax.core.errors import InputError, reading

HEAD = 4096  # bytes that are looked at
TEXT, NPZ, TORCH, SB3, PICKLE, EMPTY = "text", "npz", "torch", "sb3", "pickle", "empty"
ULOG, ULOG_MAGIC = "a ULog file of PX4 (.ulg)", b"ULog\x01\x12\x35"
BLACKBOX = re.compile(rb"H Product:\s*Blackbox")
WHAT = {  # kinds whose name is not what a message says
    NPZ: "an archive of NumPy arrays (.npz)",
    TORCH: "a file of PyTorch (.pt)",
    SB3: "a model of Stable-Baselines3 (.zip)",
    PICKLE: "a pickle, which is not loaded, as that may execute what is in it",
}
MAGIC = {  # first bytes
    b"version https://git-lfs": "a pointer of Git LFS, not the file itself (git lfs pull gets it)",
    b"\x93NUMPY": "one NumPy array (.npy)",
    ULOG_MAGIC: ULOG,
    b"\x1f\x8b": "compressed by gzip",
    b"\xfd7zXZ": "compressed by xz",
    b"BZh": "compressed by bzip2",
    b"(\xb5/\xfd": "compressed by zstd",
    b"7z\xbc\xaf": "an archive of 7-Zip",
    b"Rar!": "an archive of RAR",
    b"\x89HDF": "an HDF5 file",
    b"PAR1": "a Parquet file",
    b"SQLite format 3": "an SQLite database",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a PNG image",
    b"\x7fELF": "a compiled program",
    b"\xa3\x95\x80": "a dataflash log of ArduPilot",
    b"\xff\xfe": "text in UTF-16, not in UTF-8",
    b"\xfe\xff": "text in UTF-16, not in UTF-8",
}


def kind_of(path: Path | str) -> str:
    """What a file is: ``TEXT`` and the other constants of this module, or a phrase.

    Raises:
        InputError: the file cannot be read.
    """
    with reading(path), open(path, "rb") as stream:
        head = stream.read(HEAD)
        if head.startswith(b"PK"):
            return _kind_of_zip(path)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not head:
        return EMPTY
    if re.match(rb"(?i)<(!doctype|html|head)\b", start):
        return "an HTML page, perhaps the page of a download and not the file"
    if BLACKBOX.match(start):
        return "a raw blackbox log (blackbox_decode converts it to CSV)"
    known = [kind for magic, kind in MAGIC.items() if head.startswith(magic)]
    if not known and re.match(rb"\x80[\x02-\x05]", head):
        return PICKLE
    return known[0] if known else "binary data" if b"\0" in head else TEXT


def _kind_of_zip(path: Path | str) -> str:
    if not zipfile.is_zipfile(path):
        return "a zip archive that is cut short"
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception:  # damaged in one of many ways
        return "a damaged zip archive"
    if "policy.pth" in names and "data" in names:
        return SB3
    if any(name.endswith("/data.pkl") for name in names):
        return TORCH
    return NPZ if names and all(name.endswith(".npy") for name in names) else "a zip archive"


def check_kind(path: Path | str, expected: str, *kinds: str) -> None:
    """Reject a file that is none of some kinds.

    Raises:
        InputError: it says what the file is, and what is ``expected``.
    """
    if (kind := kind_of(path)) not in kinds:
        raise InputError(f"{path}: is {WHAT.get(kind, kind)}, expected {expected}")
