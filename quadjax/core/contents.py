"""What a file is, from its first bytes, whatever its name says."""

import re
import zipfile
from pathlib import Path

from quadjax.core.errors import InputError, reading

HEAD_BYTES = 4096  # bytes that are looked at
TEXT, EMPTY = "text", "empty"
NPZ = "an archive of NumPy arrays (.npz)"
TORCH, SB3 = "a file of PyTorch (.pt)", "a model of Stable-Baselines3 (.zip)"
PICKLE = "a pickle, which is not loaded, as that may execute what is in it"
ULOG, ULOG_MAGIC = "a ULog file of PX4 (.ulg)", b"ULog\x01\x12\x35"
SPACE = rb"(\xef\xbb\xbf)?\s*"  # before the text of a page or a table
KINDS = {  # by a regular expression of the first bytes; the first that matches
    rb"$": EMPTY,
    rb"version https://git-lfs": "a pointer of Git LFS, not the file itself (git lfs pull gets it)",
    SPACE
    + rb"(?i:<(!doctype|html|head)\b)": "an HTML page, perhaps the page of a download and not "
    "the file",
    SPACE + rb"H Product:\s*Blackbox": "a raw blackbox log (blackbox_decode converts it to CSV)",
    rb"\x93NUMPY": "one NumPy array (.npy)",
    ULOG_MAGIC: ULOG,
    rb"\x1f\x8b": "compressed by gzip",
    rb"\xfd7zXZ": "compressed by xz",
    rb"BZh": "compressed by bzip2",
    rb"\(\xb5/\xfd": "compressed by zstd",
    rb"7z\xbc\xaf": "an archive of 7-Zip",
    rb"Rar!": "an archive of RAR",
    rb"\x89HDF": "an HDF5 file",
    rb"PAR1": "a Parquet file",
    rb"SQLite format 3": "an SQLite database",
    rb"%PDF": "a PDF document",
    rb"\x89PNG": "a PNG image",
    rb"\x7fELF": "a compiled program",
    rb"\xa3\x95\x80": "a dataflash log of ArduPilot",
    rb"\xff\xfe|\xfe\xff": "text in UTF-16, not in UTF-8",
    rb"\x80[\x02-\x05]": PICKLE,
    rb"[^\0]*$": TEXT,
}


def identify_kind(path: Path | str) -> str:
    """What a file is: ``TEXT`` and the other constants of this module, or a phrase.

    Raises:
        InputError: the file cannot be read.
    """
    with reading(path), open(path, "rb") as stream:
        head = stream.read(HEAD_BYTES)
        if head.startswith(b"PK"):
            return _kind_of_zip(path)
    return next((kind for start, kind in KINDS.items() if re.match(start, head)), "binary data")


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
    if (kind := identify_kind(path)) not in kinds:
        raise InputError(f"{path}: is {kind}, expected {expected}")
