"""The names that code may take from elsewhere: public ones, and those of a few libraries."""

import ast
import sys

import quadjax

LIBRARIES = {"jax", "numpy", "flax", "optax"}


def inner_names(tree: ast.Module, libraries: set[str] = LIBRARIES) -> set[str]:
    """What a module takes from elsewhere than the public names, libraries and Python's modules."""
    public = {f"quadjax.{name}" for name in quadjax.__all__} | {"quadjax"}
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "quadjax":
            names.add(f"quadjax.{node.attr}")
        elif isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            names.add(node.attr)
    allowed = libraries | sys.stdlib_module_names
    return {name for name in names if name.split(".")[0] not in allowed} - public
