"""Text of C: templates with ``@name@`` in them, tables and comments."""

import re
from collections.abc import Iterable
from importlib import resources

import numpy as np

FIELD = re.compile(r"@([A-Za-z_0-9]+)@")
WIDTH = 100


def fill(template: str, values: dict[str, str]) -> str:
    """A template of this package with every ``@name@`` replaced.

    Raises:
        KeyError: the template has a field without a value.
    """
    text = resources.files("quadjax.export").joinpath("templates", template).read_text("utf-8")
    text = FIELD.sub(lambda match: values[match[1]], text)
    lines = [line.rstrip() for line in text.splitlines()]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)) + "\n"


def literal(value: int) -> str:
    """An int32 as C writes it; the most negative one has no literal of its own."""
    return str(value) if value > -(2**31) else "(-2147483647 - 1)"


def literal_64(value: int) -> str:
    """An int64 as C writes it."""
    if value > -(2**63):
        return f"INT64_C({value})"
    return "(-INT64_C(9223372036854775807) - 1)"


def wrapped(items: Iterable[str], indent: str = "    ") -> str:
    """Items with commas between them, in lines of at most ``WIDTH`` characters."""
    lines, line = [], indent
    for item in items:
        if len(line) + len(item) + 2 > WIDTH and line.strip():
            lines.append(line.rstrip())
            line = indent
        line += f"{item}, "
    lines.append(line.rstrip().removesuffix(","))
    return "\n".join(lines)


def table(kind: str, name: str, size: str, values: np.ndarray) -> str:
    """A ``static const`` table of one dimension."""
    write = literal_64 if kind == "int64_t" else literal
    body = wrapped(write(int(value)) for value in np.ravel(values))
    return f"static const {kind} {name}[{size}] = {{\n{body}}};\n"


def rows_table(kind: str, name: str, size: str, values: np.ndarray) -> str:
    """A ``static const`` table of two dimensions (rows, columns)."""
    write = (lambda v: f"UINT32_C({v})") if kind == "uint32_t" else literal
    rows = ",\n".join(
        "    {" + wrapped(map(write, row), "     ").strip() + "}" for row in values.tolist()
    )
    return f"static const {kind} {name}{size} = {{\n{rows}}};\n"


def comment(lines: Iterable[str]) -> str:
    """Lines as the inside of a block comment; nothing in them can end it."""
    return "\n".join(f" * {line.replace('*/', '* /')}".rstrip() for line in lines)


def string(text: str) -> str:
    """Text as a C string literal, printable ASCII only."""
    clean = "".join(c if 32 <= ord(c) < 127 else "?" for c in text)
    return '"' + clean.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?") + '"'


def identifier(text: str) -> str:
    """Text as a lower-case C identifier."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "policy"
    return name if name[0].isalpha() else f"policy_{name}"
