"""One self-contained HTML page: a headline, pictures, tables, how it was computed."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from greybox.files import write_text
from greybox.report.next_steps import NextStep

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

    from greybox.report.chart import Chart


@dataclass(frozen=True)
class Picture:
    """An SVG with the text below it, and the one that stands for it (the caption by default).

    Narrow ones stand beside one another where the window has room. Broad ones, of several
    columns, keep a legible size on a phone, where they scroll sideways. One with a chart
    can be zoomed on screen.
    """

    svg: str
    caption: str
    alternative: str = ""
    narrow: bool = False
    broad: bool = False
    chart: Chart | None = None


@dataclass(frozen=True)
class Table:
    """A table of already formatted cells; one of sentences wraps them."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    sentences: bool = False


@dataclass(frozen=True)
class Marked:
    """Text in pieces, some of them marked as new or as gone."""

    title: str
    pieces: Sequence[tuple[str, Literal["", "ins", "del"]]]


@dataclass(frozen=True)
class Section:
    """A part of a page under a heading of its own, such as one log of several.

    ``command`` is what a user types for it.
    """

    title: str
    sentences: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    texts: Sequence[tuple[str, str]] = ()
    points: Sequence[str] = ()
    marked: Sequence[Marked] = ()
    command: str = ""


@dataclass(frozen=True)
class Page:
    """What a page shows, in its order.

    Parameters
    ----------
    title : str
    headline : str
        The verdict: whether what was made can be used.
    lead : Picture, optional
        What shows the verdict; with it and what to do next it fills the first screen.
    next_steps : sequence of NextStep
        What to do next, the first first.
    sentences, pictures, tables, texts, sections
        What follows on the first screen.
    computed : dict
        How it was computed.
    """

    title: str
    headline: str
    sentences: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    texts: Sequence[tuple[str, str]] = ()
    computed: dict[str, Any] = field(default_factory=dict)
    sections: Sequence[Section] = ()
    lead: Picture | None = None
    next_steps: Sequence[NextStep] = ()


_NONE = "'none'"
_TEMPLATE = """{% macro drawn(picture) %}{% set chart = chart_of(picture) %}
<figure role="group" class="{{ 'narrow ' if picture.narrow }}
{{- 'broad ' if picture.broad }}{{ 'zoomable' if chart }}"
 aria-label="{{ picture.alternative or picture.caption }}">
{{ picture.svg | safe }}
{% if chart %}
<div class="zoom" id="{{ chart[0] }}" role="group"
 aria-label="{{ picture.alternative or picture.caption }}"></div>
<button type="button" hidden aria-expanded="false" aria-controls="{{ chart[0] }}">
{{- "Zoom and read values" }}</button>
<script type="application/json">{{ chart[1] | safe }}</script>
{% endif %}
<figcaption>{{ picture.caption | tie_units }}</figcaption></figure>
{% endmacro %}
{% macro figures(of) %}
{% if of.pictures %}<div class="pictures">
{% for picture in of.pictures %}{{ drawn(picture) }}{% endfor %}
</div>
{% endif %}
{% endmacro %}
{% macro words(of, level) %}
{% for sentence in of.sentences %}<p>{{ sentence | tie_units }}</p>
{% endfor %}
{% if of.points %}<ul>{% for point in of.points %}<li>{{ point | tie_units }}</li>
{% endfor %}</ul>
{% endif %}
{% for part in of.marked %}<{{ level }}>{{ part.title }}</{{ level }}><pre class="marked">
{%- for text, mark in part.pieces %}{% if mark %}<{{ mark }}>{{ text }}</{{ mark }}>
{%- else %}{{ text }}{% endif %}{% endfor %}</pre>
{% endfor %}
{% endmacro %}
{% macro numbers(of) %}
{% for table in of.tables %}<div class="wide"><table
{%- if table.sentences %} class="sentences"{% endif %}>
<caption><span>{{ table.caption }}</span></caption>
<thead><tr>{% for cell in table.header %}<th scope="col">{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in table.rows %}<tr>{% for cell in row %}<td
{%- if table.sentences and 0 < loop.index0 < row | length - 1 %} data-name="
{{- table.header[loop.index0] }}"{% elif not table.sentences and cell | length > 40 %} class="long"
{%- endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}
{% endmacro %}
{% macro texts(of, level) %}
{% for heading, text in of.texts %}<{{ level }}>{{ heading }}</{{ level }}><pre>{{ text }}</pre>
{% endfor %}
{% endmacro %}
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{{ policy }}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ page.title }}</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 1rem; max-width: 70rem;
       color: #1a1a1a; background: #fff; overflow-wrap: break-word; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: 0.5rem 0; }
section { border-top: 2px solid #ddd; margin-top: 2rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
h2 { font-size: 1.15rem; margin: 1.6rem 0 0.4rem; }
.headline { font-size: 1.15rem; border-left: 4px solid #0072B2; padding-left: 0.8rem; }
.next h2 { margin: 0.8rem 0 0.2rem; } .next ul { margin: 0; padding-left: 1.2rem; }
.next li { overflow-wrap: anywhere; } .next li + li { margin-top: 0.4rem; }
.next code { font-size: 0.85rem; background: #f6f6f6; }
.next code span { display: inline-block; max-width: 100%; }
.lead figure { margin: 0.6rem 0 0; } .whole { white-space: nowrap; }
@media screen and (min-width: 900px) {
  .first.led { display: grid; grid-template: auto 1fr / minmax(0, 2fr) minmax(0, 3fr);
               gap: 0 2rem; }
  .led .lead { grid-area: 1 / 2 / 3 / 3; } .led .headline { margin-top: 0; }
  .lead figure { margin: 0; } .lead figure > svg { max-height: 34rem; } }
.pictures { display: grid; gap: 0 1.5rem; align-items: start;
            grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); }
figure { margin: 1rem 0; min-width: 0; grid-column: 1 / -1; }
figure.narrow { grid-column: auto; }
figure > svg { display: block; width: 100%; height: auto; max-width: 48rem; }
figcaption { font-size: 0.9rem; color: #444; }
button { font: inherit; font-size: 0.9rem; margin: 0.2rem 0; padding: 0.3rem 0.8rem;
         color: #005a8e; background: #fff; border: 1px solid #0072B2; border-radius: 4px; }
.zoom { display: none; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.6rem; border-bottom: 1px solid #ddd; text-align: right;
         white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td:first-child { white-space: normal; max-width: 18rem; overflow-wrap: break-word; }
td.long { white-space: normal; overflow-wrap: anywhere; }
td.long:not(:first-child) { min-width: 10rem; }
table.sentences th, table.sentences td { text-align: left; white-space: normal;
         vertical-align: top; }
table.sentences td:last-child { overflow-wrap: anywhere; }
caption { text-align: left; font-weight: 600; padding: 0.3rem 0; }
caption span { display: inline-block; position: sticky; left: 0;
               max-width: calc(100vw - 2rem); }
pre { font-size: 0.8rem; overflow-x: auto; background: #f6f6f6; padding: 0.6rem; }
pre.marked { white-space: pre-wrap; }
ins { background: #cfe8fc; text-decoration: underline; font-weight: 600; }
del { background: #f9ddcc; }
@page { size: A4; margin: 15mm; }
@media screen { .open > svg { display: none; } .open > .zoom { display: block; }
  figure.narrow.open { grid-column: 1 / -1; } }
@media screen and (max-width: 600px) {
  figure.broad { overflow-x: auto; } figure.broad > svg { width: 44rem; max-width: none; }
  figure.broad figcaption { position: sticky; left: 0; }
  table.sentences, table.sentences tbody, table.sentences caption { display: block;
    width: auto; }
  table.sentences thead { display: none; }
  table.sentences tr { display: flex; flex-wrap: wrap; border-bottom: 1px solid #ddd; }
  table.sentences td { border: 0; } table.sentences td:first-child { font-weight: 600;
    max-width: 100%; overflow-wrap: anywhere; }
  table.sentences td:last-child { flex-basis: 100%; }
  td[data-name]::before { content: attr(data-name) ": "; color: #444; }
  td[data-name]:empty { display: none; }
  table { font-size: 0.8rem; } th, td { padding: 0.2rem 0.3rem; } th { white-space: normal; }
  td:first-child { position: sticky; left: 0; background: #fff; max-width: 8rem; } }
@media print { button { display: none; } html { font-size: 11px; }
  .lead figure > svg { max-height: 170mm; }
  figure > svg { max-width: 150mm; } body { max-width: none; font-size: 1rem; }
  figure { break-inside: avoid; }
  .pictures { grid-template-columns: 1fr 1fr; } h2, h3 { break-after: avoid; }
  .wide { overflow: visible; } th, td { white-space: normal; padding: 0.2rem 0.3rem; }
  td:first-child { max-width: 16rem; overflow-wrap: anywhere; min-width: 4rem; }
  .sentences td:first-child { max-width: none; width: 22%; min-width: 9rem; }
  tr, li { break-inside: avoid; }
  caption, thead, tr:nth-child(-n+2) { break-after: avoid; } tr:last-child { break-after: auto; }
  tr:nth-last-child(-n+2):not(:first-child) { break-before: avoid; }
  pre { white-space: pre-wrap; } }
</style>
</head>
<body>
<h1>{{ page.title }}</h1>
<div class="first{{ ' led' if page.lead }}">
<p class="headline">{{ page.headline | tie_units }}</p>
{% if page.next_steps %}<div class="next"><h2>What to do next</h2>
<ul>{% for step in page.next_steps %}<li>{{ step.purpose }}{% if step.command %}: <code>
{%- for word in step.command.split(" ") %}<span>{{ word }}</span>{{ " " if not loop.last }}
{%- endfor %}</code>{% else %}.{% endif %}</li>
{% endfor %}</ul></div>
{% endif %}
{% if page.lead %}<div class="lead">{{ drawn(page.lead) }}</div>
{% endif %}
</div>
{{ figures(page) }}{{ numbers(page) }}{{ words(page, "h2") }}{{ texts(page, "h2") }}
{% for section in page.sections %}<section>
<h2>{{ section.title }}</h2>
{% if section.command %}<pre class="marked">{{ section.command }}</pre>
{% endif %}
{{ figures(section) }}{{ words(section, "h3") }}{{ numbers(section) }}{{ texts(section, "h3") }}
</section>
{% endfor %}
<h2>How this was computed</h2>
<div class="wide"><table class="sentences"><tbody>
{% for key, value in page.computed.items() %}<tr><td>{{ key }}</td><td>{{ value }}</td></tr>
{% endfor %}</tbody></table></div>
{% for script in scripts %}<script>{{ script | safe }}</script>
{% endfor %}
</body>
</html>
"""


def render(page: Page) -> str:
    """Return the page as HTML; every value from a log is escaped.

    Its policy forbids the network and every script but its own two, which are
    there only where a picture can be zoomed.
    """
    charts: dict[int, tuple[str, str]] = {}
    scripts: list[str] = []
    shown = [
        *([page.lead] if page.lead else []),
        *page.pictures,
        *(p for section in page.sections for p in section.pictures),
    ]
    zoomable = [p for p in shown if p.chart]
    if zoomable:
        from greybox.report.interactive import chart_json, library, opener

        for i, picture in enumerate(zoomable):
            assert picture.chart is not None
            charts[id(picture)] = (f"zoom{i}", chart_json(picture.chart, f"zoom{i}"))
        scripts = [library(), opener()]
    return _template().render(
        page=page,
        chart_of=lambda picture: charts.get(id(picture)),
        scripts=scripts,
        policy=_policy(scripts),
    )


@cache
def _template() -> Template:
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True)
    environment.filters["tie_units"] = _keep_whole
    return environment.from_string(_TEMPLATE)


def _policy(scripts: Sequence[str]) -> str:
    """Return what a browser may load for the page: its own scripts, by their hashes."""
    hashes = [f"'sha256-{b64encode(sha256(s.encode()).digest()).decode()}'" for s in scripts]
    return (
        "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; "
        f"style-src 'unsafe-inline'; script-src {' '.join(hashes or [_NONE])}"
    )


def tie_units(text: str) -> str:
    """Return text in which a line does not end between a number and its unit."""
    return re.sub(r"(?<=\d) (?=(?:m/s|rad/s|kn|m|s|%|min)(?:\W|$))", "\u00a0", text)


def _keep_whole(text: str) -> Markup:
    """Return text as HTML in which a line does not end within an option of a command."""
    from markupsafe import Markup, escape

    whole = r"(?<![\w-])(--[a-z][a-z-]*(?: [a-z][a-z_]*(?=\)))?)"
    return Markup(re.sub(whole, r'<span class="whole">\1</span>', str(escape(tie_units(text)))))


def capital(text: str) -> str:
    """Return a sentence with a capital; one of another alphabet would be another symbol."""
    return text[:1].upper() + text[1:] if text[:1].isascii() else text


def write_page(page: Page, path: str | Path) -> None:
    """Write the page, replacing the file in one step."""
    write_text(render(page), path)


_MACHINES = ("program", "versions", "command", "line", "inputs", "logs", "validate")


def computed(record: Mapping[str, Any]) -> dict[str, str]:
    """Return how a page was computed, one row an item, without wall time.

    Parameters
    ----------
    record : mapping
        As a command records it: ``line``, ``inputs``, ``versions``; what else it
        holds follows.
    """
    if "line" not in record:
        return flatten(dict(record))
    rows = {"command": str(record["line"])}
    if "seed" in record["command"]:
        rows["seed"] = str(record["command"]["seed"])
    rows |= {f"read {name}": f"SHA-256 {value}" for name, value in record["inputs"].items()}
    made = ", ".join(f"{n} {v}" for n, v in record["versions"].items())
    rows["computed with"] = f"{record['program']}, {made}"
    return rows | flatten({k: v for k, v in record.items() if k not in _MACHINES})


def flatten(record: dict[str, Any]) -> dict[str, str]:
    """Return a record of a computation as rows of text."""
    rows: dict[str, str] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            rows |= {f"{key} {k}": v for k, v in flatten(value).items()}
        elif isinstance(value, (list, tuple)):
            rows[key] = ", ".join(
                " ".join(map(str, v.values())) if isinstance(v, dict) else _short(v) for v in value
            )
        else:
            rows[key] = _short(value)
    return rows


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
