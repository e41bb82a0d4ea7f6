"""How figures look: colours, line styles, axes of steps."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, GREY = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#666666",
)
"""Okabe and Ito's palette, which keeps apart for colour-blind readers."""

LINES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (PURPLE, ":"), (RED, (0, (5, 1))), (SKY, (0, (3, 1, 1, 1))))
"""Colour and line style of one curve after another, so that a grey print still reads."""

STYLE: dict[Any, Any] = {
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "font.size": 10,
    "legend.edgecolor": "white",
    "legend.framealpha": 0.9,
    "legend.fontsize": 9,
    "lines.linewidth": 1.8,
}
"""Settings of matplotlib while a figure is drawn."""


def steps_axis(axes: Axes, label: str = "environment steps") -> None:
    """Make the horizontal axis one of steps, from 0, with 20 k for 20,000."""
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    axes.set_xlim(left=0)


def values_axis(axes: Axes) -> None:
    """Make the vertical axis start at 0 and write large values short."""
    top = axes.get_ylim()[1]
    axes.set_ylim(0, 1.05 * top)
    if top > 1000:
        axes.yaxis.set_major_formatter(EngFormatter(sep=" "))
