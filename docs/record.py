"""Record a page of ``quadjax view`` as an animated WebP, frame by frame, in headless Chromium.

python docs/record.py docs/gallery/paper_track.json docs/images/race.webp
"""

import argparse
import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from quadjax.core.files import read_json
from quadjax.view.page import write_page

OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("record", type=Path, help="of quadjax view --output FILE.json")
    parser.add_argument("output", type=Path, help=".webp")
    parser.add_argument("--start", type=float, default=2.0, help="s")
    parser.add_argument("--seconds", type=float, default=4.5)
    parser.add_argument("--rate", type=float, default=12.0, help="frames per second")
    parser.add_argument("--turn", type=float, default=40.0, help="of the camera in all, deg")
    parser.add_argument("--size", type=int, nargs=2, default=(840, 472), help="px")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "flights.html"
        write_page(page, read_json(options.record))
        frames = list(_frames(page, options))
    frames[0].save(
        options.output,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / options.rate),
        loop=0,
        quality=62,
        method=3,
    )
    size = options.output.stat().st_size / 2**20
    print(f"{options.output}: {len(frames)} frames, {size:.2f} MiB")


def _frames(page: Path, options: argparse.Namespace) -> Iterator[Image.Image]:
    """Pictures of the scene without the panel, at equal steps of time."""
    count = round(options.seconds * options.rate)
    with sync_playwright() as playwright:
        path = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=list(OPTIONS))
        width, height = options.size
        tab = browser.new_page(
            viewport={"width": width, "height": height + 46}, color_scheme="dark"
        )
        tab.goto(page.as_uri())
        tab.wait_for_timeout(1500)
        tab.evaluate(
            "() => { const v = quadjax.viewer; v.clock.play(false); v.togglePanel(false);"
            "document.querySelector('.stage nav').hidden = true;"
            "v.magnify(); v.toggleSight(); }"
        )
        tab.wait_for_timeout(300)
        for index in range(count):
            time = options.start + index / options.rate
            angle = options.turn * (index / count - 0.5)
            tab.evaluate(
                "([time, angle]) => { const v = quadjax.viewer, c = v.cameras;"
                "c.reset(); c.touched = true; c.camera.position.sub(c.controls.target);"
                "const a = angle * Math.PI / 180, { x, z } = c.camera.position;"
                "c.camera.position.x = 0.92 * (x * Math.cos(a) - z * Math.sin(a));"
                "c.camera.position.z = 0.92 * (x * Math.sin(a) + z * Math.cos(a));"
                "c.camera.position.y *= 0.92; c.camera.position.add(c.controls.target);"
                "c.controls.update(); v.clock.seek(time); v.draw(); }",
                [time, angle],
            )
            tab.wait_for_timeout(60)
            shot = tab.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height})
            yield Image.open(io.BytesIO(shot)).convert("RGB")
        browser.close()


if __name__ == "__main__":
    main()
