"""The tests of this folder survive a change of structure: they name no inner module."""

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
PUBLIC = {"quadjax", "quadjax.integrations.gym"}


def imports(path: Path) -> set[str]:
    """Modules of quadjax that a file imports, itself or by a module of the tests."""
    names, own = set(), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    for name in names:
        if name.startswith("tests."):
            own |= imports(ROOT / (name.replace(".", "/") + ".py"))
        elif name.partition(".")[0] == "quadjax":
            own.add(name)
    return own


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_no_inner_module(path):
    assert imports(path) <= PUBLIC
