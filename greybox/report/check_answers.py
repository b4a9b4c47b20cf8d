"""Pictures of what the surroundings and the inputs say: wind, course, answer to thrusters."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from greybox.report.check_ties import mended_in_words, title_of
from greybox.report.figures import (
    BLACK,
    BLUE,
    VERMILION,
    label_axes,
    legend_above,
    legend_outside,
    new_figure,
)
from greybox.report.thinning import find_gaps, pick, thin
from greybox.trial.checks.finding import Finding

Array = NDArray[np.float64]

_DOTS = 450
_SPANS = 60
_STATES = {"u": ("surge", "m/s²"), "v": ("sway", "m/s²"), "r": ("yaw", "rad/s²")}


def wind_figure(finding: Finding) -> Figure:
    """Draw the true wind against heading, read as named and as meant.

    The true wind does not turn with the ship: read rightly it is level against
    heading, and a spot instead of a ring.
    """
    t, psi = finding.picture["t"], finding.picture["psi"]
    figure = new_figure(10, 5.8)
    grid = figure.add_gridspec(2, 2, width_ratios=[2.3, 1])
    every = max(1, len(t) // _DOTS)
    heading = np.degrees(psi[::every]) % 360
    reach = 0.0
    rounds = []
    mended = mended_in_words(finding.repair) if finding.repair else "turned into body axes"
    for i, (key, words) in enumerate((("air", "as logged"), ("air_mended", mended))):
        air = finding.picture[key]
        scatter = float(np.sqrt(np.sum(np.var(air, axis=0))))
        left, right = figure.add_subplot(grid[i, 0]), figure.add_subplot(grid[i, 1])
        for k, colour, marker, name in ((0, BLUE, ".", "north"), (1, VERMILION, "x", "east")):
            left.plot(
                heading, air[::every, k], marker, color=colour, markersize=3, alpha=0.7,
                label=f"to the {name}",
            )  # fmt: skip
        told = f"{words}: scatter {scatter:.3g} m/s"
        label_axes(left, y="air over ground [m/s]", title=told)
        left.set_xlim(0, 360)
        left.set_xticks(range(0, 361, 45))
        right.plot(air[::every, 1], air[::every, 0], ".", color=BLUE, markersize=2.5, alpha=0.6)
        right.set_aspect("equal")
        label_axes(right, "east [m/s]", "north [m/s]")
        reach = max(reach, 1.1 * float(np.quantile(np.abs(air), 0.999)))
        rounds.append(right)
    for ax in rounds:
        ax.set_xlim(-reach, reach)
        ax.set_ylim(-reach, reach)
        ax.axhline(0, color=BLACK, linewidth=0.5)
        ax.axvline(0, color=BLACK, linewidth=0.5)
    levels = [ax for ax in figure.axes if ax not in rounds]
    low = min(ax.get_ylim()[0] for ax in levels)
    high = max(ax.get_ylim()[1] for ax in levels)
    for ax in levels:
        ax.set_ylim(low, high)
    levels[0].tick_params(labelbottom=False)
    levels[-1].set_xlabel("heading [deg]", fontsize=9)
    legend_above(levels[0], side="right", columns=2, markerscale=2)
    figure.suptitle(f"{title_of(finding)}: the true wind must not turn with the ship", fontsize=11)
    return figure


def course_figure(finding: Finding) -> Figure:
    """Draw course minus heading against time and round the bow, as logged and mended."""
    t, drift = finding.picture["t"], finding.picture["drift"]
    bias = float(np.asarray(finding.value))
    figure = new_figure(10, 4.2)
    grid = figure.add_gridspec(1, 2, width_ratios=[1.9, 1])
    ax = figure.add_subplot(grid[0, 0])
    polar: Any = figure.add_subplot(grid[0, 1], projection="polar")
    every = max(1, len(t) // _DOTS)
    edges = np.radians(np.arange(-180, 181, 10))
    most = 0.0
    for value, colour, words in (
        (drift, VERMILION, "as logged"), (drift + bias, BLUE, mended_in_words(finding.repair)),
    ):  # fmt: skip
        angle = np.angle(np.exp(1j * value))
        ax.plot(
            t[::every], np.degrees(angle[::every]), ".", color=colour, markersize=3, alpha=0.7,
            label=words,
        )  # fmt: skip
        share = 100 * np.histogram(angle, edges)[0] / len(angle)
        most = max(most, float(share.max()))
        polar.bar(
            edges[:-1], share, width=np.diff(edges), align="edge", color=colour, alpha=0.75,
            edgecolor="white", linewidth=0.4,
        )  # fmt: skip
    ax.axhline(0, color=BLACK, linewidth=0.8)
    ax.set_ylim(-185, 185)
    ax.set_yticks(range(-180, 181, 45))
    label_axes(ax, "time [s]", "course − heading [deg], starboard positive")
    legend_above(ax, columns=2, markerscale=3)
    polar.set_theta_zero_location("N")
    polar.set_theta_direction(-1)
    polar.set_thetagrids(
        range(0, 360, 45), ["bow", "45°", "starboard", "135°", "astern", "225°", "port", "315°"]
    )
    top = 10 * np.ceil(most / 10)
    polar.set_yticks([top / 2])
    polar.set_rmax(top)
    polar.set_title("where it goes, seen from the bow [% of the samples]", fontsize=9)
    polar.tick_params(labelsize=7)
    polar.tick_params(axis="x", pad=13)
    polar.set_rlabel_position(157)
    figure.suptitle(title_of(finding), fontsize=11)
    return figure


def answer_figure(finding: Finding) -> Figure:
    """Draw the ship's acceleration against the push of its thrusters, both readings."""
    p = finding.picture
    word, unit = _STATES[p["state"]]
    t, measured = p["t"], p["acceleration"]
    # one gain for both rows: that of the reading that explains the motion
    power = float(p["push_read"] @ p["push_read"]) or 1.0
    gain = float(p["push_read"] @ measured) / power
    figure = new_figure(10, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.9, 1])
    width = min(_SPANS, len(t))
    helped = (measured - gain * p["push"]) ** 2 - (measured - gain * p["push_read"]) ** 2
    k = int(np.argmax(np.convolve(helped, np.ones(width), mode="valid")))
    part = slice(k, k + width)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    scatters = []
    for i, (key, words, match) in enumerate(
        (
            ("push", "as logged", p["match"][0]),
            ("push_read", _read_so(finding), p["match"][1]),
        )
    ):
        left, right = figure.add_subplot(grid[i, 0]), figure.add_subplot(grid[i, 1])
        index = thin(find_gaps(t[part], step), measured[part])
        for value, colour, style, name in (
            (measured, BLACK, "-", "the ship's acceleration"),
            (gain * p[key], VERMILION, "--", "what the thrusters push"),
        ):
            left.plot(
                pick(t[part], index), pick(value[part], index), style, color=colour,
                linewidth=1.2, label=name,
            )  # fmt: skip
        told = f"{words}: correlation {match:+.2f}"
        label_axes(left, y=f"{word} acceleration [{unit}]", title=told)
        every = max(1, len(t) // _DOTS)
        right.plot(
            gain * p[key][::every], measured[::every], ".", markersize=3, color=BLUE,
            alpha=0.6,
        )  # fmt: skip
        label_axes(right, y=f"measured [{unit}]")
        scatters.append(right)
    reach = 1.1 * float(np.quantile(np.abs(measured), 0.995))
    for ax in scatters:
        ax.axline((0, 0), slope=1, color=BLACK, linewidth=0.8, linestyle=":")
        ax.set_xlim(-reach, reach)
        ax.set_ylim(-reach, reach)
    scatters[0].tick_params(labelbottom=False)
    scatters[1].set_xlabel(f"pushed [{unit}]", fontsize=9)
    figure.axes[0].tick_params(labelbottom=False)
    figure.axes[2].set_xlabel("time [s]", fontsize=9)
    legend_outside(figure, figure.axes[0], "lower center", 2, fontsize=9)
    figure.suptitle(
        f"{title_of(finding)}: the ship must answer the way its thrusters push", fontsize=11
    )
    return figure


def _read_so(finding: Finding) -> str:
    return f"read with {mended_in_words(finding.repair)}"
