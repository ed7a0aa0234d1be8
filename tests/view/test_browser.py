"""Pages of flights in a real browser."""

import io
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from quadjax.flights.files import lap_times
from quadjax.view.page import frame, write_page
from tests.view.browser import DESK, PHONE, browser, opened, wait_until
from tests.view.scenes import AHEAD, RADIUS, circle, scene

pytestmark = pytest.mark.slow
fixtures = (browser,)
RACE = scene(
    circle("fast", lap=2.5),
    circle("slow", lap=3.0, offset=0.2),
    circle("lost", lap=2.8, laps=1, crash="hit a gate"),
    lap_times("published", [2.9, 2.9]),
)
ONE = scene(circle("one", lap=4.0))
# NED to the axes of three.js: north to x, down to -y, east to z.
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
VIEWS = ("orbit", "chase", "on-board", "top")


@pytest.fixture
def open_scene(browser, tmp_path):
    """Write a scene as a page and open it from disk."""

    @contextmanager
    def opening(scene, **options):
        path = tmp_path / "flights.html"
        write_page(path, scene)
        with opened(browser, path.as_uri(), offline=True, **options) as page:
            yield page

    return opening


def picture(page) -> np.ndarray:
    """The 3D view (height, width, 3), settled."""
    page.page.wait_for_timeout(300)
    shot = page.page.locator("canvas.world").screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), np.float64)


def drawn(image: np.ndarray) -> np.ndarray:
    """Where (height, width) a picture has other colors than its commonest one."""
    colors, counts = np.unique(image.reshape(-1, 3), axis=0, return_counts=True)
    return np.abs(image - colors[counts.argmax()]).sum(axis=2) > 60


def test_a_page_plays_without_network_and_obeys_keys_and_buttons(open_scene):
    with open_scene(RACE) as page:
        assert [url.split(":")[0] for url in page.requests] == ["file"]
        wait_until(page.page, "quadjax.viewer.clock.time > 0.2")
        assert page.state()["playing"]
        assert page.page.inner_text("h1") == "Circle"
        assert page.page.inner_text("tbody tr.selected .label") == "fast"
        press, control = page.page.keyboard.press, page.page.get_by_label
        page.still(1.0)
        press("ArrowRight")
        assert page.state()["time"] == pytest.approx(1.02)
        press("Shift+ArrowLeft")
        assert page.state()["time"] == pytest.approx(0.52)
        press("ArrowDown")
        assert page.state()["rate"] == 0.5
        for key, view in zip("1234", VIEWS, strict=True):
            press(key)
            assert page.state()["view"] == view
        press("n")
        wait_until(page.page, "document.querySelector('tr.selected .label').textContent == 'slow'")
        press(" ")
        assert page.state()["playing"]
        press(" ")
        press("0")
        assert not page.state()["playing"] and page.state()["time"] == 0.0
        before = page.page.get_attribute("html", "data-theme")
        press("t")
        assert page.page.get_attribute("html", "data-theme") != before
        control("time", exact=True).fill("3.1")
        assert page.state()["time"] == pytest.approx(3.1)
        control("playback speed").select_option("0.1")
        assert page.state()["rate"] == 0.1
        page.page.get_by_role("button", name="on-board").click()
        control("field of view").fill("70")
        assert page.do("return viewer.cameras.fieldOfView") == 70
        assert page.page.locator(".lens").is_visible()
        assert page.page.locator(".ticks .marker").count() == 2


def test_positions_and_attitudes_agree_with_float64(open_scene):
    with open_scene(ONE) as page:
        for time in (0.0, 0.537, 2.004, 8.0):
            (drone,) = page.state(time)["drones"]
            angle = 2.0 * np.pi * time / 4.0 + AHEAD
            place = np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), -1.5])
            np.testing.assert_allclose(drone["position"], AXES @ place, atol=1e-3)
            euler = [angle + np.pi / 2, 0.3, 0.5 * np.sin(angle)]
            turn = AXES @ Rotation.from_euler("ZYX", euler).as_matrix() @ AXES.T
            shown = Rotation.from_quat(drone["attitude"]).as_matrix()
            np.testing.assert_allclose(shown, turn, atol=1e-3)


def test_the_field_of_view_of_the_camera(open_scene):
    with open_scene(ONE) as page:
        page.still(2.0)
        wait_until(page.page, "quadjax.viewer.state().sight")
        (drone,), corners = page.state()["drones"], page.state()["corners"]
        rays = np.array([corner["place"] for corner in corners]) - drone["position"]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        middle = rays.sum(axis=0) / np.linalg.norm(rays.sum(axis=0))
        turn = Rotation.from_quat(drone["attitude"])
        tilt = np.radians(page.do("return viewer.cameras.tilt"))
        forward = turn.apply([np.cos(tilt), np.sin(tilt), 0.0])  # x forward, y up
        np.testing.assert_allclose(middle, forward, atol=1e-5)
        right = np.abs(rays @ turn.apply([0.0, 0.0, 1.0])) / (rays @ forward)
        np.testing.assert_allclose(right, np.tan(np.radians(50.0)), rtol=1e-4)
        page.page.keyboard.press("f")
        wait_until(page.page, "!quadjax.viewer.state().sight")
        for size in (DESK, PHONE):
            page.page.set_viewport_size({"width": size[0], "height": size[1]})
            page.page.keyboard.press("3")
            page.page.wait_for_timeout(500)
            box = page.page.locator(".picture").bounding_box()
            assert box["width"] / box["height"] == pytest.approx(4 / 3, rel=0.02)
            view = page.page.locator("canvas.world").bounding_box()
            share = [box["width"] / view["width"], box["height"] / view["height"]]
            screen = np.array([corner["screen"][:2] for corner in page.state()["corners"]])
            np.testing.assert_allclose(np.abs(screen), np.tile(share, (4, 1)), atol=0.02)
        assert "100° × 84°" in page.page.inner_text(".picture")


def test_the_panel_shows_order_gap_laps_and_clearance(open_scene):
    with open_scene(RACE) as page:
        page.still(4.0)
        page.page.get_by_role("button", name="slow").click()
        # At the same angle, the slower one is 3.0 / 2.5 times as long under way.
        wait_until(page.page, "document.querySelector('.numbers').innerText.includes('+')")
        gap = page.do(
            "return Number(document.querySelector('.numbers').innerText.match(/\\+([\\d.]+)/)[1])"
        )
        assert gap == pytest.approx(4.0 - 4.0 * 2.5 / 3.0, abs=0.1)
        assert page.state()["order"][0] == "fast"
        assert "hit a gate" in page.page.locator("section table tbody").first.inner_text()
        assert "3.00 s" in page.page.inner_text(".laps")
        assert "gate 1: 0.40 m" in page.page.inner_text(".gates")


@pytest.mark.parametrize(("scheme", "size"), [("dark", DESK), ("light", PHONE)])
def test_every_view_and_control_is_on_the_screen(open_scene, scheme, size):
    with open_scene(RACE, scheme=scheme, size=size) as page:
        page.still(1.3)
        for control in [*page.page.get_by_role("button").all(), page.page.get_by_label("time")]:
            if not control.is_visible() or control.get_attribute("role") == "button":
                continue
            box = control.bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= size[0] + 1
        assert page.do("return document.documentElement.scrollWidth") <= size[0]
        shown = []
        for view in VIEWS:
            page.do(f"viewer.setView('{view}')")
            image = picture(page)
            assert 0.005 < drawn(image).mean() < 0.9
            assert (image.mean() < 100) == (scheme == "dark")
            assert all((drawn(image) != other).mean() > 0.005 for other in shown)
            shown.append(drawn(image))


def test_ten_megabytes_of_flights(open_scene):
    many = scene(*(circle(f"flight {k}", lap=3.0 + 0.01 * k, laps=6) for k in range(90)))
    assert len(str(many)) > 9e6
    with open_scene(many) as page:
        assert len(page.state(5.0)["drones"]) == 90
        page.still(5.0)
        assert drawn(picture(page)).mean() > 0.005


def test_from_above_the_drones_are_where_they_fly(open_scene):
    with open_scene(ONE, scheme="light") as page:
        page.do("viewer.setView('top'); viewer.setTrail(0); viewer.toggleLabels()")
        pictures = []
        for quarter in range(4):  # north, east, south, west
            page.still(quarter - 2 * AHEAD / np.pi + 4.0)
            pictures.append(picture(page))
        still = np.median(pictures, axis=0)
        height, width = still.shape[:2]
        for image, ahead in zip(pictures, ((1, 0), (0, 1), (-1, 0), (0, -1)), strict=True):
            y, x = np.nonzero(np.abs(image - still).sum(axis=2) > 90)
            place = np.array([np.median(x) - width / 2, np.median(y) - height / 2])
            assert place @ ahead > 0.8 * np.linalg.norm(place) > 60


NAME = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>"
HOSTILE = scene(circle(NAME, crash=NAME, source={"note": NAME}), lap_times(NAME, [1]), title=NAME)


def test_hostile_names_are_shown_as_text(open_scene):
    with open_scene(HOSTILE) as page:
        page.still(6.0)
        assert page.page.inner_text("h1") == page.page.title() == NAME
        assert NAME in page.page.inner_text("section table")
        assert page.do("return window.hacked") is None
        assert page.do("return document.images.length") == 0


def test_a_notebook_shows_the_page_in_a_frame(browser, tmp_path):
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><p>cell</p>{frame(HOSTILE)}", encoding="utf-8")
    page = browser.new_page()
    page.goto(path.as_uri())
    inner = page.frames[1]
    wait_until(inner, "window.quadjax?.viewer?.clock.time > 0")
    assert inner.inner_text("h1") == NAME
    for one in page.frames:
        assert one.evaluate("[window.hacked ?? 0, document.images.length]") == [0, 0]
    page.close()


def test_without_webgl_the_page_says_so(browser, tmp_path):
    path = tmp_path / "flights.html"
    write_page(path, RACE)
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(path.as_uri())
    assert "WebGL 2" in page.inner_text(".message")
    page.close()
