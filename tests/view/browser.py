"""Headless Chromium for tests of the pages, by Playwright; without either the tests skip."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

DESK, PHONE = (1280, 720), (390, 844)
OPTIONS = (
    "--no-sandbox",  # for root, in a container
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
READY = "Boolean(window.quadjax?.viewer?.width > 0)"


@pytest.fixture(scope="module")
def browser():
    """A running Chromium."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=path, args=list(OPTIONS))
        yield chromium
        chromium.close()


def wait_until(page, condition, seconds: float = 600.0):
    """Wait for a condition of the page, whose policy forbids evaluating text."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(100)


class Page:
    """An open page, which collects its requests and what the console reports."""

    def __init__(self, page):
        self.page = page
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._console)
        page.on("request", lambda request: self.requests.append(request.url))

    def _console(self, message):
        # Chromium warns that reading the canvas back is slow in its software renderer.
        if message.type in ("error", "warning") and "GPU stall" not in message.text:
            self.errors.append(message.text)

    def do(self, code: str):
        """The value of JavaScript code, with ``viewer`` the viewer of the page."""
        return self.page.evaluate(f"() => {{ const viewer = window.quadjax.viewer; {code} }}")

    def state(self, time: float | None = None) -> dict:
        """The state of the viewer, at a time."""
        return self.do(f"return viewer.state({'' if time is None else time})")

    def still(self, time: float) -> None:
        """Pause at a time."""
        self.do(f"viewer.clock.play(false); viewer.clock.seek({time})")


@contextmanager
def opened(browser, address: str, size=DESK, scheme: str = "dark", **more) -> Iterator[Page]:
    """A page of a file or a server, without network; it must not report errors."""
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, color_scheme=scheme, **more
    )
    try:
        page = Page(context.new_page())
        page.page.goto(address)
        wait_until(page.page, READY)
        yield page
        assert not page.errors
    finally:
        context.close()
