"""The tests of this folder survive a change of structure: they name no inner module."""

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent


def imports(path: Path) -> set[str]:
    """Modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_no_inner_module(path):
    inner = {name for name in imports(path) if name.startswith(("quadjax.", "tests."))}
    assert inner <= {"tests.commands", "tests.surface.short", "quadjax.integrations.gym"}
