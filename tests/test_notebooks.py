"""Every notebook runs from its first cell to its last, and those in the repository have run.

They are executed in copies, with their cell of parameters replaced by small numbers.
"""

import json
import re
from pathlib import Path

import nbformat
import pytest

from quadjax.cli.notebooks import execute, outputs_of, read_notebook, set_parameters, write_notebook
from quadjax.core.errors import InputError

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
MOST_BYTES = 2_000_000

SMALL = {
    "e2e_vs_indi": """
        RUNS, LAPS, SEED, SHOWN_SECONDS = 2, 1, 0, 0.5
        CHANGES = {"E2E": ("without battery",), "INDI": ()}
    """,
    "fixed_point": """
        POLICY, FLIGHTS, LAPS, VECTORS = "e2e.npz", 4, 1, 200
    """,
    "residual_fit": """
        FLIGHTS, LAPS, SEED, LEAST_SECONDS = 2, 1, 0, 2.5
        WORDS = ["residual={seeds: 1, epochs: 3, teach_epochs: 5, mirror: off, batch: 512}"]
    """,
    "train_and_tune": """
        STEPS, SEED, RUNS = 25_000, 0, 2
        CHANGE = ("narrow", ["network.hidden=[32,32]"])
        WORDS = ["train.evaluate_every=12500", "train.devices=1"]
    """,
}


def test_each_has_small_numbers():
    assert sorted(SMALL) == NOTEBOOKS


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_runs(name, tmp_path):
    notebook = read_notebook(FOLDER / f"{name}.ipynb")
    set_parameters(notebook, "\n".join(line.strip() for line in SMALL[name].splitlines()))
    execute(notebook, tmp_path)
    assert all(output.output_type != "error" for output in outputs_of(notebook))
    assert not list(tmp_path.iterdir())  # it tidies up


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_what_is_kept_has_run(name):
    path = FOLDER / f"{name}.ipynb"
    notebook = read_notebook(path)
    nbformat.validate(notebook)
    assert path.stat().st_size < MOST_BYTES
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = outputs_of(notebook)
    kinds = {output.output_type for output in outputs}
    assert "stream" in kinds and kinds & {"display_data", "execute_result"}
    assert "error" not in kinds
    text = json.dumps([o.get("text", "") for o in outputs])
    assert not re.search(r"/(home|root|tmp|Users)/", text)  # of the machine it ran on
    assert not re.search(r"\bnan\b|Traceback|Warning", text)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_explains_and_calls(name):
    """Text leads, one cell holds the parameters, and what is worth a function is in quadjax."""
    cells = read_notebook(FOLDER / f"{name}.ipynb").cells
    assert cells[0].cell_type == "markdown" and cells[0].source.startswith("# ")
    assert sum("parameters" in cell.metadata.get("tags", []) for cell in cells) == 1
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    assert not re.search(r"^\s*(def|class) ", code, re.MULTILINE)


def notebook_of(*sources: str) -> nbformat.NotebookNode:
    made = nbformat.v4.new_notebook()
    made.cells = [nbformat.v4.new_code_cell(source) for source in sources]
    return made


def test_an_error_is_told_with_its_cell(tmp_path):
    notebook = notebook_of("import quadjax", "1 / 0", "print('never')")
    with pytest.raises(InputError, match="ZeroDivisionError") as caught:
        execute(notebook, tmp_path)
    assert "1 / 0" in str(caught.value) and "\x1b" not in str(caught.value)


def test_parameters_are_replaced(tmp_path):
    notebook = notebook_of("A = 1", "print(A)")
    with pytest.raises(InputError, match="0 cells have the tag 'parameters'"):
        set_parameters(notebook, "A = 2")
    notebook.cells[0].metadata["tags"] = ["parameters"]
    set_parameters(notebook, "A = 2")
    execute(notebook, tmp_path)
    assert [output.text for output in outputs_of(notebook)] == ["2\n"]
    write_notebook(tmp_path / "a.ipynb", notebook)
    assert read_notebook(tmp_path / "a.ipynb") == notebook


@pytest.mark.parametrize("text", ["", "{}", "[1]", "not json"])
def test_what_is_no_notebook_is_refused(tmp_path, text):
    path = tmp_path / "a.ipynb"
    with pytest.raises(InputError, match="cannot be read"):
        read_notebook(path)
    path.write_text(text)
    with pytest.raises(InputError, match="is no notebook"):
        read_notebook(path)
