"""Write the frozen numbers, or compare the present ones with them.

On a kind of machine that has written them, every bit has to be the same. On another one, rounding
differs, and the values are compared within the tolerance of their part.
"""

import argparse
import contextlib
import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tests.frozen.parts import PARTS, TOLERANCES, Record

FILE = Path(__file__).parent / "numbers.json"


def machine() -> dict[str, str]:
    """What decides the last bits: the processor and the compiler."""
    lines = [line.partition(":") for line in Path("/proc/cpuinfo").read_text().splitlines()]
    values = {key.strip(): value.strip() for key, _, value in lines}
    name, family, model = (values[key] for key in ("model name", "cpu family", "model"))
    return {"processor": f"{name}, family {family}, model {model}", "jax": jax.__version__}


def compute(part: str) -> dict[str, Record]:
    """The records of a part, by name."""
    records = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        begin = time.monotonic()
        for name, record in PARTS[part]():
            records[name] = record
            print(f"{part}: {name} ({time.monotonic() - begin:.0f} s)", file=sys.stderr)
    return records


def difference(part: str, old: Record, new: Record, same_machine: bool) -> str | None:
    """How two records differ; None if as little as allowed."""
    if old.sha256 == new.sha256:
        return None
    tolerance = 0.0 if same_machine else TOLERANCES[part]
    if tolerance is None:
        return None
    if not same_machine and len(old.values) == len(new.values):
        if np.allclose(old.values, new.values, rtol=tolerance, atol=0.0, equal_nan=True):
            return None
    return f"was {old.values}, is {new.values}"


def read() -> list[dict[str, Any]]:
    """For each kind of machine, ``machine`` and its ``parts``."""
    return json.loads(FILE.read_text()) if FILE.exists() else []


def recorded(part: str) -> tuple[dict[str, Record], bool]:
    """The records of a part, and whether this kind of machine wrote them, or only another one."""
    documents = [document for document in read() if part in document["parts"]]
    documents.sort(key=lambda document: document["machine"] != machine())
    if not documents:
        return {}, True
    same = documents[0]["machine"] == machine()
    if not same:
        print(f"{part}: of {documents[0]['machine']}, values are compared within tolerances")
    return {name: Record(**row) for name, row in documents[0]["parts"][part].items()}, same


def compare(parts: list[str]) -> int:
    """Print every difference; the number of them."""
    count = 0
    for part in parts:
        old, same_machine = recorded(part)
        new = compute(part)
        for name in sorted(old.keys() | new.keys()):
            if name in old and name in new:
                text = difference(part, old[name], new[name], same_machine)
            else:
                text = "missing now" if name in old else "not in the file"
            if text:
                count += 1
                print(f"{part}, {name}: {text}")
    print(f"{count} differences")
    return count


def write(parts: list[str]) -> None:
    """Compute parts and replace them in the file, among those of this kind of machine."""
    for part in parts:
        rows = {name: dataclasses.asdict(record) for name, record in compute(part).items()}
        documents = read()
        if not any(document["machine"] == machine() for document in documents):
            documents.append({"machine": machine(), "parts": {}})
        for document in documents:
            if document["machine"] == machine():
                document["parts"][part] = rows
        FILE.write_text(json.dumps(documents, indent=1) + "\n")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.frozen", description=__doc__)
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("part", nargs="*", help=f"{', '.join(PARTS)} (all)")
    options = parser.parse_args()
    unknown = set(options.part) - set(PARTS)
    if unknown:
        parser.error(f"unknown part {sorted(unknown)[0]!r}, allowed: {', '.join(PARTS)}")
    parts = options.part or list(PARTS)
    if options.action == "write":
        write(parts)
        return 0
    return 1 if compare(parts) else 0


if __name__ == "__main__":
    sys.exit(main())
