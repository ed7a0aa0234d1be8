"""Figures are shown by the backend in use."""

import warnings

import matplotlib.pyplot as plt

from quadjax.core.plotting import new_figure, save_figure, show_figure


def test_a_figure_is_shown_once_and_can_be_written_afterwards(tmp_path, monkeypatch):
    plt.switch_backend("agg")
    shown = []
    monkeypatch.setattr(plt, "show", lambda: shown.extend(map(plt.figure, plt.get_fignums())))
    figure = new_figure(3.0, 2.0)
    show_figure(figure)
    assert shown == [figure] and plt.get_fignums() == []
    save_figure(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 100


def test_nothing_is_shown_without_a_display():
    plt.switch_backend("agg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        show_figure(new_figure(3.0, 2.0))
    assert plt.get_fignums() == []
