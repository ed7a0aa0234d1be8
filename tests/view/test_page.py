"""Flights as data and pages, without a browser."""

import base64
import hashlib
import html
import json
import re
import sys
import types
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.view.data import MISSING, encoded
from quadjax.view.flight import passages
from quadjax.view.notebook import show
from quadjax.view.page import ASSETS, frame, page
from tests.view.scenes import AHEAD, GATES, HEIGHT, RADIUS, circle, scene

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def _data(text: str) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_a_page_is_small_and_refers_to_nothing_outside():
    text = page(scene(circle("one")).record())
    assert len(text.encode()) < 3e6
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", text.split("<script>")[0])
    assert "default-src 'none'" in text and "connect-src 'none'" in text


def test_the_policy_allows_exactly_the_script_and_the_style_of_the_page():
    text = page(scene(circle("one")).record())
    for kind, body in (
        ("script", text.rpartition("<script>")[2].partition("</script>")[0]),
        ("style", re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]),
    ):
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in text
    assert "unsafe" not in text.split("<style>")[0]


def test_names_stay_text():
    record = scene(circle(HOSTILE, crash=HOSTILE, note=HOSTILE), title=HOSTILE).record()
    text = page(record)
    assert _data(text)["flights"][0]["name"] == HOSTILE
    assert text.count("<script>") == 1 and "<img" not in text
    assert f"<title>{html.escape(HOSTILE)}</title>" in text
    assert frame(record).count("<") == 2  # of the iframe alone


def test_the_program_is_built_from_its_sources():
    sources = sorted((ROOT / "web" / "src").glob("*.js"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    built = (ASSETS / "viewer.js").read_text(encoding="utf-8")
    assert f"sources {digest}" in built, "run npm ci && npm run build in web/"
    assert "</script" not in built


def test_the_license_of_three_js_is_in_the_package_and_in_every_page():
    assert "MIT License" in (ASSETS / "three.LICENSE").read_text(encoding="utf-8")
    assert "three.js authors" in page(scene(circle("one")).record())


def test_encoded_columns_are_within_a_part_of_their_range():
    values = np.random.default_rng(0).normal(size=(500, 3)) * [1.0, 100.0, 0.0] + [0.0, 5.0, 7.0]
    values[3, 0] = np.nan
    record = encoded(values)
    integers = np.frombuffer(base64.b64decode(record["data"]), "<i2").reshape(-1, 3)
    decoded = np.array(record["offset"]) + np.array(record["scale"]) * integers
    assert integers[3, 0] == MISSING
    decoded[3, 0] = np.nan
    error, span = np.abs(decoded - values), np.nanmax(values, axis=0) - np.nanmin(values, axis=0)
    assert np.nanmax(error - span / 65534.0 * 0.51 - 1e-9) <= 0.0


def test_passages_of_a_circle_are_found_with_their_clearances():
    flight = circle("one", lap=4.0, laps=2, offset=0.1)
    times, gates, clearances = flight.passages.T
    np.testing.assert_allclose(times, np.arange(1, 9) - 2 * AHEAD / np.pi, atol=2e-3)
    np.testing.assert_array_equal(gates, [0, 1, 2, 3, 0, 1, 2, 3])
    # 0.1 m outwards: along the width of 1.2 m, in the second gate turned by 30 degrees.
    turned = 0.1 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    second = min(0.6 - turned[0], 0.45 - turned[1])
    np.testing.assert_allclose(clearances[:4], [0.45, second, 0.45, 0.5], atol=2e-3)


def test_targets_decide_where_a_gate_is_passed():
    flight = circle("one", laps=1, offset=2.0)
    assert not len(passages(flight.time, flight.position, GATES))
    when = 0.75 - 3.0 * AHEAD / (2.0 * np.pi)
    target = (flight.time > when).astype(int)
    ((time, gate, clear),) = passages(flight.time, flight.position, GATES, target)
    assert time == pytest.approx(when, abs=0.01)
    assert gate == 0
    assert clear == pytest.approx(0.6 - 2.0, abs=0.01)


def test_sparse_flights_are_resampled_on_their_curve():
    flight = circle("one", lap=4.0)
    sparse = slice(None, None, 20)  # 5 samples per second
    thin = type(flight)(
        "thin",
        flight.time[sparse],
        flight.position[sparse],
        flight.velocity[sparse],
        flight.attitude[sparse],
    )
    dense = thin.resampled()
    assert np.diff(dense.time).max() < 0.0101
    radius = np.linalg.norm(dense.position[:, :2], axis=1)
    np.testing.assert_allclose(radius, RADIUS, atol=1e-3)
    np.testing.assert_allclose(dense.position[:, 2], -HEIGHT, atol=1e-9)


def test_a_periodic_lap_is_repeated():
    lap = circle("best", lap=3.0, laps=1, periodic=True)
    three, plain = lap.repeated(3), circle("three", lap=3.0, laps=3)
    np.testing.assert_allclose(three.time, plain.time, atol=1e-9)
    np.testing.assert_allclose(three.position, plain.position, atol=1e-9)
    np.testing.assert_allclose(three.lap_ends, [3.0, 6.0, 9.0])
    np.testing.assert_allclose(three.passages, plain.passages, atol=2e-2)


def test_flights_that_cannot_be_shown_are_refused():
    flight = circle("one")
    with pytest.raises(InputError, match="no flight to show"):
        scene().record()
    short = type(flight)(
        "dot", np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)), Rotation.identity(1)
    )
    with pytest.raises(InputError, match="dot: a flight of 1 samples"):
        scene(short).record()
    lost = circle("lost", position=np.full_like(flight.position, np.nan))
    with pytest.raises(InputError, match="lost: a position is not finite"):
        scene(lost).record()


def test_show_opens_a_page_outside_of_notebooks(monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    show(scene(circle("one")).record(), tmp_path / "flights.html")
    assert opened == [(tmp_path / "flights.html").as_uri()]
    assert "quadjax-flights/1" in (tmp_path / "flights.html").read_text(encoding="utf-8")


def test_show_displays_a_frame_in_notebooks(monkeypatch):
    displayed = []
    shell = types.SimpleNamespace(kernel=object())
    screen = types.SimpleNamespace(HTML=str, display=displayed.append)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", screen)
    show(scene(circle("one")).record())
    assert displayed[0].startswith("<iframe srcdoc=") and 'sandbox="allow-scripts"' in displayed[0]
