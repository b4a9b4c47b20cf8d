"""Charts that can be zoomed: documents of BokehJS, with the same identifiers every time.

Its Python package builds such a document some twenty times slower than it is
written here, model by model; what is not named has the script's own default.
"""

from __future__ import annotations

import gzip
import json
import re
from base64 import b64encode
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
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
# share of a signal's range that single precision may lose: coordinates of a grid need double
_LOST = 1e-6
_AXIS = 34
# how a figure says that its seconds are written as minutes
_MINUTES = "[min:s]"
_DASHES = {"solid": [], "dashed": [6], "dotted": [2, 4], "dashdot": [6, 4, 2, 4]}


@cache
def library() -> str:
    """Return the script that draws charts, as it is installed."""
    found = find_spec("bokeh")
    assert found is not None
    assert found.origin is not None
    folder = Path(found.origin).parent
    return (folder / "server/static/js/bokeh.min.js").read_text(encoding="utf-8")


@cache
def opener() -> str:
    """Return the script that opens and closes charts beneath their pictures."""
    return (files("greybox") / "report/zoom.js").read_text(encoding="utf-8")


class _Model:
    """A model of BokehJS and those of its properties that are not the default."""

    def __init__(self, kind: str, **properties: Any) -> None:
        self.kind = kind
        self.properties = properties


def chart_json(chart: Chart, name: str) -> str:
    """Return a chart as JSON that may stand inside a script element.

    Parameters
    ----------
    chart : Chart
    name : str
        Of the element that will hold it; the same chart and name give the same bytes.
    """
    ranges: dict[int, _Model] = {}
    cursors: dict[int, _Model] = {}
    plots = []
    for i, panel in enumerate(chart.panels):
        first = panel.together
        if first == i:
            ranges[i] = _range(panel.x_range)
            cursors[i] = _Model("Span", dimension="height", **_POINTER)
        last = not any(p.together == first for p in chart.panels[i + 1 :])
        plots.append(_plot(panel, ranges[first], cursors[first], last, _tools(chart)))
    names: dict[_Model, str] = {}
    root = _Model(
        "GridPlot",
        sizing_mode="stretch_width",
        children=[[plot, row, 0] for row, plot in enumerate(plots)],
        toolbar=_Model(
            "Toolbar", tools=_moved_together(plots), logo=None, active_drag=None, active_scroll=None
        ),
    )
    roots = [_encoded(root, names, name)]
    made = version("bokeh")
    config = _encoded(_Model("DocumentConfig"), names, name)
    document = {"version": made, "title": "", "config": config, "roots": roots}
    item = {"target_id": name, "root_id": names[root], "doc": document, "version": made}
    text = json.dumps(item, allow_nan=False, separators=(",", ":"))
    # no script ends, begins or hides inside the text
    for mark in "<>&":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return text


def _encoded(value: Any, names: dict[_Model, str], prefix: str) -> Any:
    """Return what JSON can hold; a model that stands there already is named only."""
    if isinstance(value, _Model):
        if value in names:
            return {"id": names[value]}
        names[value] = f"{prefix}-{len(names)}"
        head = {"type": "object", "name": value.kind, "id": names[value]}
        properties = {k: _encoded(v, names, prefix) for k, v in value.properties.items()}
        return head | ({"attributes": properties} if properties else {})
    if isinstance(value, np.ndarray):
        kept = value.astype("<f4")
        known = value[np.isfinite(value)]
        lost = np.abs(known - kept[np.isfinite(value)]).max(initial=0.0)
        if lost > _LOST * (np.ptp(known) if known.size else 0.0):
            kept = value.astype("<f8")
        packed = gzip.compress(kept.tobytes(), compresslevel=2, mtime=0)
        data = b64encode(packed).decode()
        return {
            "type": "ndarray", "array": {"type": "bytes", "data": data},
            "shape": list(value.shape), "dtype": kept.dtype.name, "order": "little",
        }  # fmt: skip
    if isinstance(value, dict):
        return {k: _encoded(v, names, prefix) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encoded(v, names, prefix) for v in value]
    return value


def _moved_together(plots: Sequence[_Model]) -> list[_Model]:
    """Return one button for the tools of all panels that are alike."""
    alike: dict[tuple[str, str], list[_Model]] = {}
    for plot in plots:
        for tool in plot.properties["toolbar"].properties["tools"]:
            alike.setdefault((tool.kind, tool.properties.get("mode", "")), []).append(tool)
    return [_Model("ToolProxy", tools=tools) for tools in alike.values()]


_POINTER: dict[str, Any] = {"line_color": BLACK, "line_dash": _DASHES["dotted"]}


def _range(ends: tuple[float, float]) -> _Model:
    return _Model("Range1d", start=ends[0], end=ends[1])


def _tools(chart: Chart) -> list[_Model]:
    """Return the tools of a panel: alike in all, or one button would not move them all."""
    maps = [panel.equal for panel in chart.panels]
    wide = "both" if any(maps) else "width"
    return [
        _Model("PanTool", dimensions=wide),
        _Model("BoxZoomTool", match_aspect=all(maps)),
        _Model("WheelZoomTool", dimensions=wide),
        _Model("ResetTool"),
    ]


def _plot(panel: Panel, x_range: _Model, cursor: _Model, last: bool, tools: list[_Model]) -> _Model:
    x_label = panel.x_label.replace(_MINUTES, "[h:min:s]")
    below = _axis(x_label, visible=last or panel.equal)
    if x_label != panel.x_label:
        below.properties["formatter"] = _Model("NumeralTickFormatter", format="00:00:00")
    left = _axis(panel.y_label, ticker=_Model("BasicTicker", desired_num_ticks=4))
    grids = [
        _Model("Grid", dimension=k, axis=axis, grid_line_alpha=0.5)
        for k, axis in enumerate((below, left))
    ]
    levels = [
        _Model("Span", location=level, line_color=BLACK, line_alpha=0.6) for level in panel.levels
    ]
    legend: dict[str, list[_Model]] = {}
    drawn: list[_Model] = []
    hovered: list[_Model] = []
    for strips in panel.strips:
        drawn.append(_draw_strips(strips))
        _note(legend, strips.label, drawn[-1])
    for area in panel.areas:
        drawn.append(_draw_area(area))
        _note(legend, area.label, drawn[-1])
    for line in panel.lines:
        for made in _draw_line(line, line.label or panel.y_label.split("\n")[0]):
            hovered.append(made)
            _note(legend, line.label, made)
    drawn += hovered
    if panel.words:
        drawn.append(_draw_words(panel.words))
    level = _Model("Span", dimension="width", **_POINTER)
    tools = [*tools, _Model("CrosshairTool", overlay=[cursor, level])]
    if hovered:
        tools.append(_hover(hovered, panel))
    height = int(np.clip(_SCALE * panel.height, _LEAST, _MOST)) + (_AXIS if last else 0)
    plot = _Model(
        "Figure",
        height=_MOST if panel.equal else height,
        sizing_mode="stretch_width",
        min_border_left=66,
        min_border_right=12,
        outline_line_color=None,
        match_aspect=panel.equal,
        x_range=_Model("DataRange1d") if panel.equal else x_range,
        y_range=_Model("DataRange1d") if panel.equal else _range(panel.y_range),
        left=[left],
        below=[below],
        center=[*grids, *levels],
        renderers=drawn,
        # on a page that is scrolled, a figure must be asked before it takes a drag or a wheel
        toolbar=_Model("Toolbar", tools=tools, active_drag=None, active_scroll=None),
        toolbar_location=None,
    )
    if legend and panel.legend:
        plot.properties["above"] = [_legend(legend)]
        plot.properties["height"] += _LEGEND_ROW * -(-len(legend) // 3)
    return plot


def _axis(label: str, **properties: Any) -> _Model:
    return _Model(
        "LinearAxis",
        axis_label=_plain(label),
        axis_label_text_font_style="normal",
        axis_label_text_font_size="12px",
        minor_tick_line_color=None,
        **properties,
    )


def _legend(shown: dict[str, list[_Model]]) -> _Model:
    items = [
        _Model("LegendItem", label=_value(label), renderers=drawn) for label, drawn in shown.items()
    ]
    return _Model(
        "Legend", items=items, orientation="horizontal", border_line_color=None, padding=0,
        margin=2, label_text_font_size="11px", spacing=12, ncols=min(3, len(items)),
    )  # fmt: skip


def _hover(drawn: list[_Model], panel: Panel) -> _Model:
    # the name stands in a cell that the library escapes
    return _Model(
        "HoverTool",
        renderers=drawn,
        mode="mouse" if panel.equal else "vline",
        tooltips=[("", "$name"), ("", "$snap_y{0.0000}  at  $snap_x{0.00}")],
    )


def _drawn(glyph: str, data: dict[str, Any], name: str | None = None, **style: Any) -> _Model:
    """Return something drawn of columns of data, each of the glyph's property of its name."""
    columns = {column: {"type": "field", "field": column} for column in data}
    return _Model(
        "GlyphRenderer",
        name=name,
        data_source=_Model("ColumnDataSource", data={"type": "map", "entries": list(data.items())}),
        glyph=_Model(glyph, **columns, **style),
    )


def _value(value: Any) -> dict[str, Any]:
    """Return one value for all that a glyph draws."""
    return {"type": "value", "value": value}


def _draw_line(line: Line, name: str) -> list[_Model]:
    data = {"x": line.x, "y": line.y}
    made = []
    if line.dash:
        made.append(_drawn(
            "Line", data, name, line_color=line.colour, line_width=max(line.width, 1.0),
            line_dash=_DASHES[line.dash],
        ))  # fmt: skip
    if line.marker:
        made.append(_drawn(
            "Scatter", data, name, marker=_value(line.marker), line_color=_value(line.colour),
            fill_color=_value(line.colour), size=_value(max(1.3 * line.size, 3.0)),
        ))  # fmt: skip
    return made


def _draw_area(area: Area) -> _Model:
    data = {"xs": [p[:, 0] for p in area.polygons], "ys": [p[:, 1] for p in area.polygons]}
    return _drawn(
        "Patches", data, fill_color=_value(area.colour or None), fill_alpha=_value(area.opacity),
        line_color=_value(area.outline or None), line_width=_value(0.8),
    )  # fmt: skip


def _draw_strips(strips: Strips) -> _Model:
    colour, opacity = _value(strips.colour), _value(strips.opacity)
    return _drawn(
        "VStrip", {"x0": strips.spans[:, 0], "x1": strips.spans[:, 1]}, fill_color=colour,
        fill_alpha=opacity, line_color=colour, line_alpha=opacity,
    )  # fmt: skip


def _draw_words(shown: Sequence[tuple[float, float, str]]) -> _Model:
    x, y, words = zip(*shown, strict=True)
    data = {"x": np.array(x), "y": np.array(y), "text": [_plain(word) for word in words]}
    return _drawn(
        "Text", data, x_offset=_value(5), text_font_size=_value("11px"), text_color=_value("black")
    )


def _note(legend: dict[str, list[_Model]], label: str, glyph: _Model) -> None:
    if label:
        legend.setdefault(_plain(label), []).append(glyph)


def _plain(text: str) -> str:
    """Return text in which nothing is taken for a formula."""
    return re.sub(r"\$\$|\\\(|\\\[", lambda found: found.group()[0] + "\u200b" + found.group()[1],
                  text)  # fmt: skip
