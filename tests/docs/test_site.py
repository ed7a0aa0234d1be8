"""The documentation builds from its extra alone, without a warning, and needs no network."""

import re
import subprocess
import sys

import pytest

from tests.docs.pages import ROOT

pytest.importorskip("mkdocs")
EXTERNAL = re.compile(r"""<(?:script|link|img)[^>]+(?:src|href)=["']?(?:https?:)?//[^"' >]+""")


@pytest.mark.slow
def test_the_site_builds_and_is_offline(tmp_path):
    build = ["mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    command = [sys.executable, "-m", "tests.docs.only_extra", "docs", *build]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert "generates this page from the package" not in text, page  # the note in its place
        loaded = EXTERNAL.findall(text)
        assert not [tag for tag in loaded if "canonical" not in tag], page
