"""The notebooks executed from outside: in place by ``make notebooks``, in copies by the tests.

Every notebook has one code cell with the tag ``parameters``. It holds plain assignments that say
how much is flown and trained, and a caller may give other ones in its place.
"""

import os
import re
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import write_text

try:
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError
    from nbformat import NotebookNode
except ImportError:
    raise InputError(
        "notebooks need nbclient and ipykernel, which are not installed: "
        "pip install -e '.[notebook]'"
    ) from None

TAG = "parameters"
CELL_SECONDS = 900  # after which a cell has hung
START_SECONDS = 300  # after which a kernel will not start; a busy machine takes its time
REPOSITORY = Path(__file__).resolve().parents[2]


def read_notebook(path: Path | str) -> NotebookNode:
    """A notebook from its file.

    Raises:
        InputError: no such file, or not a notebook.
    """
    try:
        return nbformat.read(path, as_version=4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (nbformat.reader.NotJSONError, nbformat.ValidationError, AttributeError) as error:
        reason = (str(error).splitlines() or ["empty"])[0]
        raise InputError(f"{path}: is no notebook ({reason})") from error


def write_notebook(path: Path | str, notebook: NotebookNode) -> None:
    """Write a notebook, whole."""
    write_text(path, nbformat.writes(notebook) + "\n")


def set_parameters(notebook: NotebookNode, source: str) -> None:
    """Put ``source`` in the place of the notebook's parameters.

    Raises:
        InputError: not exactly one cell has the tag.
    """
    tagged = [cell for cell in notebook.cells if TAG in cell.metadata.get("tags", [])]
    if len(tagged) != 1:
        raise InputError(f"{len(tagged)} cells have the tag {TAG!r}, expected one")
    tagged[0].source = source


def execute(notebook: NotebookNode, folder: Path | str) -> None:
    """Run every cell in a kernel of its own; the outputs are left in the notebook.

    The kernel imports the quadjax that this is. When and on what the cells ran is not kept, so that
    two executions differ only where their results do.

    Args:
        notebook: changed in place.
        folder: where its kernel starts.

    Raises:
        InputError: a cell ended with an error, took too long, or took the kernel with it; the
            message has the cell and what it said.
    """
    before = os.environ.get("PYTHONPATH")
    path = os.pathsep.join([str(REPOSITORY), *([before] if before else [])])
    client = NotebookClient(
        notebook,
        timeout=CELL_SECONDS,
        startup_timeout=START_SECONDS,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    )
    try:
        client.execute(env=os.environ | {"PYTHONPATH": path})
    except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
        raise InputError(re.sub(r"\x1b\[[0-9;]*m", "", str(error))) from error
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.validate(notebook)


def outputs_of(notebook: NotebookNode) -> list[NotebookNode]:
    """The outputs of every code cell, in order."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return [output for cell in cells for output in cell.outputs]
