"""Flights as data and pages, without a browser."""

import base64
import hashlib
import html
import re
import sys
import types
import webbrowser
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.flights.files import lap_times
from quadjax.flights.flight import vehicle_signals
from quadjax.vehicle.registry import MODELS
from quadjax.view.data import MISSING, encoded
from quadjax.view.page import ASSETS, frame, page, show
from tests.view.scenes import circle, scene

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def test_a_page_is_small_and_loads_nothing_but_its_own_script_and_style():
    text = page(scene(circle("one")))
    head = text.split("<script>")[0]
    assert "three.js authors" in text  # its license, MIT
    assert len(text.encode()) < 3e6
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", head)
    assert "default-src 'none'" in head and "connect-src 'none'" in head
    assert "unsafe" not in text.split("<style>")[0]
    for kind, body in (
        ("script", text.rpartition("<script>")[2].partition("</script>")[0]),
        ("style", re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]),
    ):
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in head


def test_names_stay_text():
    record = scene(circle(HOSTILE, crash=HOSTILE, source={"note": HOSTILE}), title=HOSTILE)
    text = page(record)
    assert text.count("<script>") == 1 and "<img" not in text
    assert f"<title>{html.escape(HOSTILE)}</title>" in text
    assert frame(record).count("<") == 2  # of the iframe alone


def test_the_program_is_built_from_its_sources():
    sources = sorted((ROOT / "web" / "src").glob("*.js"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    built = (ASSETS / "viewer.js").read_text(encoding="utf-8")
    assert f"sources {digest}" in built, "run npm ci && npm run build in web/"
    assert "</script" not in built


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


def test_flights_that_cannot_be_shown_are_refused():
    one, other = circle("one"), circle("other")
    lost = one.map(lambda values: np.full_like(values, np.nan)).replace(name="lost")
    moved = (other.gates[0].replace(position=(9.0, 0.0, -1.0)), *other.gates[1:])
    for flights, words in (
        ((), "no flight to show"),
        ((lap_times("times", [3.0]),), "no flight to show, only lap times"),
        ((one.slice(slice(0, 1)),), "one: a flight of 1 samples"),
        ((lost,), "lost: position is missing or not finite"),
        ((one, other.replace(gates=moved)), "other: is on another track than one"),
    ):
        with pytest.raises(InputError, match=words):
            scene(*flights)


def test_commands_and_actuators_have_titles_of_their_vehicle():
    wanted = {
        "motor": ["commanded rotor speed", "rotor speed"],
        "rate": ["commanded body rates", "commanded thrust", "thrust"],
        "racing": ["motor command", "rotor speed"],
    }
    flight = circle("one")
    for name, titles in wanted.items():
        model = MODELS[name]
        sizes = (model.action_size, model.actuators.size)
        own = vehicle_signals(model, *(np.ones((len(flight.time), size)) for size in sizes))
        (record,) = scene(flight.replace(signals=flight.signals | own))["flights"]
        shown = [signal["title"] for signal in record["signals"] if "title" in signal]
        assert shown == [*titles, "body rates"]
        turning = [signal["title"] for signal in record["signals"] if "turns_per_second" in signal]
        assert turning == [title for title in titles if "speed" in title]


def test_show_opens_a_page_or_displays_a_frame_in_notebooks(monkeypatch, tmp_path):
    opened, displayed = [], []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    show(scene(circle("one")), tmp_path / "flights.html")
    assert opened == [(tmp_path / "flights.html").as_uri()]
    assert "quadjax-flights/1" in (tmp_path / "flights.html").read_text(encoding="utf-8")
    shell = types.SimpleNamespace(kernel=object())
    screen = types.SimpleNamespace(HTML=str, display=displayed.append)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", screen)
    show(scene(circle("one")))
    assert displayed[0].startswith("<iframe srcdoc=") and 'sandbox="allow-scripts"' in displayed[0]
