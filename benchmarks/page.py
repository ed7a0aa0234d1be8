"""Frame rate, load time and size of pages, in headless Chromium's software renderer.

python -m benchmarks.page [NUMBER OF FLIGHTS ...]

Each page has flights of six laps and plays in the orbit view, at the size of a laptop with its
panel, and at that of a phone. Load time is from opening the file to the first frame.
"""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import psutil
from cyclopts import Parameter

from quadjax.cli import options, script
from quadjax.view.page import write_page
from tests.view.browser import OPTIONS, READY, wait_until
from tests.view.scenes import circle, scene

LAP, LAPS = 2.2, 6  # s
SIZES = ((1280, 800), (390, 844))  # px
MEASURE = """milliseconds => new Promise(resolve => {
  const viewer = window.quadjax.viewer, times = [];
  let drawing = 0, frames = 0;
  const draw = viewer.draw.bind(viewer);
  viewer.draw = () => {
    const start = performance.now(); draw(); drawing += performance.now() - start; frames++;
  };
  viewer.clock.seek(0); viewer.clock.play(true);
  const tick = now => {
    times.push(now);
    if (now - times[0] < milliseconds) return requestAnimationFrame(tick);
    const steps = times.slice(1).map((time, i) => time - times[i]).sort((a, b) => a - b);
    resolve({ rate: 1000 * steps.length / (now - times[0]), drawing: drawing / frames,
      late: steps[Math.floor(0.95 * steps.length)], ratio: viewer.state().pixelRatio,
      calls: viewer.stage.renderer.info.render.calls,
      triangles: viewer.stage.renderer.info.render.triangles });
  };
  requestAnimationFrame(tick);
})"""


def page(
    *counts: Annotated[options.Count, Parameter(name="FLIGHTS")],
    seconds: options.Positive = 8.0,
    page: options.ExistingFile | None = None,
) -> None:
    """Measure pages of some numbers of flights (default: 1, 3 and 20), or one page, at each size.

    Args:
        seconds: Duration of each measurement.
        page: Measure this page instead.
    """
    from playwright.sync_api import sync_playwright

    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=path, args=list(OPTIONS))
        for count in [0] if page else counts or (1, 3, 20):
            file = page or Path(folder) / f"{count}.html"
            if not page:
                flights = (circle(f"flight {k}", LAP + 0.02 * k, LAPS) for k in range(count))
                write_page(file, scene(*flights))
            measure(browser, file.resolve(), 1.0, SIZES[0])  # the first pages are slower
            for size in SIZES:
                figures = measure(browser, file.resolve(), seconds, size)
                print(f"{count or file.name} flights, {size[0]}x{size[1]}: {figures}", flush=True)
        browser.close()


def measure(browser, path: Path, seconds: float, size: tuple[int, int]) -> str:
    """The figures of one page, as text."""
    tab = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="dark")
    tab.goto(path.as_uri())
    wait_until(tab, READY)
    load = tab.evaluate("() => performance.getEntriesByName('first-frame')[0]?.startTime ?? NaN")
    tab.wait_for_timeout(2000)
    before = _seconds()
    figures = tab.evaluate(MEASURE, 1000 * seconds)
    used = 1000 * (_seconds() - before) / (figures["rate"] * seconds)
    tab.close()
    return (
        f"{figures['rate']:.1f} frames/s, 95% below {figures['late']:.0f} ms, "
        f"CPU {used:.0f} ms a frame, of it the page's own drawing {figures['drawing']:.1f} ms, "
        f"{figures['calls']} draw calls, "
        f"{figures['triangles']} triangles, pixel ratio {figures['ratio']:.2f}, "
        f"first frame after {load:.0f} ms, {path.stat().st_size / 2**20:.2f} MiB"
    )


def _seconds() -> float:
    """CPU time of the browser's processes, s: unlike the frame rate, it depends little on load."""
    times = [process.cpu_times() for process in psutil.Process().children(recursive=True)]
    return sum(each.user + each.system for each in times)


if __name__ == "__main__":
    script(page)
