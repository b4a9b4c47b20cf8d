"""Pictures of actuators that follow late, and of forces that the thrusters did not give."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from greybox.report.check_ties import title_of
from greybox.report.figures import (
    BLACK,
    BLUE,
    GREEN,
    VERMILION,
    label_axes,
    legend_above,
    new_figure,
    tidy,
)
from greybox.trial.checks.finding import Finding

_POINTS = 1500


def actuator_figure(finding: Finding) -> Figure:
    """Draw command, feedback and fit over the minute in which the command moves most."""
    picture = finding.picture
    angular = picture["unit"] == "rad"
    figure = new_figure(10, 4.2)
    ax = figure.add_subplot()
    for key, colour, style, name in (
        ("command", BLACK, "-", "command, in the feedback's unit"),
        ("feedback", BLUE, ".", "feedback"),
        ("model", VERMILION, "-", "fitted: delay, lag, gain, limits"),
    ):
        value = np.degrees(picture[key]) if angular else picture[key]
        ax.plot(picture["t"], value, style, color=colour, markersize=3, linewidth=1.1, label=name)
    ax.set_xlabel("time [s]", fontsize=9)
    ax.set_ylabel(f"{finding.channel} [{'deg' if angular else 'as logged'}]", fontsize=9)
    legend_above(ax, side="right", columns=3)
    tidy(ax)
    figure.suptitle(title_of(finding), fontsize=11, x=0.02, ha="left")
    return figure


def force_figure(finding: Finding) -> Figure:
    """Draw the speed that thrusters and damping leave unexplained, and the thrust."""
    picture = finding.picture
    t = picture["t"]
    rows = slice(None, None, max(1, len(t) // _POINTS))
    begin, end = picture["interval"]
    figure = new_figure(10, 5.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    for k, colour, name in ((0, BLUE, "ahead"), (1, GREEN, "to starboard")):
        above.plot(t[rows], picture["gathered"][rows, k], color=colour, linewidth=1.1, label=name)
    size = np.linalg.norm(picture["thrust"], axis=1)
    below.plot(t[rows], size[rows] / max(float(size.max()), 1e-300), color=BLACK, linewidth=0.9)
    for ax in (above, below):
        ax.axvspan(begin, end, color=VERMILION, alpha=0.18, linewidth=0)
    label_axes(above, y="speed gained beyond thrusters\nand damping [m/s]")
    legend_above(above, side="right", columns=2)
    label_axes(below, "time [s]", "thrust over\nits largest")
    figure.suptitle(title_of(finding), fontsize=11, x=0.02, ha="left")
    return figure
