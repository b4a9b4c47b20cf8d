"""What a figure shows, as numbers: the same lines and areas for a drawing that can be zoomed.

The figure that is printed stays the one source; what has no meaning in data
units (arrows, legends, text beside the axes) is left to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DASHES = {"-": "solid", "--": "dashed", "-.": "dashdot", ":": "dotted"}
_MARKERS = {
    "o": "circle", ".": "dot", "s": "square", "^": "triangle", "v": "inverted_triangle",
    "D": "diamond", "x": "x", "+": "cross",
}  # fmt: skip
# in a legend nobody reads
_HIDDEN = "_"


@dataclass(frozen=True)
class Line:
    """A line, markers, or both: ``x`` and ``y`` (N,), NaN where it is interrupted."""

    x: Array
    y: Array
    label: str
    colour: str
    dash: str = "solid"
    marker: str = ""
    width: float = 1.0
    size: float = 5.0


@dataclass(frozen=True)
class Area:
    """Polygons, (n, 2) each, filled and outlined in colours that may be empty."""

    polygons: tuple[Array, ...]
    label: str
    colour: str
    opacity: float
    outline: str = ""


@dataclass(frozen=True)
class Strips:
    """Spans of x over the whole height, (n, 2)."""

    spans: Array
    label: str
    colour: str
    opacity: float


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Parameters
    ----------
    x_label, y_label : str
    x_range, y_range : tuple of float
    height : float
        [inch], as it is printed.
    together : int
        The first panel that has the same x axis: itself, or one before it.
    equal : bool
        Whether both axes have one scale, as on a map.
    lines, areas, strips, levels, words
        ``levels`` are y of horizontal lines, ``words`` x, y and a short text.
    legend : bool
        Whether one stands above it.
    """

    x_label: str
    y_label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    height: float
    together: int
    equal: bool = False
    lines: tuple[Line, ...] = ()
    areas: tuple[Area, ...] = ()
    strips: tuple[Strips, ...] = ()
    levels: tuple[float, ...] = ()
    words: tuple[tuple[float, float, str], ...] = ()
    legend: bool = False


@dataclass(frozen=True)
class Chart:
    """Panels under one another."""

    panels: tuple[Panel, ...]


def chart_of(figure: Figure) -> Chart:
    """Return what a figure shows in data units.

    Parameters
    ----------
    figure : Figure
        Of linear or logarithmic axes; others are left out.
    """
    shown = [
        ax for ax in figure.axes
        if ax.get_visible() and {ax.get_xscale(), ax.get_yscale()} == {"linear"} and ax.has_data()
    ]  # fmt: skip
    return Chart(tuple(_panel(ax, shown) for ax in shown))


def _panel(ax: Any, shown: list[Any]) -> Panel:
    shared = ax.get_shared_x_axes()
    lines, levels = [], []
    for line in ax.get_lines():
        across, up = line.get_transform().contains_branch_seperately(ax.transData)
        if across and up:
            lines.append(_line(line))
        elif up:
            levels.append(float(np.atleast_1d(line.get_ydata())[0]))
    areas: list[Area] = []
    strips: list[Strips] = []
    for found in ax.collections:
        across, up = found.get_transform().contains_branch_seperately(ax.transData)
        if isinstance(found, Quiver):
            continue
        if isinstance(found, LineCollection) and across and up:
            lines.append(_segments(found))
        elif isinstance(found, PolyCollection) and across:
            area = _collected(found)
            if up:
                areas.append(area)
            else:
                strips.append(_strips(area))
    for patch in ax.patches:
        if patch.get_data_transform() == ax.transData:
            pieces = patch.get_path().to_polygons(patch.get_patch_transform())
            areas.append(_area(pieces, patch, [patch.get_facecolor()], [patch.get_edgecolor()]))
    return Panel(
        x_label=ax.get_xlabel(),
        y_label=ax.get_ylabel(),
        x_range=_pair(ax.get_xlim()),
        y_range=_pair(ax.get_ylim()),
        height=float(ax.get_position().height * ax.figure.get_figheight()),
        together=next(
            i for i, other in enumerate(shown) if other is ax or shared.joined(other, ax)
        ),
        equal=ax.get_aspect() != "auto",
        lines=tuple(lines),
        areas=tuple(areas),
        strips=tuple(strips),
        levels=tuple(levels),
        words=tuple(
            (*map(float, text.get_position()), text.get_text())
            for text in ax.texts
            if text.get_transform() == ax.transData and text.get_text()
        ),
        legend=ax.get_legend() is not None or bool(ax.figure.legends and ax is shown[0]),
    )


def _pair(limits: Any) -> tuple[float, float]:
    return float(limits[0]), float(limits[1])


def _line(line: Any) -> Line:
    style, marker = line.get_linestyle(), line.get_marker()
    x = np.asarray(line.get_xdata(orig=False), float)
    y = np.asarray(line.get_ydata(orig=False), float)
    if line.get_drawstyle() == "steps-post":
        x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    return Line(
        x,
        y,
        _label(line),
        to_hex(line.get_color()),
        _DASHES.get(style, ""),
        "" if marker in ("None", None, "", " ") else _MARKERS.get(marker, "circle"),
        float(line.get_linewidth()),
        float(line.get_markersize()),
    )


def _segments(found: LineCollection) -> Line:
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([np.concatenate([s, gap]) for s in found.get_segments()] or [gap])
    colour = to_hex(found.get_colors()[0])
    return Line(points[:, 0], points[:, 1], _label(found), colour)


def _collected(found: PolyCollection) -> Area:
    pieces = [np.asarray(p.vertices, float) for p in found.get_paths()]
    pieces = [p for p in pieces if len(p)]
    return _area(pieces, found, found.get_facecolor(), found.get_edgecolor())


def _strips(area: Area) -> Strips:
    spans = np.array([[p[:, 0].min(), p[:, 0].max()] for p in area.polygons]).reshape(-1, 2)
    return Strips(spans, area.label, area.colour or area.outline, min(area.opacity, 0.3))


def _area(pieces: Any, artist: Any, faces: Any, edges: Any) -> Area:
    colour, opacity = _paint(faces)
    outline, shown = _paint(edges)
    drawn = shown and np.max(artist.get_linewidth(), initial=0) > 0
    return Area(
        tuple(np.asarray(p, float) for p in pieces), _label(artist), colour, opacity,
        outline if drawn else "",
    )  # fmt: skip


def _paint(colours: Any) -> tuple[str, float]:
    """Return the first of some colours and its opacity; none where there is nothing to see."""
    if not len(colours):
        return "", 0.0
    opacity = float(to_rgba(colours[0])[3])
    return (to_hex(colours[0]), opacity) if opacity else ("", 0.0)


def _label(artist: Any) -> str:
    text = str(artist.get_label())
    return "" if text.startswith(_HIDDEN) else text
