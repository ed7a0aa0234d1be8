"""Execute notebooks in place and keep their outputs.

usage: python scripts/notebooks.py [NOTEBOOK.ipynb ...]

Without names it takes every notebook of notebooks/. One that ends with an error is left as it was.
"""

import argparse
import sys
import time
from pathlib import Path

from quadjax.cli.arguments import Parser, parse
from quadjax.core.errors import InputError, command_line

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="NOTEBOOK.ipynb")
    return parse(parser)


@command_line
def main() -> int:
    """Execute, write, and say how long each took."""
    paths = _arguments().notebooks or sorted(FOLDER.glob("*.ipynb"))
    from quadjax.cli.notebooks import execute, read_notebook, write_notebook

    failed = 0
    for path in paths:
        notebook, started = read_notebook(path), time.monotonic()
        try:
            execute(notebook, path.parent)
        except InputError as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            failed += 1
            continue
        write_notebook(path, notebook)
        print(f"{path.name}: {time.monotonic() - started:.0f} s", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    main()
