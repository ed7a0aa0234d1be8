"""Execution of the notebooks: ``python -m tests.docs.notebooks [NAME ...]`` runs them in place.

Every notebook has one code cell with the tag ``parameters``, which the tests replace. An executed
notebook has the hash of its inputs in its metadata: a notebook whose hash differs is stale.
"""

import hashlib
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import nbformat
import yaml
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
INPUTS = ("configs/**/*.yaml", "quadjax/pretrained/**/*.npz")
DEFAULTS = ["bebop1", "square4"]  # of every config that names no other vehicle and track
CELL_SECONDS = 900


def read(path: Path) -> nbformat.NotebookNode:
    """A notebook."""
    return nbformat.read(path, as_version=4)


def parameters_of(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Its cell of parameters."""
    (cell,) = [c for c in notebook.cells if "parameters" in c.metadata.get("tags", [])]
    return cell


def code_of(notebook: nbformat.NotebookNode) -> list[str]:
    """The sources of its code cells."""
    return [cell.source for cell in notebook.cells if cell.cell_type == "code"]


def _strings(value: object) -> Iterator[str]:
    """Every string in the values of a parsed YAML file."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _strings(item)


def inputs_of(notebook: nbformat.NotebookNode, root: Path = ROOT) -> dict[str, str]:
    """Contents of the configs and policies that its code names, by path.

    A file is named by a string, or a word of a command, that is its file name, with or without the
    suffix. The files that a config names in turn (bases, vehicle, track, residual) are among them.
    A YAML file counts by its values, so comments do not matter.
    """
    files: dict[str, list[Path]] = {}
    for path in sorted(path for pattern in INPUTS for path in root.glob(pattern)):
        for name in {path.name, path.stem}:
            files.setdefault(name, []).append(path)
    contents: dict[str, str] = {}
    texts = []
    for code in code_of(notebook):
        texts += code.split() if code.startswith("%%") else re.findall(r'"([\w./+ -]+)"', code)
    words = []
    for preset, *parts in (text.split() for text in texts if text.strip()):  # "e2e +residual"
        names = [part.removeprefix("+") for part in parts]
        words += [preset, *names, *(f"{preset}_{name}" for name in names)]
    words += DEFAULTS
    while words:
        for path in files.get(Path(words.pop()).name, []):
            if (key := path.relative_to(root).as_posix()) in contents:
                continue
            if path.suffix == ".yaml":
                values = yaml.safe_load(path.read_text(encoding="utf-8"))
                words += _strings(values)
                contents[key] = json.dumps(values, default=str)
            else:
                contents[key] = hashlib.sha256(path.read_bytes()).hexdigest()
    return contents


def stamp(notebook: nbformat.NotebookNode, root: Path = ROOT) -> str:
    """Hash of what decides a notebook's outputs: its code and the files of ``inputs_of``.

    The sources of the package are not in it: a change of the code that changes results needs
    ``make notebooks``.
    """
    text = json.dumps([code_of(notebook), inputs_of(notebook, root)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def stamped(notebook: nbformat.NotebookNode) -> str | None:
    """The hash of the inputs with which a notebook was executed."""
    return notebook.metadata.get("quadjax", {}).get("inputs")


def execute(notebook: nbformat.NotebookNode, folder: Path) -> None:
    """Run every cell in a new kernel; outputs stay in the notebook, without times."""
    modules = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH")) if p)
    commands = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    client = NotebookClient(
        notebook,
        timeout=CELL_SECONDS,
        startup_timeout=300,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,  # a busy machine would split them
        resources={"metadata": {"path": str(folder)}},
    )
    # Level 3: no messages of XLA on slow compilations of a busy machine in the outputs.
    paths = {"PYTHONPATH": modules, "PATH": commands}
    client.execute(env=os.environ | paths | {"TF_CPP_MIN_LOG_LEVEL": "3"})
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "quadjax": {"inputs": stamp(notebook)},
    }


if __name__ == "__main__":
    names = sys.argv[1:] or [path.stem for path in NOTEBOOKS]
    for path in (ROOT / "notebooks" / f"{name}.ipynb" for name in names):
        print(path.name)
        notebook = read(path)
        with tempfile.TemporaryDirectory() as folder:
            execute(notebook, Path(folder))
        path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")
