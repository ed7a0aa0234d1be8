"""The Markdown pages of the project and the code blocks in them."""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES += [ROOT / "quadjax" / "pretrained" / "README.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
GUIDE = [ROOT / "README.md", ROOT / "docs" / "index.md"]
GUIDE += sorted((ROOT / "docs" / "getting_started").glob("*.md"))
GUIDE += sorted((ROOT / "docs" / "guide").glob("*.md"))

_FENCE = re.compile(r"^( *)```(\w*)(.*)$")
_TITLE = re.compile(r'title="([^"]+)"')
_SNIPPET = re.compile(r'^--8<-- "([^"]+)"$', re.MULTILINE)
_DIRECTIVE = re.compile(r"<!-- test: (\w+)(?:: (.*?))?\s*-->", re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: Path
    line: int  # its first one, from 1
    language: str
    title: str  # the file that the block shows, or ""
    code: str
    skipped: str  # why it is not run, or ""
    setup: str  # Python code that is run before it


def name_of(page: Path) -> str:
    """A page's path in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page, with what the comments before them say.

    A line ``--8<-- "FILE"`` is replaced by that file of the repository, as MkDocs does.
    ``<!-- test: skip: REASON -->``, ``<!-- test: needs: MODULE -->``, which skips the block where
    the module is not installed, and ``<!-- test: setup: CODE -->`` apply to the next block.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    blocks: list[Block] = []
    opened, start, since = None, 0, 0
    for number, line in enumerate(lines):
        if not (fence := _FENCE.match(line)):
            continue
        if opened is None:
            opened, start = fence, number
            continue
        indent, language, title = opened.groups()
        code = "\n".join(text[len(indent) :] for text in lines[start + 1 : number]) + "\n"
        code = _SNIPPET.sub(lambda match: (ROOT / match[1]).read_text("utf-8").rstrip("\n"), code)
        said = dict(_DIRECTIVE.findall("\n".join(lines[since:start])))
        named = _TITLE.search(title)
        if (module := said.get("needs")) and importlib.util.find_spec(module) is None:
            said["skip"] = f"{module} is not installed"
        rest = (code, said.get("skip", ""), said.get("setup", ""))
        blocks.append(Block(page, start + 1, language, named[1] if named else "", *rest))
        opened, since = None, number + 1
    assert opened is None, f"{page}: the block of line {start + 1} has no end"
    return blocks
