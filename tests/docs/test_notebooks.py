"""Every notebook runs from its first cell to its last, and those in the repository have run."""

import json
import re

import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")

from tests.docs.notebooks import (  # noqa: E402
    NOTEBOOKS,
    execute,
    inputs_of,
    parameters_of,
    read,
    stamp,
    stamped,
)
from tests.surface.short import OF_EACH  # noqa: E402

MAX_BYTES = 2_000_000
SHORT = [word for word in OF_EACH if not word.startswith("run.steps=")]  # of any learner
SMALL = {
    "adaptation": [
        "ROLL, PITCH, THRUST, CHARGES = (0.0,), (0.03,), (1.0,), ()",
        'CONTENDERS = {"E2E": ("e2e", "e2e.npz")}',
        "RUNS, FLIGHTS, LAPS, SEED = 2, 1, 1, 0",
    ],
    "e2e_vs_indi": [
        "RUNS, LAPS, SEED, SHOWN_SECONDS = 2, 1, 0, 0.5",
        'CHANGES = {"E2E": (), "INDI": ()}',
    ],
    "fixed_point": ['POLICY, FLIGHTS, LAPS, VECTORS = "e2e.npz", 4, 1, 200'],
    "reproduce_paper": [
        'AUTHORS, STEPS = "nowhere", {"E2E": 512, "INDI": 512}',
        f"OVERRIDES = {SHORT}",
        "RUNS, LAPS, SEED = 2, 1, 0",
    ],
    "residual_fit": [
        "FLIGHTS, LAPS, SEED, LEAST_SECONDS = 2, 1, 0, 2.5",
        'SMALL = "seeds: 1, epochs: 3, mirror: off"',
        'OVERRIDES = ["residual={" + SMALL + "}"]',
    ],
    "train_and_tune": [
        "STEPS, SEED, RUNS = 512, 0, 2",
        'CHANGE = ("slow", ["learner.learning_rate=1e-4"])',
        f"OVERRIDES = {SHORT}",
    ],
}
by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.mark.slow
@by_name
def test_it_runs(path, tmp_path):
    notebook = read(path)
    parameters_of(notebook).source = "\n".join(SMALL[path.stem])
    execute(notebook, tmp_path)  # an error in a cell raises
    assert not list(tmp_path.iterdir()), "a notebook removes its files"


@by_name
def test_the_stored_outputs_are_complete(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert path.stat().st_size < MAX_BYTES
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    kinds = {output.output_type for output in outputs}
    assert "stream" in kinds and kinds & {"display_data", "execute_result"}
    assert "error" not in kinds
    text = json.dumps([output.get("text", "") for output in outputs])
    assert not re.search(r"/(home|root|tmp|Users)/", text), "a path of one machine"
    assert not re.search(r"\bnan\b|Traceback|Warning", text)


@by_name
def test_it_explains_and_calls(path):
    """Text leads, one cell holds the parameters, and functions are in the package."""
    notebook = read(path)
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    assert parameters_of(notebook).cell_type == "code"
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert not re.search(r"^\s*(def|class) ", code, re.MULTILINE)


@by_name
def test_the_stored_outputs_are_of_the_present_inputs(path):
    notebook = read(path)
    assert stamped(notebook) == stamp(notebook), (
        f"{path.name} is stale: its code, or a config or policy that it uses, has changed since it "
        "was executed; run make notebooks"
    )


def test_what_makes_a_notebook_stale(tmp_path):
    (tmp_path / "configs").mkdir()
    preset, part = tmp_path / "configs" / "race.yaml", tmp_path / "configs" / "part.yaml"
    preset.write_text("base: part\n")
    part.write_text("steps: 1\n")
    (tmp_path / "configs" / "unused.yaml").write_text("steps: 1\n")

    def notebook(code):
        return nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])

    own = notebook('load("race")')
    assert set(inputs_of(own, tmp_path)) == {"configs/race.yaml", "configs/part.yaml"}
    first = stamp(own, tmp_path)
    part.write_text("# a comment\nsteps: 1\n")
    assert stamp(own, tmp_path) == first
    part.write_text("steps: 2\n")
    assert stamp(own, tmp_path) != first
    part.write_text("steps: 1\n")
    assert stamp(notebook('load("race", 2)'), tmp_path) != first
