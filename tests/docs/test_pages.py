"""Form of the Markdown pages: line lengths, tables, links and anchors."""

import re

import pytest

from tests.docs.pages import PAGES, ROOT, blocks_of, name_of

MAX_LINE, MAX_COLUMNS, MAX_README = 100, 7, 120
# By docs/hooks.py.
GENERATED = {
    *(f"docs/reference/{name}.md" for name in ("config", "commands", "sil_messages")),
} | {f"docs/gallery/{path.stem}.html" for path in (ROOT / "docs" / "gallery").glob("*.json")}
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)


def anchors_of(text: str) -> set[str]:
    """The ids that headings get: as Python-Markdown's ``slugify`` makes them."""
    titles = re.findall(r"^#+ +(.+?)\s*$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    plain = (re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in titles)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", t).strip().lower()) for t in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_lines_and_tables_are_narrow(page):
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        assert len(line) <= MAX_LINE, f"{name_of(page)}:{number} has {len(line)} characters"
        if line.startswith("|"):
            columns = line.replace(r"\|", "").count("|") - 1
            assert columns <= MAX_COLUMNS, f"{name_of(page)}:{number} has {columns} columns"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    text = CODE.sub("", page.read_text(encoding="utf-8"))
    for target in LINK.findall(text):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if file.is_relative_to(ROOT) and file.relative_to(ROOT).as_posix() in GENERATED:
            continue
        assert file.exists(), f"{name_of(page)}: {target}"
        if anchor and file.suffix == ".md" and not anchor.startswith("quadjax."):
            assert anchor in anchors_of(file.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_of_the_repository_exist(page):
    text = page.read_text(encoding="utf-8")
    for path in re.findall(r"(?<![\w/.])(?:examples|quadjax|scripts|tests)/[\w/]+\.py", text):
        assert (ROOT / path).is_file(), f"{name_of(page)}: {path}"


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_blocks_name_their_language(page):
    for block in blocks_of(page):
        assert block.language, f"{name_of(page)}:{block.line}: a fence without a language"
