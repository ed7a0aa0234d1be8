"""The executed notebooks as pages of the site: text, code, output and pictures."""

import base64
import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
LONGEST = 60  # lines of an output


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page ``notebooks/NAME.md`` for each notebook, and its pictures."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        text, pictures = page_of(json.loads(path.read_text(encoding="utf-8")), path.stem)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=picture))
    return files


def page_of(notebook: dict[str, Any], name: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by file name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source.replace("](../docs/", "](../"))
            continue
        parts.append(_block("python", source))
        printed = ""
        for output in cell["outputs"]:
            data = output.get("data", {})
            for kind in ("image/png", "image/gif"):
                if kind in data:
                    file = f"{name}_{len(pictures) + 1}.{kind.partition('/')[2]}"
                    pictures[file] = base64.b64decode(data[kind])
                    parts += [_block("text", printed)] * bool(printed) + [f"![Output]({file})"]
                    printed = ""
                    break
            else:
                printed += "".join(output.get("text", data.get("text/plain", "")))
        parts += [_block("text", printed)] * bool(printed.strip())
    parts.insert(1, f"Notebook: `notebooks/{name}.ipynb`.")
    return "\n\n".join(parts) + "\n", pictures


def _block(language: str, text: str) -> str:
    lines = text.strip("\n").splitlines()
    if language == "text" and len(lines) > LONGEST:
        lines = [*lines[:LONGEST], f".. {len(lines) - LONGEST} more lines"]
    return "\n".join([f"````{language}", *lines, "````"])
