"""Drawings of a plan that its sheet and its page share: track, commands, predicted states."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator
from numpy.typing import NDArray

from experiment_design.constraints.kinds.sea_room import edge_distance
from experiment_design.constraints.limits import Circle
from experiment_design.output.prediction import MotionBand
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import clock, shown_as
from greybox.report.figures import BLACK, BLUE, COLOURS, GREEN, VERMILION, tidy

Array = NDArray[np.float64]

BAND = "#cfe3f1"
FORBIDDEN = "#f6d5c3"
_STEPS = (5, 10, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400)
_MOST_MARKS = 21
# a sea room that is this many times the track is not drawn to its edge
_WIDE_ROOM = 5.0
_ENVELOPE = 240
_WORDS = {
    "u": ("surge u", "m/s"),
    "v": ("sway v", "m/s"),
    "r": ("yaw rate r", "rad/s"),
    "psi": ("heading ψ", "rad"),
    "speed": ("speed over ground", "m/s"),
}


def mark_step(duration: float) -> float:
    """Return the time between marks [s]: a minute unless the trial is very short or long."""
    if 120 <= duration <= 60 * _MOST_MARKS:
        return 60.0
    return float(next((s for s in _STEPS if duration <= _MOST_MARKS * s), _STEPS[-1]))


def draw_plan_track(axes: Any, design: Design, band: MotionBand, size: float = 7.0) -> None:
    """Draw the expected track in the sea room, north up, with numbered time marks.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    design : Design
    band : MotionBand
        Of the trial that is drawn.
    size : float
        Of the text [points].
    """
    r = design.request
    north, east = band["x_n"].nominal, band["y_n"].nominal
    step = mark_step(float(band.t[-1]))
    low, high = _frame(design, band, north, east)
    if not band.certain:
        index = np.unique(np.linspace(0, len(north) - 1, _ENVELOPE).astype(int))
        # one flat colour, so that they join to an envelope
        axes.add_collection(
            PolyCollection(
                band.hulls(index, joined=True), facecolor=BAND, edgecolor="none", zorder=1,
                label="95 % band",
            )
        )  # fmt: skip
    if r.limits.area is not None:
        _draw_room(axes, r.limits.area, r.limits.clearance, low, high)
    axes.plot(east, north, color=BLUE, linewidth=1.2, zorder=3, label="track")
    marks = np.arange(0, len(north), max(1, round(step / r.sample_time)))
    if not band.certain and len(marks) > 1:
        # what the map cuts would be lines that lead nowhere
        whole = [
            h for h in band.hulls(marks[1:]) if (h > low[::-1]).all() and (h < high[::-1]).all()
        ]
        axes.add_collection(
            PolyCollection(
                whole, facecolor="none", edgecolor="#6ba3cc", linewidth=0.5, zorder=2,
            )
        )  # fmt: skip
    unit = "min" if step >= 60 else "s"
    axes.plot(
        east[marks[1:]], north[marks[1:]], "o", color=BLACK, markersize=0.45 * size, zorder=4,
        linestyle="none", label=f"time [{unit}]",
    )  # fmt: skip
    for k, word, colour, shape in ((0, "start", GREEN, "^"), (-1, "end", VERMILION, "s")):
        axes.plot(
            east[k], north[k], shape, color=colour, markersize=1.05 * size, zorder=5,
            markeredgecolor="white", linestyle="none", label=word,
        )  # fmt: skip
    axes.set_xlim(low[1], high[1])
    axes.set_ylim(low[0], high[0])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("east [m]", fontsize=size)
    axes.set_ylabel("north [m]", fontsize=size)
    axes.tick_params(labelsize=size - 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    tidy(axes)
    _draw_numbers(axes, east, north, marks[1:], step, low, high, size)
    box = axes.get_window_extent()
    across, up = (72 / axes.figure.dpi * v for v in (box.width, box.height))
    x = 1 - 1.2 * size / across
    axes.annotate(
        "N",
        (x, 1 - 0.3 * size / up),
        (x, 1 - 3.6 * size / up),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontsize=size + 1,
        fontweight="bold",
        zorder=6,
        path_effects=[withStroke(linewidth=1.6, foreground="white")],
        arrowprops={"arrowstyle": "-|>", "color": BLACK, "linewidth": 1.0, "shrinkA": 5},
    )
    axes.legend(
        fontsize=size - 0.5, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2,
        ncols=3, frameon=False, columnspacing=1.0, handletextpad=0.4, handlelength=1.3,
    )  # fmt: skip


def _frame(design: Design, band: MotionBand, north: Array, east: Array) -> tuple[Array, Array]:
    """Return the corners (2,) of a square map, south-west and north-east."""
    track = np.stack([north, east], axis=-1)
    extent = max(float(np.ptp(track, axis=0).max()), 2 * design.request.vessel.length)
    points = [track]
    area = design.request.limits.area
    if isinstance(area, Circle):
        middle = np.array([area.north, area.east])
        room = np.stack([middle - area.radius, middle + area.radius])
    elif area is not None:
        room = np.asarray(area, float)
    if area is not None and np.ptp(np.vstack([room, track]), axis=0).max() < _WIDE_ROOM * extent:
        points.append(room)
    if not band.certain:
        index = np.arange(0, len(north), max(1, len(north) // 60))
        rings = band.places[:, index].reshape(-1, 2)
        # a band that explodes must not shrink the track to a dot
        middle = (track.max(axis=0) + track.min(axis=0)) / 2
        points.append(np.clip(rings, middle - 0.8 * extent, middle + 0.8 * extent))
    every = np.vstack(points)
    middle = (every.max(axis=0) + every.min(axis=0)) / 2
    half = 0.55 * max(float(np.ptp(every, axis=0).max()), extent)
    return middle - half, middle + half


def _draw_room(axes: Any, area: Array | Circle, clearance: float, low: Array, high: Array) -> None:
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": BLACK, "linewidth": 1.6, "zorder": 2}
    north, east = (np.linspace(a, b, 240) for a, b in zip(low, high, strict=True))
    inside = edge_distance(area, north[:, None] + 0 * east, east + 0 * north[:, None])
    style["label"] = "sea room" if inside.min() < 0 else "sea room (beyond map)"
    if isinstance(area, Circle):
        axes.add_patch(Disc((area.east, area.north), area.radius, **style))
    else:
        corners = np.asarray(area, float)[:, ::-1]
        axes.add_patch(Polygon(corners, closed=True, **style))
    if clearance <= 0:
        return
    if inside.min() < clearance < inside.max():
        axes.contour(
            east, north, inside, [clearance], colors=[VERMILION], linestyles="--", linewidths=0.9
        )
        axes.plot(
            [], [], color=VERMILION, linestyle="--", linewidth=0.9,
            label=f"{clearance:g} m inside",
        )  # fmt: skip


def _draw_numbers(
    axes: Any, east: Array, north: Array, marks: Any, step: float, low: Array, high: Array,
    size: float,
) -> None:  # fmt: skip
    """Put numbers to the marks, each where it hides least of the track and of the other numbers."""
    box = axes.get_window_extent()
    metres = float(high[0] - low[0]) / max(box.height, 1.0)
    # height and half width of two digits, in metres on this map
    tall = size / 72 * axes.figure.dpi * metres
    reach = 1.15 * tall
    taken = [np.array([north[k], east[k]]) for k in (*marks, 0, len(north) - 1)]
    line = np.stack([north, east], axis=-1)
    for k in marks:
        here = line[k]
        best, least = here, np.inf
        for angle in np.arange(16) * np.pi / 8:
            place = here + reach * np.array([np.cos(angle), np.sin(angle)])
            room = np.linalg.norm(line - place, axis=1)
            others = np.array([np.linalg.norm(o - place) for o in taken if o is not here])
            cost = float(np.exp(-((room / (0.6 * tall)) ** 2)).sum() * 0.2)
            cost += 6 * float(np.exp(-((others / (0.9 * tall)) ** 2)).sum())
            cost += 10.0 * bool((place < low + tall).any() or (place > high - tall).any())
            if cost < least:
                best, least = place, cost
        taken.append(best)
        number = k * float(step) / max(1, marks[0]) / (60 if step >= 60 else 1)
        axes.text(
            best[1], best[0], f"{number:g}", fontsize=size, ha="center", va="center", zorder=6,
            path_effects=[withStroke(linewidth=1.6, foreground="white")],
        )  # fmt: skip


def time_axis(axes: Any, duration: float, size: float, *, label: bool = True) -> None:
    """Mark minutes along a time axis in seconds."""
    axes.set_xlim(0, duration)
    step = next((s for s in _STEPS if duration <= 12 * s), _STEPS[-1])
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: clock(max(v, 0.0))))
    axes.tick_params(labelsize=size - 0.5, labelbottom=label)
    if label:
        axes.set_xlabel("time [min:s]", fontsize=size)


def draw_parts(axes: Any, design: Design, trial: int) -> None:
    """Draw a line where each part of a plan but the first begins."""
    for part in design.parts:
        if part.trial == trial and part.begin:
            axes.axvline(part.begin, color="0.25", linestyle="-.", linewidth=0.8, zorder=2)


def draw_commands(axes: Any, design: Design, trial: int, size: float = 7.0) -> None:
    """Draw one panel a command against time, steps between dotted limits.

    Parameters
    ----------
    axes : sequence of matplotlib.axes.Axes
        One per command.
    design : Design
    trial : int
    size : float
        Of the text [points].
    """
    r = design.request
    schedule, commands = r.schedule, design.commands[trial]
    t = np.arange(len(commands) + 1) * r.sample_time
    for i, (ax, name) in enumerate(zip(axes, schedule.commands, strict=True)):
        shown, sign = shown_as(r.vessel, name)
        value = sign * np.append(commands[:, i], commands[-1, i])
        low, high = sorted(sign * np.array([schedule.lower[i], schedule.upper[i]]))
        for bound in (low, high):
            ax.axhline(bound, color="0.45", linestyle=":", linewidth=0.8)
        ax.plot(t, value, color=COLOURS[i % 6], linewidth=1.2, drawstyle="steps-post")
        room = 0.12 * ((high - low) or abs(high) or 1.0)
        ax.set_ylim(low - room, high + room)
        ax.yaxis.set_major_locator(MaxNLocator(3))
        shown = shown if len(shown) <= 14 else shown[:13] + "…"
        angle = name in r.vessel.angle_commands
        unit = "rad" if angle else "as log"
        ax.set_ylabel(f"{shown}\n[{unit}]", fontsize=size, parse_math=False)
        tidy(ax)
        draw_parts(ax, design, trial)
        time_axis(ax, float(t[-1]), size, label=i == len(schedule.commands) - 1)
        if angle:
            right = ax.secondary_yaxis("right", functions=(np.rad2deg, np.deg2rad))
            right.yaxis.set_major_locator(MaxNLocator(3))
            right.tick_params(labelsize=size - 0.5)
            right.set_ylabel("[°]", fontsize=size)


def forbidden(design: Design, band: MotionBand, name: str) -> list[tuple[Array, int]]:
    """Return where a state must not go: edges (N+1,) and the side, 1 above or −1 below.

    An edge is nan where it does not count.
    """
    r = design.request
    zones = []
    for limit in r.path_limits(band.trial):
        if limit.signal == name:
            edges = limit.edges(band["psi"].nominal)
            if limit.of_regime:
                for edge, _ in edges:
                    edge[band.t < design.lead_in_s - 0.5 * r.sample_time] = np.nan
            zones += edges
    return zones


def draw_states(axes: Any, design: Design, band: MotionBand, size: float = 9.0) -> None:
    """Draw predicted states with bands and with what they must not enter.

    Parameters
    ----------
    axes : mapping of str to matplotlib.axes.Axes
        One per signal of the band.
    design : Design
    band : MotionBand
    size : float
        Of the text [points].
    """
    for k, (name, ax) in enumerate(axes.items()):
        signal = band[name]
        zones = forbidden(design, band, name)
        values = [signal.nominal, signal.low, signal.high, *[edge for edge, _ in zones]]
        # a band that explodes must not flatten the nominal motion
        spread = float(np.ptp(signal.nominal)) or 0.1 * float(np.abs(signal.nominal).max()) or 0.1
        low = max(min(float(np.nanmin(v)) for v in values), signal.nominal.min() - 3 * spread)
        high = min(max(float(np.nanmax(v)) for v in values), signal.nominal.max() + 3 * spread)
        room = 0.08 * ((high - low) or spread)
        low, high = low - room, high + room
        for edge, side in zones:
            ax.fill_between(
                band.t, edge, high if side > 0 else low, color=FORBIDDEN, linewidth=0, zorder=1
            )
            ax.plot(band.t, edge, color=VERMILION, linestyle="--", linewidth=0.9, zorder=2)
        if not band.certain:
            ax.fill_between(
                band.t, signal.low, signal.high, color=BLUE, alpha=0.25, linewidth=0, zorder=3
            )
        ax.plot(band.t, signal.nominal, color=BLUE, linewidth=1.2, zorder=4)
        ax.set_ylim(low, high)
        word, unit = _WORDS.get(name, (name, ""))
        ax.set_ylabel(f"{word}\n[{unit}]", fontsize=size)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        tidy(ax)
        draw_parts(ax, design, band.trial)
        time_axis(ax, float(band.t[-1]), size, label=k == len(axes) - 1)
        if unit.startswith("rad"):
            right = ax.secondary_yaxis("right", functions=(np.rad2deg, np.deg2rad))
            right.yaxis.set_major_locator(MaxNLocator(4))
            right.tick_params(labelsize=size - 0.5)
            right.set_ylabel("[°/s]" if unit == "rad/s" else "[°]", fontsize=size)
