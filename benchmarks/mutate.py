"""Mutated .qjp files through the C loader and the pilot, under the address and UB sanitizers.

    python -m benchmarks.mutate FILE.qjp .. [--count 1000000] [--compare 20000] [--seed 0]

Bits, words, lengths and numbers of the header change, most with a right checksum. Where the loader
accepts a file, or only its self-tests refuse it, the pilot flies 20 steps with any numbers, within
the limits of its commands. A part of the answers is compared with the reader in Python. The exit
status is 1 after a report of a sanitizer, a command outside its limits, or a difference.
"""

import struct
import subprocess
import tempfile
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.export.read import read_qjp, unpack
from quadjax.export.targets import RUNTIME
from quadjax.export.words import STRUCTS

SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all"
FLAGS = f"-std=c99 -DQJ_SAMPLED {SANITIZERS} -g -O1".split()
TOO_LARGE = 5
PARTS = ("check", "estimator", "load", "network", "race")  # mutate.c includes the pilot


def build(folder: Path) -> Path:
    """Compile the fuzzer."""
    files = [Path(__file__).parent / "mutate.c", *(RUNTIME / f"qj_{name}.c" for name in PARTS)]
    command = ["gcc", *FLAGS, f"-I{RUNTIME}", *map(str, files), "-o", str(folder / "mutate")]
    subprocess.run(command, check=True)
    return folder / "mutate"


def texts_of(words: np.ndarray) -> np.ndarray:
    """Places of the words that only Python reads: texts, and the kind, which follows from them."""
    header = STRUCTS["header"]
    first = {name: header.fields[name][1] // 4 for name in header.names}
    places = [*range(first["source"], first["low"]), first["kind"]]
    numbers = np.frombuffer(words[: header.itemsize // 4].tobytes(), header)[0]
    size = {name: struct.itemsize // 4 for name, struct in STRUCTS.items()}
    start = size["header"] + size["layer"] * int(numbers["layers"]) + int(numbers["state_size"])
    start += size["field"] * int(numbers["fields"])
    name = STRUCTS["part"].fields["name"][1] // 4
    for part in range(int(numbers["parts"])):
        places += range(start + part * size["part"] + name, start + (part + 1) * size["part"])
    return np.array(places)


def difference(data: bytes, error: int, original: np.ndarray) -> str:
    """How Python and C answer differently, or "".

    Texts are those of the original where C accepts. That a policy is larger than the C was built
    for (error 5) says nothing about it.
    """
    if error == 0 and len(data) == original.nbytes and data != original.tobytes():
        words, places = np.frombuffer(data, "<i4").copy(), texts_of(original)
        words[places] = original[places]
        body = words.tobytes()[:-4]
        data = body + zlib.crc32(body).to_bytes(4, "little")
    try:
        unpack(data)
    except InputError as refused:
        return "" if error else f"C accepts, Python does not: {refused}"
    return f"Python accepts, the error of C is {error}" if error not in (0, TOO_LARGE) else ""


def fuzz(files: Sequence[Path], count: int, compared: int, seed: int, program: Path) -> list[str]:
    """What went wrong, one line each; the files that differ are written here."""
    originals = [np.fromfile(path, "<i4") for path in files]
    numbers = [count, seed, max(1, count // compared) if compared else 0]
    process = subprocess.Popen([program, *map(str, numbers), *files], stdout=subprocess.PIPE)
    assert process.stdout is not None
    wrong = []
    while head := process.stdout.read(12):
        size, error, number = struct.unpack("<3I", head)
        data = process.stdout.read(size)
        if text := difference(data, error, originals[number]):
            Path(f"difference_{len(wrong)}.qjp").write_bytes(data)
            wrong.append(f"difference_{len(wrong)}.qjp, of {files[number].name}: {text}")
    status = process.wait()
    return wrong + ([f"the fuzzer ended with {status}"] if status else [])


def mutate(
    *files: options.ExistingFiles,
    count: Annotated[int, options.whole(1, 10**9)] = 10**6,
    compare: Annotated[int, options.whole(0, 10**9)] = 20_000,
    seed: options.Seed = 0,
) -> int:
    """Print the rate and what went wrong."""
    for file in files:
        read_qjp(file)  # reject bad files first
    with tempfile.TemporaryDirectory() as folder:
        program, started = build(Path(folder)), time.perf_counter()
        wrong = fuzz(files, count, compare, seed, program)
    print(f"{count:,} files, {count / (time.perf_counter() - started):,.0f} a second: ", end="")
    print("\n".join(wrong[:20]) or "no report, no difference")
    return int(bool(wrong))


if __name__ == "__main__":
    script(mutate)
