"""Draw docs/images/architectures.png and toolchain.png: python -m benchmarks.diagrams."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from quadjax.cli import script
from quadjax.core.plotting import INK, MUTED, new_figure

POLICY, OURS, DRONE = matplotlib.colormaps["viridis"]([0.75, 0.45, 0.2])
HEIGHT = 0.62
IMAGES = Path(__file__).resolve().parents[1] / "docs/images"  # that are written


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    (figure := new_figure(width, height)).set_layout_engine("none")  # axes are inches
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    return figure, axes


def _box(axes: Axes, x: float, y: float, text: str, color: Sequence[float], width: float) -> None:
    corner, shape = (x - 0.5 * width, y - 0.5 * HEIGHT), "round,pad=0,rounding_size=0.08"
    face = (*color[:3], 0.16)
    axes.add_patch(FancyBboxPatch(corner, width, HEIGHT, boxstyle=shape, fc=face, ec=color, lw=1.6))
    axes.text(x, y, text, ha="center", va="center", color=INK, fontsize=9, linespacing=1.25)


def _arrow(axes: Axes, points: Sequence[tuple[float, float]], text: str = "") -> None:
    """A line through points with its head at the last, and a text over its first piece."""
    xs, ys = zip(*points, strict=True)
    axes.plot(xs[:-1], ys[:-1], color=MUTED, lw=1.2, zorder=0, solid_capstyle="butt")
    style = {"arrowstyle": "-|>", "color": MUTED, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=points[-1], xytext=points[-2], arrowprops=style)
    if text:
        x, y = 0.5 * (xs[0] + xs[1]), 0.5 * (ys[0] + ys[1])
        axes.text(x, y + 0.06, text, ha="center", va="bottom", color=INK, fontsize=8)


def architecture_figure() -> Figure:
    """E2E and INDI from the sensors to the motors."""
    figure, axes = _axes(9.6, 4.3)
    e2e, indi = 3.35, 1.0
    for y, low, name in ((e2e, 1.95, "E2E"), (indi, 0.3, "INDI")):
        axes.text(0.3, y + 0.45, name, fontsize=12, color=INK, weight="bold", va="bottom")
        _box(axes, 0.95, y, "state\nestimation", OURS, 1.3)
        _box(axes, 8.75, y, "motors,\ndrone", DRONE, 1.2)
        _arrow(axes, [(8.75, y - 0.31), (8.75, low), (0.45, low), (0.45, y - 0.31)])
        axes.text(0.6, low + 0.04, "IMU, propeller speeds, motion capture", fontsize=8, color=INK)
    _box(axes, 3.75, e2e, "neural policy\n24 inputs, 4 commands", POLICY, 1.9)
    _arrow(axes, [(1.6, e2e), (2.8, e2e)], "state, rpm")
    _arrow(axes, [(4.7, e2e), (8.15, e2e)], "four propeller speeds (rpm)")
    _box(axes, 2.3, 2.5, "disturbance\nestimator", OURS, 1.5)
    _arrow(axes, [(0.95, e2e - 0.31), (0.95, 2.5), (1.55, 2.5)])
    _arrow(axes, [(3.05, 2.5), (3.75, 2.5), (3.75, e2e - 0.31)])
    axes.text(3.88, 2.55, "external moment\nand force", fontsize=8, color=INK, va="center")
    _box(axes, 3.75, indi, "neural policy\n17 inputs, 4 commands", POLICY, 1.9)
    _box(axes, 6.65, indi, "INDI\ninner loop", OURS, 1.3)
    for start, end, text in ((1.6, 2.8, "state, thrust"), (4.7, 6.0, "rates, thrust")):
        _arrow(axes, [(start, indi), (end, indi)], text)
    _arrow(axes, [(7.3, indi), (8.15, indi)], "rpm")
    _arrow(axes, [(6.65, 0.3), (6.65, indi - 0.31)])
    return figure


def toolchain_figure() -> Figure:
    """From flight logs to a policy on the drone, and back."""
    figure, axes = _axes(9.6, 2.6)
    top, low = 1.95, 0.75
    boxes = (
        (1.0, top, "flight logs", DRONE),
        (2.95, top, "quadjax fit\nconstants, residual", OURS),
        (4.95, top, "simulator\nvehicle, race", OURS),
        (6.85, top, "quadjax train\nSHAC or PPO", OURS),
        (8.65, top, "policy.npz", POLICY),
        (8.65, low, "quadjax evaluate\ncompare, report", OURS),
        (6.55, low, "quadjax export\nfixed-point C", OURS),
        (4.45, low, "quadjax verify\nproofs, bits", OURS),
        (1.75, low, "autopilot,\ndrone", DRONE),
    )
    for x, y, text, color in boxes:
        _box(axes, x, y, text, color, 1.5)
    pairs = ((1.0, 2.95), (2.95, 4.95), (4.95, 6.85), (6.85, 8.65))
    lines = [[(left + 0.75, top), (right - 0.75, top)] for left, right in pairs]
    lines += [[(8.65, top - 0.31), (8.65, low + 0.31)], [(5.8, low), (5.2, low)]]
    lines += [[(8.2, top - 0.31), (8.2, 1.35), (6.55, 1.35), (6.55, low + 0.31)]]
    for points in (*lines, [(0.6, low), (0.6, top - 0.31)]):
        _arrow(axes, points)
    _arrow(axes, [(3.7, low), (2.5, low)], "C")
    axes.plot([1.0, 0.6], [low, low], color=MUTED, lw=1.2, zorder=0)
    axes.text(0.68, 1.35, "flights", fontsize=8, color=INK, va="center")
    return figure


def diagrams() -> None:
    """Draw both figures."""
    for name, drawn in (("architectures", architecture_figure), ("toolchain", toolchain_figure)):
        drawn().savefig(IMAGES / f"{name}.png", dpi=150)


if __name__ == "__main__":
    script(diagrams)
