"""The style of all figures: colors, axes, and figures that need not be closed."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file

INK = "#1b2430"
MUTED = "#7a8594"
PAPER = "#ffffff"
# Perceptually uniform; without the ends, which do not show on black and on white.
SPEED_COLORS = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.08, 0.95, 256)))
SERIES = ("#1f6feb", "#d1495b", "#2a9d8f", "#e9a23b")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches, on a separate canvas."""
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08)  # inches
    figure = Figure(figsize=(width, height), layout=layout, facecolor=PAPER)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, *paths: Path | str, dpi: int = 150) -> None:
    """Write a figure to files; the suffix of each is its format (png, svg, pdf).

    All files have the layout computed for the first one.

    Raises:
        InputError: a suffix that Matplotlib does not know, or a path that cannot be written.
    """
    kinds, layout = figure.canvas.get_supported_filetypes(), figure.get_layout_engine()
    try:
        for path in map(Path, paths):
            kind = path.suffix.lstrip(".").lower()
            if kind not in kinds:
                raise InputError(f"{path}: suffix is {kind!r}, allowed: {', '.join(sorted(kinds))}")
            with whole_file(path) as temporary:
                figure.savefig(temporary, dpi=dpi, format=kind)
            figure.set_layout_engine("none")
    finally:
        figure.set_layout_engine(layout)


def head(axes: Axes, title: str = "", columns: int = 4) -> None:
    """Set the title and place the legend between it and the axes, where it covers no data.

    Args:
        axes: with everything drawn that has a label.
        title: above the legend.
        columns: most columns of the legend; fewer if the labels are too long for the figure.
    """
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        widest = 0.6 + 0.07 * max(map(len, labels))  # inches
        width = axes.figure.bbox.width / axes.figure.dpi
        columns = min(columns, max(1, int(width / widest)))
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (-0.01, 0.99)}
        style: dict[str, Any] = {
            "frameon": False,
            "labelcolor": INK,
            "fontsize": 9,
            "borderaxespad": 0.2,
        }
        legend = axes.legend(handles, labels, ncols=columns, **place, **style)
        legend.set_in_layout(not title)  # the title's pad has its height; it may exceed the axes
    rows = -(-len(handles) // columns)
    axes.set_title(title, color=INK, fontsize=13, loc="left", pad=8 + 17 * rows)


def headline(figure: Figure, title: str) -> None:
    """Set the title of a figure of several axes."""
    figure.suptitle(title, color=INK, fontsize=13, x=0.02, ha="left")


def tidy(axes: Axes) -> None:
    """Apply the style of all figures to the axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(True, color="#e6e9ee", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.ticklabel_format(useOffset=False)
