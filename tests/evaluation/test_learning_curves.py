"""Learning curves over seeds, from made-up metrics."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.plotting import save_figure
from quadjax.evaluation.curves import COLORS, learning_figure, spread
from tests.test_training import CONFIGS


def make_run(folder, times, seconds_each=10.0, config="e2e_ppo.yaml", overrides=()):
    """A run's folder with a row of metrics for each lap time, s."""
    write_text(folder / "config.yaml", load_config(CONFIGS / config, overrides).to_yaml())
    rows = [f"{500_000 * i},{seconds_each * i},{time}" for i, time in enumerate(times, 1)]
    write_text(folder / "metrics.csv", "\n".join(["steps,seconds,lap_total", *rows, ""]))
    return folder


def test_half_of_the_seeds_make_a_line_and_none_is_left_out():
    inf, nan = np.inf, np.nan
    along = [np.array([1.0, 2, 3, 4])] * 4
    times = [
        np.array([20.0, 18, 16, 14]),
        np.array([inf, 19, 17, 15]),
        np.array([inf, nan, 18, inf]),
        np.array([inf, inf, inf, inf]),
    ]
    points, median, lowest, highest = spread(along, times)
    np.testing.assert_array_equal(points, along[0])
    np.testing.assert_array_equal(median, [nan, 19, 17.5, 15])
    np.testing.assert_array_equal(lowest, [20, 18, 16, 14])
    np.testing.assert_array_equal(highest, [20, 19, 18, 15])
    median = spread(along[:3], times[:3])[1]
    np.testing.assert_array_equal(median, [nan, 19, 17, 15])
    np.testing.assert_array_equal(spread(along[:2], times[:2])[1], [20, 18.5, 16.5, 14.5])


def test_seeds_that_are_measured_at_other_times_keep_their_latest_one():
    seconds = [np.array([10.0, 20]), np.array([12.0, 30])]
    times = [np.array([15.0, 14]), np.array([17.0, 16])]
    points, median, lowest, highest = spread(seconds, times)
    assert points.tolist() == [10, 12, 20, 30]
    assert median.tolist() == [15, 16, 15.5, 15]
    assert lowest.tolist() == [15, 15, 14, 14] and highest.tolist() == [15, 17, 17, 16]


def test_groups_are_drawn_side_by_side_and_published_times_next_to_their_race_only(tmp_path):
    overrides = ["run.score=sampled"]
    e2e = [make_run(tmp_path / f"a{i}", [np.inf, 16.0 + i, 15.0 + i]) for i in range(3)]
    indi = [make_run(tmp_path / "b", [20.0, 17.5, 17.0], 25.0, "indi_table1.yaml", overrides)]
    figure = learning_figure({"e2e": e2e, "indi": indi})
    wall, steps = figure.axes
    assert "wall time" in wall.get_xlabel() and "steps" in steps.get_xlabel()
    assert "6 laps" in wall.get_ylabel()
    assert not wall.texts  # e2e is another race than the published ones
    alone = learning_figure({"indi": indi}).axes[0]
    assert [text.get_text() for text in alone.texts] == ["Table I, INDI simulated, sampled"]
    other = make_run(tmp_path / "c", [20.0, 17.5], 25.0, "indi_ppo.yaml", overrides)
    assert not learning_figure({"indi": [*indi, other]}).axes[0].texts
    curves = {line.get_label(): line for line in steps.lines if "seed" in line.get_label()}
    assert list(curves) == ["e2e (3 seeds, mean action)", "indi (1 seed, sampled)"]
    drawn = curves["e2e (3 seeds, mean action)"]
    assert drawn.get_xdata().tolist() == [0.5, 1.0, 1.5]
    np.testing.assert_array_equal(drawn.get_ydata(), [np.nan, 17, 16])
    assert wall.lines[1].get_xdata().tolist() == [25, 50, 75]
    assert wall.lines[0].get_color() == steps.lines[0].get_color() != wall.lines[1].get_color()
    save_figure(figure, tmp_path / "curves.png")


def test_another_race_has_no_published_time_and_may_never_finish(tmp_path):
    run = make_run(tmp_path / "a", [np.inf, np.inf], overrides=["evaluate.laps=2"])
    figure = learning_figure({"two": [run]})
    assert [text.get_text() for text in figure.axes[0].texts] == ["no run completed its laps"]
    assert "2 laps" in figure.axes[0].get_ylabel()
    save_figure(figure, tmp_path / "curves.png")


def test_what_cannot_be_drawn_is_refused(tmp_path):
    six, two = (
        make_run(tmp_path / str(n), [20.0], overrides=[f"evaluate.laps={n}"]) for n in (6, 2)
    )
    with pytest.raises(InputError, match="six 6 laps, two 2 laps"):
        learning_figure({"six": [six], "two": [two]})
    write_text(two / "metrics.csv", "steps,lap_total\n1,2\n")
    with pytest.raises(InputError, match="metrics.csv: no column seconds"):
        learning_figure({"two": [two]})
    with pytest.raises(InputError, match="no runs"):
        learning_figure({"none": []})
    with pytest.raises(InputError, match="allowed: 1 to"):
        learning_figure({str(i): [six] for i in range(len(COLORS) + 1)})
