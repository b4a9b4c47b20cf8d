"""How results show themselves: one line in a terminal, tables in a notebook.

HTML is written here and nowhere else for notebooks: every word of it is escaped, it
is well-formed XML, and it takes its colours from the page around it.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

_LINE = 100
_PIXELS = (120, 24)
_STYLES = ("opacity:0.55", "")
_LEFT, _RIGHT = (f' style="text-align:{side};padding:0 0.5em"' for side in ("left", "right"))
# what no XML document may hold, escaped or not
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class DisplayMixin(ABC):
    """A result that people read.

    ``repr`` is one line. A notebook shows that line, then what matters most, then
    the whole summary to unfold.
    """

    @abstractmethod
    def summary(self) -> str:
        """Return the result as text."""

    def _line(self) -> str:
        """Return the result in one line: what it is, and its verdict."""
        return next((x.strip() for x in self.summary().splitlines() if x.strip()), "")

    def _parts(self) -> Iterable[str]:
        """Return what a notebook shows below that line, as `table`, `items` and `text` make it."""
        return ()

    def __repr__(self) -> str:
        line = " ".join(self._line().split())
        return f"<{type(self).__name__}: {line if len(line) <= _LINE else line[:_LINE] + '…'}>"

    def _repr_html_(self) -> str:
        parts, whole = [p for p in self._parts() if p], self.summary()
        pre = f"<pre>{escaped(whole)}</pre>"
        if not parts:
            return f'<div class="greybox">{pre}</div>'
        head = f"<p><strong>{escaped(self._line())}</strong></p>"
        more = f"<details><summary>Summary</summary>{pre}</details>"
        return f'<div class="greybox">{head}{"".join(parts)}{more}</div>'


class Html(str):
    """Text that is HTML already, such as a picture in a cell of a `table`."""


def escaped(value: object) -> str:
    """Return a value as text of an HTML page."""
    return escape(_FORBIDDEN.sub("\ufffd", str(value)))


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as a reader needs it; a dash where there is none."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.{digits}g}"


def with_error(value: float, std: float) -> str:
    """Return a value with its standard error, both to the second digit of the latter."""
    if not np.isfinite(std) or std <= 0:
        return number(value)
    last = int(np.floor(np.log10(std))) - 1
    if -7 <= last <= 0 and abs(value) < 1e6:
        return f"{value:z.{-last}f} ± {std:.{-last}f}"
    first = int(np.floor(np.log10(abs(value)))) if value else last + 1
    return f"{value:.{max(first - last, 0)}e} ± {std:.1e}"


def interval(value: float, std: float, digits: int = 3) -> str:
    """Return the 95 % interval of a normal estimate."""
    if not np.isfinite([value, std]).all():
        return "–"
    return f"{value - 1.96 * std:.{digits}g} to {value + 1.96 * std:.{digits}g}"


def table(head: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> str:
    """Return a table; empty where it has no rows. Numbers stand to the right."""
    body = [list(row) for row in rows]
    if not body:
        return ""
    right = [all(_numeric(row[k]) for row in body) for k in range(len(head))]
    sides = [_RIGHT if r else _LEFT for r in right]
    caption = f"<caption{_LEFT}>{escaped(title)}</caption>" if title else ""
    top = "".join(f"<th{s}>{escaped(h)}</th>" for h, s in zip(head, sides, strict=True))
    lines = "".join(
        "<tr>"
        + "".join(f"<td{s}>{_cell(c)}</td>" for c, s in zip(row, sides, strict=True))
        + "</tr>"
        for row in body
    )
    return f"<table>{caption}<thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table>"


def parameters(rows: Iterable[tuple[str, float, float, str]], title: str = "") -> str:
    """Return a table of parameters: name, value, standard error, 95 % interval, unit."""
    return table(
        ("parameter", "value", "std err", "95 %", "unit"),
        [(n, number(v), number(s, 2), interval(v, s), u) for n, v, s, u in rows],
        title,
    )


def items(title: str, lines: Iterable[object]) -> str:
    """Return a titled list; empty where it has no lines."""
    points = "".join(f"<li>{escaped(line)}</li>" for line in lines)
    return f"<p>{escaped(title)}</p><ul>{points}</ul>" if points else ""


def text(line: object) -> str:
    """Return a paragraph; empty where there is nothing to say."""
    return f"<p>{escaped(line)}</p>" if line else ""


def sparkline(*series: ArrayLike) -> str:
    """Return signals (N,) as one small picture, the last one in full colour.

    Where there are more samples than pixels, the least and the largest of each pixel.
    """
    arrays = [np.asarray(s, float) for s in series]
    finite = [a[np.isfinite(a)] for a in arrays]
    if not arrays or not any(len(f) for f in finite):
        return Html("")
    low = min(float(f.min()) for f in finite if len(f))
    high = max(float(f.max()) for f in finite if len(f))
    styles = _STYLES[-len(arrays) :] if len(arrays) < 3 else ("",) * len(arrays)
    lines = "".join(
        f'<polyline points="{_points(a, low, high)}" fill="none" stroke="currentColor" '
        f'stroke-width="1" style="{style}"/>'
        for a, style in zip(arrays, styles, strict=True)
    )
    w, h = _PIXELS
    return Html(
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}" height="{h}" role="img" '
        f'aria-label="from {low:.3g} to {high:.3g}">{lines}</svg>'
    )


def _points(a: np.ndarray, low: float, high: float) -> str:
    w, h = _PIXELS
    if len(a) > 2 * w:
        parts = [p[np.isfinite(p)] for p in np.array_split(a, w)]
        y = np.array([[p.min(), p.max()] if len(p) else [np.nan] * 2 for p in parts]).ravel()
        x = np.repeat(np.arange(w), 2) + 0.5
    else:
        x, y = np.linspace(0.5, w - 0.5, len(a)), a
    tall = h - 1 - (h - 2) * ((y - low) / (high - low) if high > low else 0.5 + 0 * y)
    return " ".join(f"{p:.1f},{q:.1f}" for p, q in zip(x, tall, strict=True) if np.isfinite(q))


def _cell(value: object) -> str:
    return str(value) if isinstance(value, Html) else escaped(value)


def _numeric(value: object) -> bool:
    if isinstance(value, int | float):
        return True
    bare = str(value)
    return bare in ("–", "") or (bare[0] in "-+.0123456789" and not isinstance(value, Html))
