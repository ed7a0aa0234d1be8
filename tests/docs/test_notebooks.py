"""Every notebook runs from its first cell to its last, and those in the repository have run."""

import ast
import json
import re
import runpy

import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")

from tests.docs.notebooks import (  # noqa: E402
    NOTEBOOKS,
    ROOT,
    code_of,
    execute,
    inputs_of,
    parameters_of,
    read,
    stamp,
    stamped,
)
from tests.docs.smaller import WIDE  # noqa: E402
from tests.surface.names import LIBRARIES, inner_names  # noqa: E402
from tests.surface.short import OF_EACH  # noqa: E402

MAX_BYTES = 2_000_000
SHORT = [word for word in OF_EACH if not word.startswith("run.steps=")]  # of any learner
SMALL = {
    "e2e_vs_indi": [
        'E2E, INDI = "e2e_cyberzoo", "indi_cyberzoo"',
        "DRONES, RUNS, LAPS, SEED = 2, 2, 1, 0",
        'T_MAX, RATES, CUTOFF, PLANT, CHARGE, DELAY = 20, 2.0, 12.0, "cyberzoo", 0.9, 0.001',
        "NOISE, YOURS = False, None",
    ],
    "logs_to_c": [
        'FIT = ["residual.epochs=3"]',
        # A residual of three epochs is zero, so its schedule would have no effect.
        f"OVERRIDES = {[*SHORT, 'schedules.vehicle.residual_gain=null']}",
        "FLIGHTS, LAPS, STEPS = 1, 1, 512",
        "ROLL, THRUST, RUNS, SEED = (0.0,), (1.0,), 2, 0",
        f'EXPORT = {{"allow_unfinished": True, "ranges": {WIDE}}}',
        'VERIFY = "--vectors 100 --allow-unfinished"',
    ],
    "reproduce_paper": [
        'AUTHORS, STEPS = "nowhere", {"E2E": 512, "INDI": 512}',
        f"OVERRIDES = {SHORT}",
        "RUNS, LAPS, SEED = 2, 1, 0",
    ],
    "train": [
        "STEPS, SEED, RUNS = 512, 0, 1",
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
def test_the_stored_outputs_are_complete_and_of_the_present_inputs(path):
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
    assert stamped(notebook) == stamp(notebook), (
        f"{path.name} is stale: its code, or a config or policy that it uses, has changed since it "
        "was executed; run make notebooks"
    )


@by_name
def test_it_explains_and_calls_public_functions(path):
    notebook = read(path)
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    assert parameters_of(notebook).cell_type == "code"
    code = "\n".join(code for code in code_of(notebook) if not code.startswith("%%"))
    tree = ast.parse(re.sub(r"^%.*$", "", code, flags=re.MULTILINE))
    assert not any(isinstance(node, ast.FunctionDef | ast.ClassDef) for node in ast.walk(tree))
    assert not inner_names(tree, LIBRARIES | {"matplotlib", "IPython"})


@by_name
def test_its_page_has_its_text_and_pictures(path):
    pytest.importorskip("mkdocs")
    page_of = runpy.run_path(str(ROOT / "docs" / "notebook_pages.py"))["page_of"]
    text, pictures = page_of(json.loads(path.read_text(encoding="utf-8")), path.stem)
    assert text.startswith("# ") and "](../docs" not in text
    assert set(re.findall(r"^!\[Output\]\((.+)\)$", text, re.MULTILINE)) == set(pictures)
    assert len(pictures) > 1 and all(data[1:4] == b"PNG" for data in pictures.values())
    for cell in read(path).cells:
        assert cell.source.splitlines()[-1].replace("](../docs/", "](../") in text


def test_what_makes_a_notebook_stale(tmp_path):
    (tmp_path / "configs").mkdir()
    part = tmp_path / "configs" / "part.yaml"
    for name, text in (("race", "base: part\n"), ("part", "steps: 1\n"), ("unused", "steps: 1\n")):
        (tmp_path / "configs" / f"{name}.yaml").write_text(text)

    def notebook(code='load("race")'):
        return nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])

    for code in ('load("race")', "%%sh\nquadjax train race --name x"):
        inputs = inputs_of(notebook(code), tmp_path)
        assert set(inputs) == {"configs/race.yaml", "configs/part.yaml"}
    first = stamp(notebook(), tmp_path)
    part.write_text("# a comment\nsteps: 1\n")
    assert stamp(notebook(), tmp_path) == first != stamp(notebook('load("race", 2)'), tmp_path)
    part.write_text("steps: 2\n")
    assert stamp(notebook(), tmp_path) != first
