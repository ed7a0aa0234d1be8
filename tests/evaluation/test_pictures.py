"""Figures of flights: what is drawn where, to scale."""

import io

import numpy as np
import pytest
from PIL import Image

from quadjax.core.errors import InputError
from quadjax.core.plotting import save_figure
from quadjax.evaluation.figures import signals_figure, space_figure, trajectory_figure
from quadjax.flights.flight import Flight, vehicle_signals
from quadjax.race.track import GateSection
from quadjax.vehicle.registry import MODELS
from tests.view import scenes

GATES = [
    GateSection(position=(2.0, 0.0, -1.5), yaw_deg=90.0),
    GateSection(position=(-2.0, 0.0, -1.5), yaw_deg=270.0, size=(2.0, 1.0)),
]


def circle(model: str = "motor", seconds: float = 1.0, crash: str | None = None) -> Flight:
    """One lap of the scenes' circle by a vehicle."""
    flight, kind = scenes.circle("one", lap=seconds, laps=1, crash=crash), MODELS[model]
    sizes = (kind.action_size, kind.actuators.size)
    own = vehicle_signals(kind, *(np.full((len(flight.time), size), 9000.0) for size in sizes))
    return flight.replace(signals=flight.signals | own)


def pixels(figure) -> np.ndarray:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=60)
    return np.asarray(Image.open(stream).convert("RGB"))


def colors(image: np.ndarray) -> int:
    return len(np.unique(image.reshape(-1, 3), axis=0))


def test_the_trajectory_is_drawn_to_scale():
    figure = trajectory_figure([circle(crash="hit a gate")], GATES, "title")
    axes, beside = figure.axes[:2]
    assert axes.get_aspect() == beside.get_aspect() == 1.0
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # east is down, or the track were mirrored
    assert "east" in axes.get_ylabel() and "height" in beside.get_ylabel()
    assert "north" in beside.get_xlabel()
    assert beside.get_ylim()[0] <= 0.0 < 1.5 < beside.get_ylim()[1]  # from the ground up
    widths = [np.ptp(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2]
    assert max(widths) == pytest.approx(2.0) and 1.0 in np.round(widths, 6)
    flight = circle(seconds=0.02)
    still = flight.with_signals(velocity=0 * flight["velocity"])
    for drawn in (figure, trajectory_figure([still], GATES)):
        assert colors(pixels(drawn)) > 20


def test_gates_have_numbers_and_heights_where_they_differ():
    """Gates at one place share a label; on a level track there are no heights."""
    lower = GateSection(position=(2.0, 0.0, -3.25), yaw_deg=270.0)
    figure = trajectory_figure([circle()], [*GATES, lower])
    above = [text.get_text() for text in figure.axes[0].texts]
    assert above.count("1, 3") == above.count("1.5, 3.2 m") == above.count("1.5 m") == 1
    assert {"1", "2", "3"} <= {text.get_text() for text in figure.axes[1].texts}
    level = [text.get_text() for text in trajectory_figure([circle()], GATES).axes[0].texts]
    assert {"1", "2"} <= set(level) and not any("m" in text for text in level)


def test_a_legend_is_above_the_axes():
    figure = trajectory_figure([circle()], GATES, "title")
    figure.canvas.draw()
    legend = figure.axes[0].get_legend().get_window_extent()
    top = figure.axes[0].get_window_extent().y1
    assert top - 5 <= legend.y0 < legend.y1 < figure.bbox.y1


def test_tilted_and_round_gates_have_their_outline_from_both_sides():
    straight_down = GateSection(
        position=(2.0, 0.0, -1.5), pitch_deg=-90.0, shape="circle", size=(2.0, 2.0)
    )
    figure = trajectory_figure([circle()], [GATES[1], straight_down])
    above, side = ([np.array(line.get_data()).T for line in axes.lines] for axes in figure.axes[:2])
    rim = next(points for points in above if len(points) > 10)
    assert np.hypot(*(rim - [2.0, 0.0]).T) == pytest.approx(1.0)
    edge = next(points for points in side if len(points) == len(rim))
    assert np.ptp(edge, axis=0) == pytest.approx([2.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("model", ["motor", "rate"])
def test_signals_are_drawn_upwards_in_degrees_and_with_the_commanded_thrust(model):
    flight = circle(model)
    height, speed, attitude, rates, actuators = signals_figure(flight).axes
    np.testing.assert_allclose(height.lines[0].get_ydata(), -flight["position"][:, 2])
    np.testing.assert_allclose(speed.lines[0].get_ydata(), flight.speed)
    for line, angle in zip(attitude.lines, flight["attitude"].T, strict=False):
        drawn = np.radians(line.get_ydata())
        assert np.nanmax(np.abs(drawn)) <= np.pi and np.isnan(drawn).sum() < 4  # at jumps
        error = (drawn - angle + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(error[np.isfinite(error)], 0.0, atol=1e-9)
    np.testing.assert_array_equal(rates.lines[1].get_ydata(), flight["rates"][:, 1])
    assert len(actuators.lines) == (5 if model == "motor" else 3)  # with the end of the lap
    commanded = [line for line in actuators.lines if line.get_label() == "commanded"]
    assert len(commanded) == (model == "rate")


def test_figures_are_written_whole(tmp_path):
    figure = signals_figure(circle())
    for kind, head in (("png", b"PNG"), ("svg", b"<svg"), ("pdf", b"%PDF")):
        save_figure(figure, tmp_path / "new" / f"a.{kind}")
        assert head in (tmp_path / "new" / f"a.{kind}").read_bytes()[:400]
    assert len(list((tmp_path / "new").iterdir())) == 3
    for path, says in ((tmp_path / "a.nothing", "allowed"), ("/dev/null/a.png", "cannot be")):
        with pytest.raises(InputError, match=says):
            save_figure(figure, path)


def test_a_flight_in_space_has_its_gates_and_equal_scales():
    flight = circle()
    figure = space_figure([flight], GATES, "title")
    axes = figure.axes[0]
    limits = np.array([axes.get_xlim(), axes.get_ylim()[::-1], axes.get_zlim()])
    height = -flight["position"][:, 2]
    assert limits[2, 0] == 0.0 and limits[2, 1] > height.max()
    box = np.array(axes._box_aspect)
    np.testing.assert_allclose(box / box[0], np.ptp(limits, axis=1) / np.ptp(limits[0]))
    assert {text.get_text().strip() for text in axes.texts} >= {"1", "2"}
    assert colors(pixels(figure)) > 50
