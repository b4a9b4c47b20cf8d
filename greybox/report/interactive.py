"""Charts that can be zoomed: Bokeh documents, with the same identifiers every time."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.report.chart import Area, Chart, Line, Panel, Strips
from greybox.report.figures import BLACK

Array = NDArray[np.float64]

# pixels to an inch of the printed figure, and what a panel measures at least and at most
_SCALE = 88
_LEAST, _MOST = 110, 420
_LEGEND_ROW = 24
_AXIS = 34
# how a figure says that its seconds are written as minutes
_MINUTES = "[min:s]"


@cache
def library() -> str:
    """Return the script that draws charts, as it is installed."""
    return (files("bokeh") / "server/static/js/bokeh.min.js").read_text(encoding="utf-8")


@cache
def opener() -> str:
    """Return the script that opens and closes charts beneath their pictures."""
    return (files("greybox") / "report/zoom.js").read_text(encoding="utf-8")


def chart_json(chart: Chart, name: str) -> str:
    """Return a chart as JSON that may stand inside a script element.

    Parameters
    ----------
    chart : Chart
    name : str
        Of the element that will hold it; the same chart and name give the same bytes.
    """
    from bokeh.core.json_encoder import serialize_json
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import Range1d, Span

    ranges: dict[int, Any] = {}
    cursors: dict[int, Any] = {}
    plots = []
    for i, panel in enumerate(chart.panels):
        first = panel.together
        if first == i:
            ranges[i] = Range1d(*panel.x_range)
            cursors[i] = Span(dimension="height", line_color=BLACK, line_dash="dotted")
        last = not any(p.together == first for p in chart.panels[i + 1 :])
        plots.append(_plot(panel, ranges[first], cursors[first], last, _tools(chart)))
    grid = gridplot(
        [[p] for p in plots],
        sizing_mode="stretch_width",
        toolbar_location="above",
        toolbar_options={"logo": None},
    )
    item: Any = json_item(grid, name)
    # no script ends, begins or hides inside the text
    text: str = serialize_json(_renamed(item, name))
    for mark in "<>&\u2028\u2029":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return text


def _tools(chart: Chart) -> list[Any]:
    """Return the tools of a panel: alike in all, or one button would not move them all."""
    from bokeh.models import BoxZoomTool, PanTool, ResetTool, WheelZoomTool

    maps = [panel.equal for panel in chart.panels]
    wide = "both" if any(maps) else "width"
    return [
        PanTool(dimensions=wide),
        BoxZoomTool(match_aspect=all(maps)),
        WheelZoomTool(dimensions=wide),
        ResetTool(),
    ]


def _plot(panel: Panel, x_range: Any, cursor: Any, last: bool, tools: list[Any]) -> Any:
    from bokeh.models import CrosshairTool, DataRange1d, Legend, NumeralTickFormatter, Range1d, Span
    from bokeh.plotting import figure

    if panel.equal:
        size: dict[str, Any] = {"match_aspect": True, "x_range": DataRange1d(),
                                "y_range": DataRange1d(), "height": _MOST}  # fmt: skip
    else:
        height = int(np.clip(_SCALE * panel.height, _LEAST, _MOST)) + (_AXIS if last else 0)
        size = {"x_range": x_range, "y_range": Range1d(*panel.y_range), "height": height}
    clock = panel.x_label.endswith(_MINUTES)
    plot = figure(
        tools=[],
        sizing_mode="stretch_width",
        min_border_left=66,
        min_border_right=12,
        x_axis_label=_plain(panel.x_label.replace(_MINUTES, "[h:min:s]")),
        y_axis_label=_plain(panel.y_label),
        **size,
    )
    plot.outline_line_color = None
    plot.grid.grid_line_alpha = 0.5
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = "12px"
    plot.axis.minor_tick_line_color = None
    if clock:
        plot.xaxis.formatter = NumeralTickFormatter(format="00:00:00")
    plot.xaxis.visible = last or panel.equal
    plot.yaxis.ticker.desired_num_ticks = 4
    legend: dict[str, list[Any]] = {}
    for strips in panel.strips:
        _note(legend, strips.label, _draw_strips(plot, strips))
    for area in panel.areas:
        _note(legend, area.label, _draw_area(plot, area))
    for level in panel.levels:
        plot.add_layout(Span(location=level, dimension="width", line_color=BLACK, line_alpha=0.6))
    drawn = []
    for line in panel.lines:
        made = _draw_line(plot, line, line.label or panel.y_label.split("\n")[0])
        drawn += made
        for glyph in made:
            _note(legend, line.label, glyph)
    if panel.words:
        x, y, words = zip(*panel.words, strict=True)
        plot.text(x=list(x), y=list(y), text=[_plain(w) for w in words], x_offset=5,
                  text_font_size="11px")  # fmt: skip
    level = Span(dimension="width", line_color=BLACK, line_dash="dotted")
    plot.add_tools(*tools, CrosshairTool(overlay=[cursor, level]))
    if drawn:
        plot.add_tools(_hover(drawn, panel))
    # on a page that is scrolled, a figure must be asked before it takes a drag or a wheel
    plot.toolbar.active_drag = plot.toolbar.active_scroll = None
    if legend and panel.legend:
        items: Any = list(legend.items())
        plot.add_layout(
            Legend(
                items=items, orientation="horizontal", border_line_color=None, padding=0, margin=2,
                label_text_font_size="11px", spacing=12, ncols=min(3, len(items)),
            ),
            "above",
        )  # fmt: skip
        plot.height += _LEGEND_ROW * -(-len(items) // 3)
    return plot


def _hover(drawn: list[Any], panel: Panel) -> Any:
    from bokeh.models import HoverTool

    # the name stands in a cell that the library escapes
    return HoverTool(
        renderers=drawn,
        mode="mouse" if panel.equal else "vline",
        tooltips=[("", "$name"), ("", "$snap_y{0.0000}  at  $snap_x{0.00}")],
    )


def _draw_line(plot: Any, line: Line, name: str) -> list[Any]:
    data = {"x": _single(line.x), "y": _single(line.y)}
    made = []
    if line.dash:
        made.append(plot.line(
            "x", "y", source=data, line_color=line.colour, line_dash=line.dash,
            line_width=max(line.width, 1.0), name=name,
        ))  # fmt: skip
    if line.marker:
        made.append(plot.scatter(
            "x", "y", source=data, color=line.colour, marker=line.marker, name=name,
            size=max(1.3 * line.size, 3.0),
        ))  # fmt: skip
    return made


def _draw_area(plot: Any, area: Area) -> Any:
    data = {
        "xs": [_single(p[:, 0]) for p in area.polygons],
        "ys": [_single(p[:, 1]) for p in area.polygons],
    }
    return plot.patches(
        "xs", "ys", source=data, fill_color=area.colour or None, fill_alpha=area.opacity,
        line_color=area.outline or None, line_width=0.8,
    )  # fmt: skip


def _draw_strips(plot: Any, strips: Strips) -> Any:
    data = {"x0": _single(strips.spans[:, 0]), "x1": _single(strips.spans[:, 1])}
    return plot.vstrip(
        "x0", "x1", source=data, fill_color=strips.colour, fill_alpha=strips.opacity,
        line_color=strips.colour, line_alpha=strips.opacity,
    )  # fmt: skip


def _note(legend: dict[str, list[Any]], label: str, glyph: Any) -> None:
    if label:
        legend.setdefault(_plain(label), []).append(glyph)


def _single(values: Array) -> NDArray[np.float32]:
    return np.asarray(values, np.float32)


def _plain(text: str) -> str:
    """Return text in which nothing is taken for a formula."""
    return re.sub(r"\$\$|\\\(|\\\[", lambda found: found.group()[0] + "\u200b" + found.group()[1],
                  text)  # fmt: skip


def _renamed(item: Any, prefix: str) -> Any:
    """Return a document with its identifiers numbered in the order they appear in."""
    names: dict[str, str] = {}

    def visit(value: Any) -> Any:
        if isinstance(value, dict):
            found = dict(value)
            for key in ("id", "root_id"):
                if isinstance(found.get(key), str):
                    old = found[key]
                    found[key] = names.setdefault(old, f"{prefix}-{len(names)}")
            return {k: v if k in ("id", "root_id") else visit(v) for k, v in found.items()}
        if isinstance(value, (list, tuple)):
            return [visit(v) for v in value]
        return value

    return visit(item)
