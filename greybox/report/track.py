"""The track of a log on a map: north up, the ship at even times, the wind."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from greybox.report.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    label_axes,
    legend_above,
)
from greybox.report.thinning import pick, thin
from greybox.rotation import body_to_ned
from greybox.trial.gaps import GAP
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.track import without_antenna
from greybox.trial.wind import true_wind

Array = NDArray[np.float64]

_MOST_SHIPS = 18
_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)
# shares of the map's longer side
_SHORTEST_SHIP = 0.05
_LONGEST_SHIP = 0.12
_LONGEST_ARROW = 0.12
# a ship of length 1 seen from above: forward, starboard
_HULL = np.array([[0.5, 0], [0.22, 0.13], [-0.5, 0.13], [-0.5, -0.13], [0.22, -0.13]])


def draw_track(axes: Any, log: TrialLog, gaps: NDArray[np.intp], points: int) -> None:
    """Draw the positions of a log as a map.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    log : TrialLog
        With ``x_n``, ``y_n`` [m]; ``psi`` [rad] gives the ships, at the body
        origin, and measured wind with ``u``, ``v`` the arrows.
    gaps : ndarray of int
        Samples after which the line is interrupted (dotted across).
    points : int
        About how many the line has.
    """
    north, east = log["x_n"], log["y_n"]
    extent = max(float(np.ptp(north)), float(np.ptp(east)), 1e-3)
    index = thin(gaps, north, east, points=points)
    axes.plot(pick(east, index), pick(north, index), color=BLUE, linewidth=1.1, label="track")
    if len(gaps):
        axes.plot(
            np.column_stack([east[gaps], east[gaps + 1]]).T,
            np.column_stack([north[gaps], north[gaps + 1]]).T,
            color=ORANGE,
            linestyle=":",
            linewidth=1.4,
            label=["gap", *["_"] * (len(gaps) - 1)],
        )
    step, chosen = even_times(log.t, log.sample_time)
    shown: list[Any] = []
    if "psi" in log:
        shown.append(_draw_ships(axes, log, chosen, step, extent))
    if log.has_wind and all(n in log for n in ("psi", "u", "v")):
        shown += _draw_wind(axes, log, chosen, step, extent)
    for k, word, colour, marker in ((0, "start", GREEN, "o"), (-1, "end", VERMILION, "s")):
        axes.plot(
            east[k],
            north[k],
            marker,
            color=colour,
            markersize=7,
            markeredgecolor="white",
            linestyle="none",
            zorder=5,
            label=word,
        )
    handles, labels = axes.get_legend_handles_labels()
    labels += [h.get_label() for h in shown]
    look: dict[str, Any] = {"borderaxespad": 0.1, "columnspacing": 1.2}
    legend_above(axes, [*handles, *shown], labels, columns=2, **look)
    axes.set_aspect("equal", adjustable="datalim")
    label_axes(axes, "east [m]", "north [m]")
    # an offset or a power of ten would stand under the legend
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.margins(0.06)


def even_times(t: Array, sample_time: float) -> tuple[float, NDArray[np.intp]]:
    """Return a round time step and the samples nearest to its multiples.

    Parameters
    ----------
    t : ndarray
        (N,) [s]
    sample_time : float
        [s]

    Returns
    -------
    float
        Step [s], long enough for at most 18 samples.
    ndarray of int
        Samples, none for the times that fall in a gap.
    """
    span = float(t[-1] - t[0])
    step = next((s for s in _STEPS if span <= (_MOST_SHIPS - 1) * s), None)
    if step is None:
        step = 3600.0 * np.ceil(span / (_MOST_SHIPS - 1) / 3600)
    wanted = t[0] + step * np.arange(int(span / step) + 1)
    after = np.clip(np.searchsorted(t, wanted), 1, max(len(t) - 1, 1))
    near = np.where(wanted - t[after - 1] < t[after % len(t)] - wanted, after - 1, after % len(t))
    return float(step), np.unique(near[np.abs(t[near] - wanted) <= GAP / 2 * sample_time])


def _draw_ships(
    axes: Any, log: TrialLog, chosen: NDArray[np.intp], step: float, extent: float
) -> Any:
    # legible on a long track, and not hiding one that is shorter than the ship
    shortest, most = _SHORTEST_SHIP * extent, _LONGEST_SHIP * extent
    length = min(max(log.vessel.length, shortest), most)
    scale = length / log.vessel.length
    psi = log["psi"][chosen]
    antenna = log.vessel.sensors.get("antenna", (0.0, 0.0))
    north, east = without_antenna(log["x_n"][chosen], log["y_n"][chosen], psi, antenna)
    x, y = body_to_ned(length * _HULL[:, 0], length * _HULL[:, 1], psi[:, None])
    hulls = np.stack([east[:, None] + y, north[:, None] + x], axis=-1)
    label = f"ship every {step:g} s" if step < 3600 else f"ship every {step / 3600:g} h"
    if scale != 1:
        label += f", {scale:.2g} × its size" if scale < 10 else f", {scale:.0f} × its size"
    axes.add_collection(
        PolyCollection(
            list(hulls), facecolor="0.6", edgecolor=BLACK, alpha=0.5, linewidth=0.7, zorder=3
        )
    )
    return Line2D(
        [], [], linestyle="none", marker=(3, 0, 0), color="0.5", markeredgecolor=BLACK, label=label
    )


def _draw_wind(
    axes: Any, log: TrialLog, chosen: NDArray[np.intp], step: float, extent: float
) -> list[Any]:
    """Draw the wind at the ships, each the mean over one time step."""
    north, east = true_wind(log["u_q"], log["v_q"], log["psi"], log["u"], log["v"])
    first = np.searchsorted(log.t, log.t[chosen] - step / 2)
    last = np.maximum(np.searchsorted(log.t, log.t[chosen] + step / 2), first + 1)
    means = []
    for value in (north, east):
        total = np.concatenate([[0.0], np.cumsum(value)])
        means.append((total[last] - total[first]) / (last - first))
    strongest = float(np.hypot(*means).max())
    if strongest <= 0:
        return []
    foot, unit = (log["y_n"][chosen], log["x_n"][chosen]), _LONGEST_ARROW * extent / strongest
    axes.quiver(
        *foot,
        means[1],
        means[0],
        angles="xy",
        scale_units="xy",
        scale=1 / unit,
        width=0.004,
        color=SKY,
        zorder=4,
    )
    # limits follow only the feet of arrows by themselves
    axes.update_datalim(np.column_stack([foot[0] + unit * means[1], foot[1] + unit * means[0]]))
    label = f"true wind blows, up to {strongest:.2g} m/s"
    return [Line2D([], [], linestyle="none", marker=r"$\rightarrow$", color=SKY, label=label)]
