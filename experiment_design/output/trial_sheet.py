"""The sheet to take on board: one A4 page a trial, as HTML, PDF, SVG or PNG."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiment_design.output.legs import LegPlan
from experiment_design.output.pictures import draw_commands, draw_plan_track
from experiment_design.output.prediction import MotionBand, predict_motion
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import (
    Column,
    SheetContents,
    sheet_contents,
    shown_as,
    tie,
)
from greybox.errors import UsageError
from greybox.files import replacing, write_text
from greybox.report.figures import new_figure, to_svg

KINDS = (".pdf", ".svg", ".png", ".html", ".htm")

# A4 portrait, and what its margins of 10 mm leave, in millimetres
_WIDTH, _HEIGHT = 210.0, 297.0
_INNER_WIDTH, _INNER_HEIGHT = 190.0, 277.0
# at which the smallest text of a picture is legible
_DPI = 200
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
# rows that the two lines of the header take
_HEADER = 2.2
# title, facts, note and signature beside their texts of more than a line [mm]
_WORDS = 44.0
# letters of a line of text across the page, of the note below the commands, of an item beside
# the map for each mm of it, and the height of a line [mm]
_ACROSS, _NOTE, _BESIDE, _LINE = 115, 150, 0.68, 3.6


@dataclass(frozen=True)
class Layout:
    """How a page is shared out.

    ``map`` and ``panel`` are the sizes [mm] of the map and of each command's panel; the
    table below them has ``blocks`` side by side of ``rows`` each, its text ``size`` [points].
    """

    map: float
    panel: float
    columns: tuple[Column, ...]
    blocks: int
    rows: int
    size: float

    @property
    def capacity(self) -> int:
        """Way-points that fit."""
        return self.blocks * self.rows

    @property
    def widest(self) -> float:
        """Width of a block [em] past which the eye does not follow its rows."""
        return sum(c.width + 4.0 for c in self.columns) * _DIGIT


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
            f"the sheet '{Path(path).name}' cannot be written with this ending: use .pdf, "
            f".html, .svg or .png."
        )
    return ".html" if kind == ".htm" else kind


def write_sheet(design: Design, path: str | Path, legs: LegPlan | None = None) -> None:
    """Write the sheet to take on board, one A4 page a trial.

    A table of more way-points than one page holds legibly continues on another page. A
    browser prints the HTML as the same pages. Pages are stacked in a PNG, and in an SVG,
    which holds them as a picture.

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
        It ends otherwise, or nothing is installed that draws what it asks for.
    """
    kind = sheet_kind(path)
    if kind != ".html":
        _require_printer(path)
    design = design.from_first_command()
    trials = [_trial(design, band, legs) for band in predict_motion(design)]
    if kind == ".html":
        write_text(_html(trials), path)
        return
    data = _printed(_html(trials, fonts=_fonts()), kind)
    with replacing(path, "wb") as handle:
        handle.write(data)


def lay_out(contents: SheetContents, commands: int) -> Layout:
    """Share a page between map, commands and the way-point table.

    Parameters
    ----------
    contents : SheetContents
    commands : int
        Number of panels.
    """
    found: list[Layout] = []
    for wanted in _COMFORTABLE:
        found = []
        for size, panels in _PARTS:
            panel = float(np.clip(panels / commands, 5.5, 18))
            room = _INNER_HEIGHT - _words_height(contents, size) - panel * commands
            layout = _lay_out_table(contents, size, panel, max(room, 10.0))
            found.append(layout)
            if layout.capacity >= contents.rows and layout.size >= wanted - 1e-9:
                return layout
    # it needs another page anyway
    return found[1]


def _words_height(contents: SheetContents, size: float) -> float:
    """Return the height [mm] of all but commands and table, with a map of a size [mm]."""
    longer = [contents.subtitle, *(text for _, text in contents.facts)]
    lines = sum(len(text) // _ACROSS for text in longer)
    lines += len(contents.title) // 60 + len(contents.note) // _NOTE
    if contents.warnings:
        lines += 2 + len(" ".join(contents.warnings)) // (_ACROSS - 10)
    beside = _BESIDE * (_INNER_WIDTH - size)
    items = sum(1 + int(len(text) / beside) for text in contents.abort)
    abort = items * 3.4 + len(contents.abort) + 14
    return _WORDS + lines * _LINE + max(size, abort)


def _lay_out_table(contents: SheetContents, size: float, panel: float, height: float) -> Layout:
    """Return the most legible layout of a way-point table in a room of a height [mm].

    Angles are given in degrees and radians where there is room for both.
    """
    best: Layout | None = None
    for columns in (contents.columns, contents.narrow):
        for blocks in (1, 2, 3):
            rows = -(-contents.rows // blocks)
            characters = sum(c.width + 1.4 for c in columns)
            width = (_INNER_WIDTH - (blocks - 1) * _GAP) / blocks
            across = width / characters / (_DIGIT * _POINT)
            along = height / (rows + _HEADER) / (_LEADING * _POINT)
            text = min(across, along, _LARGEST)
            if text < _SMALLEST <= across:
                # what does not fit at the smallest text goes on to the next page
                rows, text = _rows(height, _SMALLEST), _SMALLEST
            layout = Layout(size, panel, columns, blocks, rows, text)
            if best is None or _rank(layout, contents) > _rank(best, contents):
                best = layout
        if best is not None and best.size >= _BOTH_FROM and best.capacity >= contents.rows:
            break
    assert best is not None
    return best


def _rows(height: float, size: float) -> int:
    """Return how many rows of a text size [points] a height [mm] holds below the header."""
    return max(1, int(height / (size * _LEADING * _POINT) - _HEADER))


def _rank(layout: Layout, contents: SheetContents) -> tuple[bool, int, float]:
    legible = layout.size >= _SMALLEST - 1e-9
    return legible, min(layout.capacity, contents.rows), layout.size


def _trial(design: Design, band: MotionBand, legs: LegPlan | None) -> dict[str, Any]:
    """Return what the template needs of one trial."""
    contents = sheet_contents(design, band, None if legs is None else legs.trials[band.trial])
    schedule = design.request.schedule
    count = len(schedule.commands)
    layout = lay_out(contents, count)
    cells = list(zip(*[c.cells for c in layout.columns], strict=True))
    # what stands above a table that goes on, and below it, takes 20 mm
    later = _rows(_INNER_HEIGHT - 20, layout.size) * layout.blocks
    edges = [0, *range(min(layout.capacity, len(cells)), len(cells), later), len(cells)]
    size = layout.map
    track = Figure(figsize=(size / 25.4, size / 25.4))
    draw_plan_track(
        track.add_axes((13 / size, 9 / size, 1 - 14 / size, 1 - 20 / size)), design, band, 6.5
    )
    commands = new_figure(_INNER_WIDTH / 25.4, (count * layout.panel + 8) / 25.4)
    draw_commands(commands.subplots(count, 1, squeeze=False)[:, 0], design, band.trial, 6.8)
    north, east = band["x_n"].nominal, band["y_n"].nominal
    names = [shown_as(design.request.vessel, c)[0] for c in schedule.commands]
    return {
        "contents": contents,
        "layout": layout,
        "expected": [c.name for c in layout.columns].index("hdg"),
        "pages": [_split(cells[a:b], layout.blocks) for a, b in pairwise(edges)],
        "track": to_svg(track, f"track{band.trial}"),
        "commands": to_svg(commands, f"commands{band.trial}"),
        "track_words": (
            f"Map, north up: the expected track covers {np.ptp(north):.0f} m from south to north "
            f"and {np.ptp(east):.0f} m from west to east; its way-points are in the table below."
        ),
        "commands_words": (f"Steps of {', '.join(names)} against time, as in the table below."),
    }


def _split(rows: Sequence[Any], blocks: int) -> list[Sequence[Any]]:
    size = -(-len(rows) // blocks)
    return [rows[k : k + size] for k in range(0, len(rows), size)]


def _html(trials: list[dict[str, Any]], fonts: Sequence[tuple[str, str, str]] = ()) -> str:
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True)
    environment.filters["tie"] = tie
    source = resources.files("experiment_design.output") / "trial_sheet.html"
    template = environment.from_string(source.read_text("utf-8"))
    return template.render(trials=trials, leading=_LEADING, fonts=fonts)


def _fonts() -> list[tuple[str, str, str]]:
    """Return weight, style and address of the fonts that Matplotlib brings with it.

    A sheet looks the same on a machine with other fonts, or with none.
    """
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    return [
        (weight, style, (folder / f"DejaVuSans{name}.ttf").as_uri())
        for weight, style, name in (
            ("400", "normal", ""), ("700", "normal", "-Bold"), ("400", "italic", "-Oblique"),
        )
    ]  # fmt: skip


def _require_printer(path: str | Path) -> None:
    try:
        import plutoprint  # noqa: F401
    except ImportError:
        raise UsageError(
            f"the sheet '{Path(path).name}' needs the package plutoprint, which is not installed "
            f"here: write the sheet as .html and print it with a browser, or install plutoprint."
        ) from None


def _printed(html: str, kind: str) -> bytes:
    """Return the pages that a browser would print, as PDF, PNG or SVG."""
    import plutoprint as printer

    book = printer.Book(printer.PAGE_SIZE_A4)
    book.load_html(html)
    out = io.BytesIO()
    if kind == ".pdf":
        # the same plan gives the same bytes
        book.set_metadata(printer.PDF_METADATA_CREATION_DATE, "")
        book.write_to_pdf_stream(out)
        return out.getvalue()
    # a canvas of pixels is drawn on in pixels of CSS, 96 to the inch
    pages, zoom = book.get_page_count(), _DPI / 96
    wide, high = (round(v / 25.4 * _DPI) for v in (_WIDTH, _HEIGHT))
    canvas = printer.ImageCanvas(wide, high * pages, printer.IMAGE_FORMAT_RGB24)
    canvas.clear_surface(1, 1, 1)
    for k in range(pages):
        canvas.set_matrix(zoom, 0, 0, zoom, 0, high * k)
        book.render_page(canvas, k)
    canvas.write_to_png_stream(out)
    if kind == ".png":
        return out.getvalue()
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<svg xmlns="http://www.w3.org/2000/svg" '
        f'xmlns:xlink="http://www.w3.org/1999/xlink" width="{_WIDTH:g}mm" '
        f'height="{_HEIGHT * pages:g}mm"><image width="100%" height="100%" '
        f'xlink:href="data:image/png;base64,{b64encode(out.getvalue()).decode()}"/></svg>\n'
    ).encode()
