"""The sheet to take on board: one A4 page a trial, as PDF, SVG, PNG or HTML."""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from experiment_design.output.legs import LegPlan
from experiment_design.output.pictures import draw_commands, draw_plan_track
from experiment_design.output.prediction import MotionBand, predict_motion
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import Column, SheetContents, sheet_contents, tie
from greybox.errors import UsageError
from greybox.files import replacing, write_text
from greybox.report.figures import new_figure, to_svg

KINDS = (".pdf", ".svg", ".png", ".html", ".htm")

# A4 portrait, in millimetres
_WIDTH, _HEIGHT = 210.0, 297.0
_EDGE = 12.0
_INNER = _WIDTH - 2 * _EDGE
_DPI = 150
_POINT = 25.4 / 72
# mean width of a digit, and distance of rows, in units of the size of the text
_DIGIT, _LEADING = 0.62, 1.28
_SMALLEST, _LARGEST = 5.6, 8.0
# text above which both units of an angle are worth their room
_BOTH_FROM = 6.2
_GAP = 4.0
# map and commands [mm], roomy to tight: a long table takes their room
_PARTS = ((104.0, 54.0), (92.0, 48.0), (82.0, 42.0), (72.0, 36.0), (62.0, 30.0))
_COMFORTABLE = (6.4, 5.6)
_GREY, _RED = "#f0f0f0", "#8a1c00"


@dataclass(frozen=True)
class TableLayout:
    """How a way-point table is laid out: blocks side by side, rows a block, text [points]."""

    columns: tuple[Column, ...]
    blocks: int
    rows: int
    size: float

    @property
    def capacity(self) -> int:
        """Way-points that fit."""
        return self.blocks * self.rows


def sheet_kind(path: str | Path) -> str:
    """Return the kind of file that a sheet's name asks for.

    Raises
    ------
    UsageError
        It is none that a sheet can be written as.
    """
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise UsageError(
            f"the sheet '{Path(path).name}' has no ending that it can be written as: use .pdf, "
            f".html, .svg or .png."
        )
    return ".html" if kind == ".htm" else kind


def write_sheet(design: Design, path: str | Path, legs: LegPlan | None = None) -> None:
    """Write the sheet to take on board, one A4 page a trial.

    Several pages are stacked in an SVG or PNG. A table of more way-points than one
    page holds legibly continues on another page.

    Parameters
    ----------
    design : Design
    path : path
        Ends in .pdf, .html, .svg or .png.
    legs : LegPlan, optional
        What the table holds in place of commands by the clock.

    Raises
    ------
    UsageError
        It ends otherwise.
    """
    kind = sheet_kind(path)
    design = design.from_first_command()
    bands = predict_motion(design)
    with _quiet_fonts():
        if kind == ".html":
            write_text(_html(design, bands, legs), path)
            return
        pages = [page for band in bands for page in sheet_figures(design, band, legs)]
        if kind == ".svg":
            write_text(_stacked_svg(pages), path)
            return
        data = _pdf(pages) if kind == ".pdf" else _stacked_png(pages)
    with replacing(path, "wb") as handle:
        handle.write(data)


def wrap(text: str, width: int, **options: Any) -> list[str]:
    """Wrap text, a number and its unit kept together."""
    return textwrap.wrap(tie(text), width, **options)


@contextmanager
def _quiet_fonts() -> Iterator[None]:
    """Draw a box for a character that the font lacks, without a warning each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def lay_out(contents: SheetContents, width: float, height: float) -> TableLayout:
    """Return the most legible layout of a way-point table in a room [mm].

    Angles are given in degrees and radians where there is room for both.
    """
    best: TableLayout | None = None
    for columns in (contents.columns, contents.narrow):
        for blocks in (1, 2, 3):
            rows = -(-contents.rows // blocks)
            characters = sum(c.width + 1.4 for c in columns)
            across = (width - (blocks - 1) * _GAP) / blocks / characters / (_DIGIT * _POINT)
            along = height / (rows + 2.4) / (_LEADING * _POINT)
            size = min(across, along, _LARGEST)
            if size < _SMALLEST <= across:
                # what does not fit at the smallest text goes on to the next page
                fits = int(height / (_SMALLEST * _LEADING * _POINT) - 2.4)
                layout = TableLayout(columns, blocks, max(1, fits), _SMALLEST)
            else:
                layout = TableLayout(columns, blocks, rows, size)
            if best is None or _rank(layout, contents) > _rank(best, contents):
                best = layout
        if best is not None and best.size >= _BOTH_FROM and best.capacity >= contents.rows:
            break
    assert best is not None
    return best


def _rank(layout: TableLayout, contents: SheetContents) -> tuple[bool, int, float]:
    legible = layout.size >= _SMALLEST - 1e-9
    return legible, min(layout.capacity, contents.rows), layout.size


@dataclass(frozen=True)
class PageLayout:
    """Sizes [mm] of the map and of each command's panel, and the table below them."""

    map: float
    panel: float
    table: TableLayout


def lay_out_page(contents: SheetContents, commands: int, room: float) -> PageLayout:
    """Share the height of a page [mm] between map, commands and table.

    Parameters
    ----------
    contents : SheetContents
    commands : int
        Number of panels.
    room : float
        What the three have together.
    """
    found: list[PageLayout] = []
    for wanted in _COMFORTABLE:
        found = []
        for size, panels in _PARTS:
            panel = float(np.clip(panels / commands, 5.5, 18))
            rest = max(room - size - panel * commands, 10.0)
            layout = PageLayout(size, panel, lay_out(contents, _INNER, rest))
            found.append(layout)
            table = layout.table
            if table.capacity >= contents.rows and table.size >= wanted - 1e-9:
                return layout
    # it needs another page anyway
    return found[1]


class _Paper:
    """An empty A4 page whose parts are placed in millimetres from its top left."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=(_WIDTH / 25.4, _HEIGHT / 25.4), dpi=_DPI)
        self.page = self.figure.add_axes((0, 0, 1, 1))
        self.page.set_xlim(0, _WIDTH)
        self.page.set_ylim(_HEIGHT, 0)
        self.page.axis("off")

    def text(self, x: float, y: float, words: str, size: float, **style: Any) -> None:
        self.page.text(
            x, y, words, fontsize=size, parse_math=False,
            **({"va": "top", "ha": "left"} | style),
        )  # fmt: skip

    def lines(self, x: float, y: float, lines: list[str], size: float, **style: Any) -> float:
        """Write lines under one another and return where they end."""
        for line in lines:
            self.text(x, y, line, size, **style)
            y += 1.32 * size * _POINT
        return y

    def axes(self, left: float, top: float, width: float, height: float) -> Any:
        return self.figure.add_axes(
            (left / _WIDTH, 1 - (top + height) / _HEIGHT, width / _WIDTH, height / _HEIGHT)
        )

    def box(self, left: float, top: float, width: float, height: float, **style: Any) -> None:
        self.page.add_patch(
            Rectangle((left, top), width, height, **({"linewidth": 0, "zorder": 0} | style))
        )


def sheet_figures(design: Design, band: MotionBand, legs: LegPlan | None = None) -> list[Figure]:
    """Return the pages of one trial as figures, one unless the table is too long.

    Parameters
    ----------
    design : Design
    band : MotionBand
        Of the trial.
    legs : LegPlan, optional
        What the table holds in place of commands by the clock.
    """
    contents = _contents(design, band, legs)
    paper = _Paper()
    top = _head(paper, contents)
    bottom = _HEIGHT - _EDGE
    count = len(design.request.schedule.commands)
    note = wrap(contents.note, 150)
    below = 10 + len(note) * 2.9 + 6
    parts = lay_out_page(contents, count, bottom - top - below - 3)
    size, layout = parts.map, parts.table
    draw_plan_track(paper.axes(_EDGE + 13, top + 9, size - 14, size - 18), design, band, 6.5)
    _abort_box(paper, contents, _EDGE + size + 5, top, _INNER - size - 5, size)
    y = top + size + 3
    panels = [
        paper.axes(_EDGE + 13, y + i * parts.panel, _INNER - 26, parts.panel * 0.84)
        for i in range(count)
    ]
    draw_commands(panels, design, band.trial, 6.5)
    y = paper.lines(_EDGE, y + count * parts.panel + 9, note, 6.2, color="0.25") + 0.6
    _table(paper, layout, y, 0)
    _sign(paper, bottom)
    pages, first = [paper.figure], layout.capacity
    while first < contents.rows:
        paper = _Paper()
        paper.text(_EDGE, _EDGE, f"{contents.title}, continued", 12, fontweight="bold")
        rows = int((_HEIGHT - 2 * _EDGE - 20) / (layout.size * _LEADING * _POINT) - 2.4)
        longer = TableLayout(layout.columns, layout.blocks, rows, layout.size)
        _table(paper, longer, _EDGE + 9, first)
        _sign(paper, bottom)
        pages.append(paper.figure)
        first += longer.capacity
    if len(pages) > 1:
        for k, page in enumerate(pages):
            page.text(
                1 - _EDGE / _WIDTH, 1 - 8 / _HEIGHT, f"page {k + 1} of {len(pages)}",
                ha="right", va="top", fontsize=7,
            )  # fmt: skip
    return pages


def _contents(design: Design, band: MotionBand, legs: LegPlan | None) -> SheetContents:
    return sheet_contents(design, band, None if legs is None else legs.trials[band.trial])


def _head(paper: _Paper, contents: SheetContents) -> float:
    y = _EDGE
    title = wrap(contents.title, 58, max_lines=2, placeholder="…")
    y = paper.lines(_EDGE, y, title, 15, fontweight="bold") + 0.5
    y = paper.lines(_EDGE, y, wrap(contents.subtitle, 118), 8.5) + 1
    for name, text in contents.facts:
        paper.text(_EDGE, y, name, 8, fontweight="bold")
        y = paper.lines(_EDGE + 17, y, wrap(text, 112), 8)
    if contents.warnings:
        lines = wrap(" ".join(contents.warnings), 104)
        height = len(lines) * 1.32 * 8 * _POINT + 1.6
        paper.box(_EDGE, y + 0.6, _INNER, height, facecolor=_RED)
        paper.lines(_EDGE + 2, y + 1.5, lines, 8, color="white", fontweight="bold")
        y += height + 0.8
    return y + 2


def _abort_box(
    paper: _Paper, contents: SheetContents, left: float, top: float, width: float, height: float
) -> None:
    size = 8.0
    while True:
        letters = int((width - 9) / (0.53 * size * _POINT))
        items = [wrap(text, letters) for text in contents.abort]
        used = sum(len(i) * 1.32 * size * _POINT + 1.2 for i in items) + 17
        if used <= height or size <= 5:
            break
        size -= 0.25
    paper.box(left, top, width, height, facecolor="#fff6f1", edgecolor=_RED, linewidth=1.2)
    paper.text(left + 3, top + 3, "Abort when", 11, fontweight="bold", color=_RED)
    y = top + 10.5
    for item in items:
        paper.text(left + 3, y, "•", size)
        y = paper.lines(left + 6, y, item, size) + 1.2
    paper.text(
        left + 3, top + height - 2, "The master's judgement stands above this sheet.", 7,
        va="bottom", style="italic",
    )  # fmt: skip


def _table(paper: _Paper, layout: TableLayout, top: float, first: int) -> None:
    """Draw way-points from `first` on, in blocks side by side."""
    line = layout.size * _LEADING * _POINT
    width = (_INNER - (layout.blocks - 1) * _GAP) / layout.blocks
    widths = np.array([c.width for c in layout.columns])
    unit = _DIGIT * layout.size * _POINT
    # narrow tables are not stretched to where their rows cannot be followed
    gap = min((width / unit - widths.sum()) / len(widths), 4.0)
    expected = [c.name for c in layout.columns].index("hdg")
    last = min(first + layout.capacity, len(layout.columns[0].cells))
    for block in range(layout.blocks):
        begin = first + block * layout.rows
        if begin >= last:
            break
        left = _EDGE + block * (width + _GAP)
        rights = left + np.cumsum(widths + gap) * unit
        across = float((widths + gap).sum() * unit)
        paper.box(left, top, across, 2.2 * line, facecolor="#dde6ee")
        for column, right in zip(layout.columns, rights, strict=True):
            place = _edge_of(column, float(right) - 0.5 * gap * unit, unit)
            for k, words in enumerate((column.name, column.unit)):
                paper.text(
                    place, top + (0.6 + k) * line, words, layout.size - 0.4,
                    ha="left" if column.words else "right", va="center",
                    fontweight="bold" if k == 0 else "normal",
                )  # fmt: skip
        for k in range(begin, min(begin + layout.rows, last)):
            y = top + (k - begin + 2.75) * line
            if (k - begin) % 2:
                paper.box(left, y - 0.5 * line, across, line, facecolor=_GREY)
            for i, (column, right) in enumerate(zip(layout.columns, rights, strict=True)):
                paper.text(
                    _edge_of(column, float(right) - 0.5 * gap * unit, unit), y, column.cells[k],
                    layout.size, ha="left" if column.words else "right", va="center",
                    fontweight="bold" if i == 0 else "normal",
                    color="0.3" if i >= expected else "black",
                )  # fmt: skip


def _edge_of(column: Column, right: float, unit: float) -> float:
    """Return where the cells of a column stand: at its right edge, words at its left."""
    return right - column.width * unit if column.words else right


def _sign(paper: _Paper, bottom: float) -> None:
    words = (
        "Date ____________   Started (UTC) ____________   Ended ____________   "
        "Aborted because ______________________________   Master __________________"
    )
    paper.text(_EDGE, bottom, words, 6.8, va="bottom", color="0.2")


def _pdf(pages: list[Figure]) -> bytes:
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    out = io.BytesIO()
    # embedded as outlines that every printer knows
    with (
        rc_context({"pdf.fonttype": 42}),
        PdfPages(out, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as book,
    ):
        for page in pages:
            book.savefig(page)
    return out.getvalue()


def _stacked_png(pages: list[Figure]) -> bytes:
    from matplotlib import image

    rows = []
    for page in pages:
        raw = io.BytesIO()
        page.savefig(raw, format="rgba", dpi=_DPI)
        wide = int(page.bbox.width)
        rows.append(np.frombuffer(raw.getvalue(), np.uint8).reshape(-1, wide, 4))
    out = io.BytesIO()
    image.imsave(out, np.vstack(rows), format="png", dpi=_DPI)
    return out.getvalue()


def _stacked_svg(pages: list[Figure]) -> str:
    parts = [to_svg(page, f"sheet{k}") for k, page in enumerate(pages)]
    if len(parts) == 1:
        return f'<?xml version="1.0" encoding="utf-8"?>\n{parts[0]}'
    placed = [
        part.replace("<svg ", f'<svg y="{_HEIGHT * k}mm" ', 1) for k, part in enumerate(parts)
    ]
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="{_WIDTH:g}mm" height="{_HEIGHT * len(parts):g}mm">\n'
        + "\n".join(placed)
        + "</svg>\n"
    )


_TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ trials[0].contents.title }}</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.4 system-ui, sans-serif; margin: 0 auto; padding: 1rem; max-width: 60rem;
       color: #1a1a1a; background: #fff; }
h1 { font-size: 1.4rem; line-height: 1.2; margin: 0 0 0.3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 0 0 0.3rem; color: #8a1c00; }
p { margin: 0.2rem 0; overflow-wrap: anywhere; }
dl { margin: 0.3rem 0; display: grid; grid-template-columns: max-content 1fr; gap: 0 0.8rem; }
dt { font-weight: 600; } dd { margin: 0; }
.warning { background: #8a1c00; color: #fff; font-weight: 600; padding: 0.2rem 0.5rem; }
.top { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr));
       gap: 1rem; margin: 0.6rem 0; }
figure { margin: 0; }
figure svg { width: 100%; height: auto; display: block; }
.abort { border: 1.5px solid #8a1c00; background: #fff6f1; padding: 0.6rem 0.8rem; }
.abort ul { margin: 0; padding-left: 1.1rem; } .abort li { margin-bottom: 0.3rem; }
.wide { overflow-x: auto; }
.commands svg { min-width: 34rem; }
.note { font-size: 0.85rem; color: #444; }
.blocks { display: flex; flex-wrap: wrap; gap: 0 1rem; align-items: flex-start; }
.blocks .wide { max-width: 100%; flex: 1 1 auto; }
table { border-collapse: collapse; font-size: 0.85rem; line-height: 1.3; width: 100%;
        font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 0 0.35rem; white-space: nowrap; }
th.words, td.words { text-align: left; white-space: normal; }
th { background: #dde6ee; } th span { display: block; font-weight: 400; }
tbody th { background: none; } tbody tr:nth-child(even) { background: #f0f0f0; }
.sign { margin-top: 0.6rem; }
section + section { border-top: 2px solid #ddd; margin-top: 2rem; padding-top: 1rem; }
@page { size: A4 portrait; margin: 10mm; }
@media print {
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  body { max-width: none; padding: 0; margin: 0; font-size: 8pt; line-height: 1.25; }
  h1 { font-size: 13pt; } h2 { font-size: 10pt; }
  section + section { border: 0; margin: 0; padding: 0; break-before: page; }
  .top { grid-template-columns: 92mm 1fr; gap: 4mm; margin: 1.5mm 0; }
  .abort { padding: 1.5mm 3mm; } .abort li { margin-bottom: 0.8mm; }
  .abort ul { font-size: 7.6pt; }
  .wide { overflow: visible; }
  .commands svg { min-width: 0; width: 100%; }
  .note { font-size: 6.5pt; margin: 0.5mm 0; }
  .blocks { flex-wrap: nowrap; gap: 0 4mm; }
  .sign { font-size: 7pt; margin: 1.5mm 0 0; white-space: pre; }
  th, td { padding: 0 0.25em; }
  tr { break-inside: avoid; }
}
</style>
</head>
<body>
{% for trial in trials %}{% set b = trial.contents %}<section>
<h1>{{ b.title }}</h1>
<p>{{ b.subtitle | tie }}</p>
<dl>{% for name, text in b.facts %}<dt>{{ name }}</dt><dd>{{ text | tie }}</dd>{% endfor %}</dl>
{% if b.warnings %}<p class="warning">{{ b.warnings | join(" ") }}</p>
{% endif %}<div class="top" id="top{{ loop.index }}">
<figure role="img" aria-label="{{ trial.track_words }}">{{ trial.track | safe }}</figure>
<div class="abort"><h2>Abort when</h2><ul>{% for text in b.abort %}<li>{{ text | tie }}</li>
{% endfor %}</ul><p><em>The master's judgement stands above this sheet.</em></p></div>
</div>
<div class="wide commands"><figure role="img" aria-label="{{ trial.commands_words }}">
{{ trial.commands | safe }}</figure></div>
<p class="note">{{ b.note }}</p>
<style>@media print { #top{{ loop.index }} { grid-template-columns: {{ trial.map }}mm 1fr; }
 #points{{ loop.index }} table { font-size: {{ trial.size }}pt;
 line-height: {{ trial.leading }}; } }</style>
<div class="blocks" id="points{{ loop.index }}">
{% for rows in trial.blocks %}<div class="wide"><table>
<thead><tr>{% for c in trial.columns %}<th scope="col"
{%- if c.words %} class="words"{% endif %}>{{ c.name }}<span>{{ c.unit }}</span></th>
{%- endfor %}</tr></thead>
<tbody>{% for row in rows %}<tr><th scope="row">{{ row[0] }}</th>{% for cell in row[1:] %}<td
{%- if trial.columns[loop.index].words %} class="words"{% endif %}>
{{- cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}</div>
<p class="sign">Date __________   Started (UTC) __________   Ended __________   Aborted because
 {{- " " }}______________________   Master ______________</p>
</section>
{% endfor %}</body>
</html>
"""


def _html(design: Design, bands: tuple[MotionBand, ...], legs: LegPlan | None) -> str:
    from jinja2 import Environment

    trials = [_section(design, band, legs) for band in bands]
    environment = Environment(autoescape=True, trim_blocks=True)
    environment.filters["tie"] = tie
    return environment.from_string(_TEMPLATE).render(trials=trials)


def _section(design: Design, band: MotionBand, legs: LegPlan | None) -> dict[str, Any]:
    """Return what the page needs of one trial."""
    contents = _contents(design, band, legs)
    count = len(design.request.schedule.commands)
    fixed = 34 + 15 + 8 + 5 * (len(" ".join(contents.warnings)) // 110 + bool(contents.warnings))
    parts = lay_out_page(contents, count, _HEIGHT - 2 * 10 - fixed)
    layout = parts.table
    cells = list(zip(*[c.cells for c in layout.columns], strict=True))
    rows = -(-len(cells) // layout.blocks)
    size = parts.map
    track = Figure(figsize=(size / 25.4, size / 25.4))
    draw_plan_track(
        track.add_axes((13 / size, 9 / size, 1 - 14 / size, 1 - 20 / size)), design, band, 6.5
    )
    commands = new_figure(_INNER / 25.4, (count * parts.panel + 8) / 25.4)
    draw_commands(commands.subplots(count, 1, squeeze=False)[:, 0], design, band.trial, 6.8)
    north, east = band["x_n"].nominal, band["y_n"].nominal
    schedule = design.request.schedule
    return {
        "contents": contents,
        "columns": layout.columns,
        "blocks": [cells[k : k + rows] for k in range(0, len(cells), rows)],
        "size": f"{layout.size:.2f}",
        "leading": f"{_LEADING:g}",
        "map": f"{parts.map:g}",
        "track": to_svg(track, f"track{band.trial}"),
        "commands": to_svg(commands, f"commands{band.trial}"),
        "track_words": (
            f"Map, north up: the expected track covers {np.ptp(north):.0f} m from south to north "
            f"and {np.ptp(east):.0f} m from west to east; its way-points are in the table below."
        ),
        "commands_words": (
            f"Steps of {', '.join(schedule.commands)} against time, as in the table below."
        ),
    }
