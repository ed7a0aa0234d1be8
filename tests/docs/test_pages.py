"""Form of the Markdown pages: line lengths, tables, links, anchors, files and blocks."""

import re

from tests.docs.pages import PAGES, ROOT, blocks_of, name_of

MAX_LINE, MAX_COLUMNS, MAX_README = 100, 7, 90
# By docs/hooks.py.
GENERATED = {
    f"docs/reference/{name}.md"
    for name in (
        *("config", "fit_config", "plant_config", "sweep_file", "vehicle_file"),
        *("conditions", "observation", "log_formats", "commands", "sil_messages"),
    )
} | {f"docs/gallery/{path.stem}.html" for path in (ROOT / "docs" / "gallery").glob("*.json")}
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
FILE = re.compile(r"(?<![\w/.])(?:examples|quadjax|scripts|tests)/[\w/]+\.py")
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}


def anchors_of(text: str) -> set[str]:
    """The ids that headings get: as Python-Markdown's ``slugify`` makes them."""
    titles = re.findall(r"^#+ +(.+?)\s*$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    plain = (re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in titles)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", t).strip().lower()) for t in plain}


def test_lines_and_tables_are_narrow():
    wide = []
    for page, text in TEXTS.items():
        for number, line in enumerate(text.splitlines(), 1):
            columns = line.replace(r"\|", "").count("|") - 1 if line.startswith("|") else 0
            if len(line) > MAX_LINE or columns > MAX_COLUMNS:
                wide.append(f"{name_of(page)}:{number}: {len(line)} characters, {columns} columns")
    assert not wide
    assert len(TEXTS[ROOT / "README.md"].splitlines()) <= MAX_README


def test_links_lead_somewhere():
    lost = []
    for page, text in TEXTS.items():
        for target in LINK.findall(CODE.sub("", text)):
            if "://" in target:
                continue
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            if file.is_relative_to(ROOT) and file.relative_to(ROOT).as_posix() in GENERATED:
                continue
            exists = file.exists()
            if exists and anchor and file.suffix == ".md" and not anchor.startswith("quadjax."):
                exists = anchor in anchors_of(file.read_text(encoding="utf-8"))
            if not exists:
                lost.append(f"{name_of(page)}: {target}")
    assert not lost


def test_files_of_the_repository_exist():
    named = [(page, path) for page, text in TEXTS.items() for path in FILE.findall(text)]
    assert len(named) > 10
    assert not [f"{name_of(page)}: {path}" for page, path in named if not (ROOT / path).is_file()]


def test_blocks_name_their_language():
    blocks = [block for page in PAGES for block in blocks_of(page)]
    assert len(blocks) > 50
    assert not [f"{name_of(b.page)}:{b.line}" for b in blocks if not b.language]
