"""The Markdown pages of the project and the code blocks in them."""

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
    """A fenced block.

    Attributes:
        page: its file.
        line: its first line, from 1.
        language: the word after the fence.
        title: the file that the block shows, or "".
        code: its text.
        skipped: why it is not run, or "".
        setup: Python code that is run before it.
    """

    page: Path
    line: int
    language: str
    title: str
    code: str
    skipped: str
    setup: str


def name_of(page: Path) -> str:
    """A page's path in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page, with what the comments before them say.

    A line ``--8<-- "FILE"`` is replaced by that file of the repository, as MkDocs does.
    ``<!-- test: skip: REASON -->`` and ``<!-- test: setup: CODE -->`` apply to the next block.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    blocks: list[Block] = []
    start, since = None, 0
    for number, line in enumerate(lines):
        fence = _FENCE.match(line)
        if not fence:
            continue
        if start is None:
            start, opened = number, fence
            continue
        indent = len(opened.group(1))
        code = "\n".join(text[indent:] for text in lines[start + 1 : number]) + "\n"
        code = _SNIPPET.sub(lambda match: (ROOT / match[1]).read_text("utf-8").rstrip("\n"), code)
        said = dict(_DIRECTIVE.findall("\n".join(lines[since:start])))
        title = _TITLE.search(opened.group(3))
        blocks.append(
            Block(
                page=page,
                line=start + 1,
                language=opened.group(2),
                title=title.group(1) if title else "",
                code=code,
                skipped=said.get("skip", ""),
                setup=said.get("setup", ""),
            )
        )
        start, since = None, number + 1
    assert start is None, f"{page}: the block of line {start} has no end"
    return blocks
