"""Figures as Matplotlib objects; nothing here opens a window."""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from greybox.report.chart import Chart
from greybox.report.page import Picture
from greybox.report.thinning import find_gaps, pick, thin
from greybox.validation.bands import Bands
from greybox.validation.fit import LogFit, percent

Array = NDArray[np.float64]

# Okabe and Ito (2008): told apart by readers with any colour vision
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
STYLES = ("-", "--", "-.", ":")
LABELS = {
    "u": "surge u [m/s]",
    "v": "sway v [m/s]",
    "r": "yaw rate r [rad/s]",
    "psi": "heading ψ [rad]",
    "u_q": "u_q [m/s]",
    "v_q": "v_q [m/s]",
}


# inches: letters stay legible where the page is 390 px wide
_WIDTH = 5.2

# inches of a state's free run and its error: three fill the first screen in letters that are read
_RUN = 1.75

# inches that each further row of a legend needs
LEGEND_ROW = 0.17
# points: a letter of a legend, what stands before each of its names, and beside the axes
_LETTER, _HANDLE, _AXIS = 4.9, 24.0, 50.0

# coordinates, whose third decimal (a thousandth of a point) no screen and no printer shows
_PLACES = re.compile(r' d="[^"]*"| [xy]="[^"]*"|translate\([^)]*\)')
_LONG = re.compile(r"-?\d+\.\d{3,}")
_UNREAD = re.compile(r"<!--.*?-->|<metadata>.*?</metadata>")
_OWN = re.compile(r'<path id="([^"]+)"[^>]* style="([^"]*)"/>')
_USE = re.compile(r'(<use xlink:href="#([^"]+)"[^>]*?) style="([^"]*)"(?=/>)')
_STYLED = re.compile(r' style="([^"]*)"')
# as the names of marks and of clipped areas are made
_HASH = re.compile(r"[mp][0-9a-f]{10}")


def _rounded(found: re.Match[str]) -> str:
    return f"{float(found[0]):.2f}"


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out without overlaps."""
    return Figure(figsize=(width, height), layout="constrained")


def tidy(axes: Any) -> None:
    """Apply the common look to one pair of axes."""
    axes.grid(True, alpha=0.25, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def label_axes(axes: Any, x: str = "", y: str = "", title: str = "", size: float = 9) -> None:
    """Name what is given of one pair of axes, and apply the common look."""
    if x:
        axes.set_xlabel(x, fontsize=size)
    if y:
        axes.set_ylabel(y, fontsize=size)
    if title:
        axes.set_title(title, fontsize=size)
    axes.tick_params(labelsize=8)
    tidy(axes)


def legend_above(axes: Any, *given: Any, side: str = "left", columns: int = 1, **look: Any) -> None:
    """Put the legend of one pair of axes above it: of all that is drawn, or of what is given."""
    place = {"left": 0.0, "center": 0.5, "right": 1.0}[side]
    axes.legend(
        *given, loc=f"lower {side}", bbox_to_anchor=(place, 1.0), ncols=columns, fontsize=8,
        frameon=False, **look,
    )  # fmt: skip


def legend_outside(figure: Figure, axes: Any, place: str, columns: int, **look: Any) -> None:
    """Put what one pair of axes shows into a legend beside all axes of the figure."""
    figure.legend(
        *axes.get_legend_handles_labels(), loc=f"outside {place}", ncols=columns, frameon=False,
        **{"fontsize": 8, **look},
    )  # fmt: skip


def run_axes(
    figure: Figure, states: Sequence[str], labels: Mapping[str, str], error: str, size: float
) -> list[tuple[Any, Any]]:
    """Return for each state axes of a free run, and below them axes of its error."""
    grid = figure.add_gridspec(2 * len(states), 1, height_ratios=[1.6, 1] * len(states))
    first: Any = None
    pairs = []
    for i, state in enumerate(states):
        top = figure.add_subplot(grid[2 * i], sharex=first)
        first = first or top
        below = figure.add_subplot(grid[2 * i + 1], sharex=first)
        unit = labels.get(state, "").partition("[")[2]
        label_axes(top, y=labels.get(state, state).replace(" [", "\n["))
        label_axes(below, y=error + f"\n[{unit}" * bool(unit), size=size)
        for axes in (top, below):
            axes.yaxis.set_major_locator(MaxNLocator(4 if axes is top else 3))
            axes.tick_params(labelbottom=axes is below and i == len(states) - 1)
        pairs.append((top, below))
    below.set_xlabel("time from the first sample [s]", fontsize=9)
    return pairs


def draw_line(
    axes: Any, t: Array, value: Array, gaps: NDArray[np.intp], points: int, **style: Any
) -> None:
    """Draw a line of about so many points by its envelope, interrupted at gaps."""
    index = thin(gaps, np.nan_to_num(value), points=points)
    axes.plot(pick(t, index), pick(value, index), **style)


def comparison_figure(
    names: Sequence[str],
    runs: Sequence[LogFit],
    bands: Sequence[Bands | None] = (),
    *,
    points: int = 2000,
) -> Figure:
    """Draw measured against simulated states, with residuals and the track.

    Parameters
    ----------
    names : sequence of str
        Of the models.
    runs : sequence of LogFit
        One per model, all of one log.
    bands : sequence of Bands, optional
        One per model: where measurements should lie is shaded, about the run and about zero.
    points : int
        About how many a line has: longer ones are drawn by their envelopes.
    """
    log = runs[0].log
    bands = bands or [None] * len(runs)
    states = list(runs[0].fit)
    columns = legend_columns(["measured", *(f"{shorten(n)}: fit 100.0 %" for n in names)], _WIDTH)
    rows = -(-(len(names) + 1) // columns)
    figure = new_figure(_WIDTH, (_RUN + LEGEND_ROW * (rows - 1)) * len(states) + 0.6)
    t = log.t - log.t[0]
    gaps = find_gaps(log.t, log.sample_time)
    pairs = run_axes(figure, states, LABELS, "difference", 8)
    for i, (state, (top, below)) in enumerate(zip(states, pairs, strict=True)):
        measured = log[state]
        index = thin(gaps, measured, points=points)
        top.plot(
            pick(t, index),
            pick(log.measured(state), index),
            color=BLACK,
            linewidth=1.0,
            label="measured",
        )
        spread = float(np.ptp(measured)) or 1.0
        low, high = measured.min() - 0.6 * spread, measured.max() + 0.6 * spread
        for j, (name, run) in enumerate(zip(names, runs, strict=True)):
            x = np.where(np.isfinite(run.x[:, i]), run.x[:, i], np.nan)
            style: dict[str, Any] = {
                "color": COLOURS[j % 6],
                "linestyle": STYLES[j % 4],
                "linewidth": 1.3,
            }
            shown = percent(run.fit[state])
            error = np.clip(measured - x, -spread, spread)
            short = shorten(name)
            label = f"{short}: fit {shown}"
            for axes, value, told in ((top, np.clip(x, low, high), label), (below, error, short)):
                draw_line(axes, t, value, gaps, points, label=told, **style)
        # a wide band must not flatten what it is drawn about
        view, gap = top.get_ylim(), below.get_ylim()
        for j, (run, band) in enumerate(zip(runs, bands, strict=True)):
            if band is not None and band.coverage:
                limits = band.measurement[:, :, i]
                index = thin(gaps, *limits, points=points)
                _shade(top, below, t, run.x[:, i], limits, index, COLOURS[j % 6])
        top.set_ylim(view)
        below.set_ylim(gap)
        below.axhline(0, color=BLACK, linewidth=0.6)
        legend_above(top, columns=columns, borderaxespad=0.2)
    figure.align_ylabels()
    figure.suptitle(f"Free run on {shorten(log.name, 50)}", fontsize=10)
    return figure


def legend_columns(labels: Sequence[str], width: float, most: int = 3) -> int:
    """Return the columns of a legend that finds room above the axes of a figure [inch]."""
    room = 72 * width - _AXIS
    for columns in range(min(most, len(labels)), 1, -1):
        longest = [max(map(len, part)) for part in np.array_split(labels, columns)]
        if sum(_HANDLE + _LETTER * length for length in longest) <= room:
            return columns
    return 1


def shorten(name: str, most: int = 24) -> str:
    """Return a name that leaves a figure room for what it shows."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def _shade(
    top: Any, below: Any, t: Array, x: Array, limits: Array, index: NDArray[np.intp], colour: str
) -> None:
    """Shade the limits (2, N) of measurements about a run, and of their difference."""
    shade: dict[str, Any] = {"color": colour, "alpha": 0.18, "linewidth": 0}
    time = pick(t, index)
    for axes, edges in ((top, limits), (below, limits - x)):
        axes.fill_between(time, *(pick(edge, index) for edge in edges), **shade)


def fit_figure(
    lengths: Sequence[int], fits: dict[str, Array], states: Sequence[str], title: str
) -> Figure:
    """Draw the median fit and its quartiles against log length (Figures 6.2, 6.3).

    The thesis draws means; a single diverging run would take a mean off the axes.

    Parameters
    ----------
    lengths : sequence of int
    fits : dict of str to ndarray
        estimator -> (lengths, runs, states) [%].
    """
    figure = new_figure(5.2, 1.8 * len(states) + 0.9)
    axes = figure.subplots(len(states), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for i, state in enumerate(states):
        for j, (name, value) in enumerate(fits.items()):
            low, middle, high = np.percentile(
                np.maximum(value[:, :, i], -1e3), (25, 50, 75), axis=1
            )
            shift = (j - len(fits) / 2) * 25
            axes[i].errorbar(
                np.asarray(lengths) + shift,
                np.where(middle > -20, middle, np.nan),
                yerr=np.where(middle > -20, [middle - low, high - middle], np.nan),
                color=COLOURS[j % 6],
                linestyle=STYLES[j % 4],
                marker="v",
                markersize=4,
                capsize=2,
                linewidth=1.1,
                label=name,
            )
        word = LABELS.get(state, state).split(" [")[0]
        axes[i].set_ylabel(f"{word}\nfit (6.12) [%]", fontsize=8.5)
        axes[i].set_ylim(0, 105)
        tidy(axes[i])
    axes[-1].set_xlabel("N [samples]", fontsize=9)
    legend_outside(figure, axes[0], "lower center", 6, columnspacing=1.0)
    figure.suptitle(title, fontsize=11)
    return figure


def error_histograms(errors: dict[str, Array], names: Sequence[str], title: str) -> Figure:
    """Draw histograms of normalised errors, one row an estimator (Figures 4.1-4.11).

    Parameters
    ----------
    errors : dict of str to ndarray
        estimator -> (runs, parameters).
    """
    figure = new_figure(7.5, 1.7 * len(errors) + 0.5)
    axes = figure.subplots(len(errors), len(names), sharex="col", squeeze=False)
    for i, (estimator, value) in enumerate(errors.items()):
        for j, name in enumerate(names):
            ax = axes[i, j]
            ax.hist(value[:, j], bins=30, color=COLOURS[i % 6], alpha=0.85)
            ax.axvline(0, color=BLACK, linewidth=1)
            ax.set_title(
                f"{estimator}: {value[:, j].mean():.4f} ± {value[:, j].std(ddof=1):.4f}",
                fontsize=9,
            )
            tidy(ax)
            if i == len(errors) - 1:
                ax.set_xlabel(f"({name} estimate − true) / |true|")
    for row in axes:
        row[0].set_ylabel("runs")
    figure.suptitle(title, fontsize=11)
    return figure


def bias_figure(rows: Sequence[Any], title: str) -> Figure:
    """Draw mean ± sd of each parameter against the published mean ± sd.

    Parameters
    ----------
    rows : sequence of greybox.study.tables.Row
        Of one estimator.
    """
    figure = new_figure(6.2, 2.8)
    ax = figure.subplots()
    position = np.arange(len(rows))
    scale = np.array([max(r.published_sd or r.sd, 1e-12) for r in rows])
    for shift, colour, label, mean, sd in (
        (-0.12, BLUE, "this study", [r.mean for r in rows], [r.sd for r in rows]),
        (
            0.12,
            VERMILION,
            "published",
            [r.published_mean if r.published_mean is not None else np.nan for r in rows],
            [r.published_sd if r.published_sd is not None else np.nan for r in rows],
        ),
    ):
        ax.errorbar(
            position + shift,
            np.array(mean) / scale,
            yerr=np.array(sd) / scale,
            fmt="o" if colour == BLUE else "s",
            markersize=4,
            capsize=3,
            color=colour,
            label=label,
        )
    if max(abs(v) for line in ax.lines for v in np.nan_to_num(line.get_ydata())) > 6:
        ax.set_yscale("symlog", linthresh=3)
    ax.axhline(0, color=BLACK, linewidth=0.8)
    ax.set_xticks(position, [r.parameter for r in rows], rotation=40, ha="right", fontsize=8)
    ax.set_ylabel("error / published sd")
    legend_outside(figure, ax, "lower center", 2)
    tidy(ax)
    ax.set_title(title, fontsize=10)
    return figure


def overview_figure(signals: dict[str, Array], title: str, sample_time: float = 1.0) -> Figure:
    """Draw signals of one log under one another (Figure 6.1)."""
    figure = new_figure(5.6, 1.25 * len(signals) + 0.6)
    axes = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, value) in zip(axes, signals.items(), strict=True):
        ax.plot(np.arange(len(value)) * sample_time, value, color=BLUE, linewidth=0.7)
        ax.set_ylabel(LABELS.get(name, name), fontsize=8)
        tidy(ax)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title, fontsize=11)
    return figure


def to_svg(figure: Figure, title: str) -> str:
    """Return a figure as an SVG element for a page, with a title for screen readers."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    for words in figure.findobj(Text):
        # a name may hold a dollar sign; what a logarithmic axis writes is a formula
        if words.get_text() and "mathdefault" not in words.get_text():
            words.set_parse_math(False)
    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": title}):
        canvas = FigureCanvasSVG(figure)
        layout = figure.get_layout_engine()
        if layout is not None:
            # placed here, or all would be drawn once more to nowhere
            dpi = figure.get_dpi()
            figure.set_dpi(canvas.fixed_dpi)
            layout.execute(figure)
            figure.set_layout_engine("none")
            figure.set_dpi(dpi)
        canvas.print_svg(out, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = _PLACES.sub(lambda found: _LONG.sub(_rounded, found[0]), text)
    text = re.sub(r"\s*\n\s*", " ", text).replace("DejaVuSans-", "")
    return _lighter(text, re.sub(r"\W", "", title)[:24])


def narrow(
    figure: Figure, name: str, caption: str, alternative: str = "", chart: Chart | None = None
) -> Picture:
    """Return a figure as a picture that stands beside others."""
    return Picture(to_svg(figure, name), caption, alternative, narrow=True, chart=chart)


def _lighter(text: str, prefix: str) -> str:
    """Return an SVG without what nothing reads, its names local to a page with many figures."""
    text = _UNREAD.sub("", text).replace("> <", "><")
    own = dict(_OWN.findall(text))
    # a mark has its own style, wherever it is used
    text = _USE.sub(lambda use: use[1] if own.get(use[2]) == use[3] else use[0], text)
    # looks that several parts have are written once
    count = Counter(_STYLED.findall(text))
    looks = {look: f"s{k}-{prefix}" for k, look in enumerate(count) if count[look] > 2}
    sheet = "".join(f".{name}{{{look}}}" for look, name in looks.items())
    text = _STYLED.sub(
        lambda m: f' class="{looks[m[1]]}"' if m[1] in looks else m[0], text
    ).replace("</style>", f"{sheet}</style>", 1)
    names = {n: n for n in re.findall(r'(?:href="#|url\(#)([^")]+)', text)}
    hashes = [n for n in names if _HASH.fullmatch(n)]
    names |= {n: f"{n[0]}{k}" for k, n in enumerate(hashes)}

    def name(found: re.Match[str]) -> str:
        return f'{found[1]}{prefix}-{names[found[2]]}"' if found[2] in names else ""

    text = re.sub(r'( id=")([^"]+)"', name, text)
    return re.sub(r'((?:href="#|url\(#))([^")]+)', lambda m: f"{m[1]}{prefix}-{names[m[2]]}", text)


def save_png(figure: Figure, path: str) -> None:
    """Write a figure as PNG, replacing the file in one step."""
    from greybox.files import replacing

    with replacing(path, "wb") as handle:
        figure.savefig(handle, format="png", dpi=130)
