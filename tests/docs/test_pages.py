"""Form of the Markdown pages: line lengths, tables, links, files and blocks.

Links to titles within ``docs/`` are checked by the build of the site, in ``test_site.py``.
"""

import fnmatch
import importlib
import json
import re

from tests.docs.pages import PAGES, ROOT, blocks_of, name_of

MAX_LINE, MAX_COLUMNS, MAX_README = 100, 7, 90
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
GENERATED = re.compile(r"<!-- test: generated: (\S+) -->")
FILE = re.compile(r"(?<![\w/.])(?:examples|quadjax|scripts|tests)/[\w/]+\.py")
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}


def test_lines_and_tables_are_narrow():
    wide = []
    for page, text in TEXTS.items():
        for number, line in enumerate(text.splitlines(), 1):
            columns = line.replace(r"\|", "").count("|") - 1 if line.startswith("|") else 0
            if len(line) > MAX_LINE or columns > MAX_COLUMNS:
                wide.append(f"{name_of(page)}:{number}: {len(line)} characters, {columns} columns")
    assert not wide
    assert len(TEXTS[ROOT / "README.md"].splitlines()) <= MAX_README


def test_links_lead_to_files_of_the_repository():
    """Also without the site; ``<!-- test: generated: PATTERN -->`` names files that it adds."""
    notebooks = {
        path: "".join(text for cell in cells_of(path) for text in cell)
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    }
    lost, generated = [], 0
    for page, text in (TEXTS | notebooks).items():
        patterns = GENERATED.findall(text)
        for target in LINK.findall(CODE.sub("", text)):
            path, _, anchor = target.partition("#")
            if "://" in target or target.startswith("mailto:"):
                continue
            if any(fnmatch.fnmatch(path, pattern) for pattern in patterns):
                generated += 1
                continue
            file = (page.parent / path).resolve() if path else page
            titles = re.findall(r"^#+ (.+)$", TEXTS.get(file, ""), re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", x).lower().replace(" ", "-") for x in titles}
            site = page.is_relative_to(ROOT / "docs")  # its build checks the anchors
            if not file.exists() or (anchor and not site and anchor not in anchors):
                lost.append(f"{name_of(page)}: {target}")
    assert not lost
    assert generated


def cells_of(notebook):
    """The lines of each cell of text."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell["source"] for cell in cells if cell["cell_type"] == "markdown"]


def test_files_of_the_repository_exist():
    named = [(page, path) for page, text in TEXTS.items() for path in FILE.findall(text)]
    assert len(named) > 10
    assert not [f"{name_of(page)}: {path}" for page, path in named if not (ROOT / path).is_file()]


def test_an_example_can_be_run_again():
    """Whatever it writes, it replaces."""
    for path in sorted((ROOT / "examples").glob("*.py")):
        for call in re.findall(r"quadjax\.(?:train|export_c)\((.*)\)", path.read_text("utf-8")):
            assert "overwrite=True" in call or "**options" in call, f"{path.name}: {call}"


def test_blocks_name_their_language():
    blocks = [block for page in PAGES for block in blocks_of(page)]
    assert len(blocks) > 50
    assert not [f"{name_of(b.page)}:{b.line}" for b in blocks if not b.language]


def test_the_way_through_the_code_names_what_exists():
    """CONTRIBUTING.md, from the command line to the compiled step."""
    text = TEXTS[ROOT / "CONTRIBUTING.md"]
    way = text.partition("## The way through the code")[2].partition("\n## ")[0]
    names = [x for x in re.findall(r"`([a-z_]+\.[\w.]+)`", way) if x != "reward.gate"]
    assert len(names) > 15
    for name in names:
        package, module, *rest = name.split(".")
        found = importlib.import_module(f"quadjax.{package}.{module}")
        for part in rest:
            assert hasattr(found, part), name
            found = getattr(found, part)
