"""The page of `greybox compare`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from greybox.channels import MOTION_WORDS
from greybox.model.model import ManoeuvringModel
from greybox.report.chart import chart_of
from greybox.report.error_budget import noise_sentence
from greybox.report.figures import comparison_figure, to_svg
from greybox.report.next_steps import after_comparison
from greybox.report.page import Page, Picture, Table, capital, computed
from greybox.report.thinning import points_for
from greybox.validation.bands import LEVEL, Bands
from greybox.validation.comparison import Comparison, rmse_titles
from greybox.validation.fit import LogFit, mean_fit, percent, told_fits

# with more the page grows and tells nothing new
MOST_LOGS = 8


def comparison_page(
    comparison: Comparison, models: Sequence[ManoeuvringModel], record: dict[str, Any]
) -> Page:
    """Return the page: one picture a log, the fits, errors ahead, sign tests, equations."""
    states = list(comparison.runs[0][0].fit)
    lead, *pictures = _pictures(comparison)
    fit_rows, ahead_rows = [], []
    for name, row, errors, aheads in zip(
        comparison.names, comparison.runs, comparison.rmse, comparison.ahead, strict=True
    ):
        for run, rmse, ahead in zip(row, errors, aheads, strict=True):
            fit_rows.append(
                [name, run.log.name]
                + [percent(run.fit[s]).removesuffix(" %") for s in states]
                + [f"{rmse[s]:.3g}" for s in states]
            )
            for horizon, value in ahead.items():
                ahead_rows.append(
                    [name, run.log.name, horizon]
                    + [f"{value[s]:.3g}" if np.isfinite(value[s]) else "diverged" for s in states]
                )
    tables = [
        Table(
            "Fit (6.12) of the free run and root mean square error",
            ["model", "log", *[f"fit {s} [%]" for s in states], *rmse_titles(states)],
            fit_rows,
        ),
        Table(
            "Root mean square error some seconds ahead of measured states [m/s, rad/s]",
            ["model", "log", "ahead [s]", *states],
            ahead_rows,
        ),
    ]
    noise_rows = [
        [
            name, run.log.name, s, percent(run.fit[s]).removesuffix(" %"), f"{n.fit:.1f}",
            f"{errors[s]:.3g}", f"{n.std:.2g}",
        ]
        for name, row, noises, rmse in zip(
            comparison.names, comparison.runs, comparison.noise, comparison.rmse, strict=True
        )
        for run, noise, errors in zip(row, noises, rmse, strict=True)
        for s, n in noise.items()
    ]  # fmt: skip
    if noise_rows:
        tables.insert(
            1,
            Table(
                "What sensor noise allows: the fit of a perfect model, and the error of noise "
                "alone [m/s, rad/s]",
                ["model", "log", "state", "fit [%]", "at most [%]", "error", "noise alone"],
                noise_rows,
            ),
        )
    cover_rows = [
        [
            name,
            run.log.name,
            s,
            f"{100 * c.share:.1f}",
            "{:.0f}-{:.0f}".format(*(100 * u for u in c.usual)),
        ]
        for name, row, bands in zip(
            comparison.names, comparison.runs, comparison.bands, strict=True
        )
        for run, band in zip(row, bands, strict=True)
        for s, c in (band.coverage.items() if band else ())
    ]
    if cover_rows:
        tables.append(
            Table(
                f"Measured samples inside the band of {100 * LEVEL:.0f} % [%]",
                ["model", "log", "state", "inside", "usual where the model holds"],
                cover_rows,
            )
        )
    tests = comparison.sign_tests if len(comparison.runs[0]) > 1 else ()
    if tests:
        tables.append(
            Table(
                "Sign test: logs on which a model fits better than the first",
                ["model", "against", "state", "wins", "p-value (two-sided)"],
                [
                    [t.model, t.against, t.state, f"{t.wins}/{t.of}", f"{t.p_value:.2g}"]
                    for t in tests
                ],
            )
        )
    return Page(
        title="Measured against simulated",
        headline=comparison.verdict.sentence,
        sentences=[
            *_noise_sentences(comparison),
            *comparison.notes,
            *dict.fromkeys(g.sentence for row in comparison.runs for run in row for g in run.gaps),
            *[
                f"{name}: {d.sentence}"
                for name, differences in zip(comparison.names, comparison.conditions, strict=True)
                for d in differences
            ],
            *_band_sentences(comparison),
            *_left_out(comparison),
        ],
        pictures=pictures,
        lead=lead,
        next_steps=after_comparison(comparison, models, record),
        tables=tables,
        texts=[
            (f"Model {name}", model.summary())
            for name, model in zip(comparison.names, models, strict=True)
        ],
        computed=computed(record)
        | {"start": "mean of the log's first 5 samples"}
        | (
            {
                "intervals of differences": "95 %, of the mean fit over channels and logs, by "
                "Student's t over eight stretches of each log (Ibragimov and Müller, 2010)"
            }
            if comparison.verdict.differences
            else {}
        ),
    )


def _pictures(comparison: Comparison) -> list[Picture]:
    """Return one picture a log, as many as a page bears, the worst of the best model first."""
    best = comparison.best()
    by_log = [mean_fit(run.fit) for run in comparison.runs[best]]
    worst = int(np.argmin(by_log))
    kept = [i for i, run in enumerate(comparison.runs[0]) if run.whole is None and i != worst]
    order = [worst, *kept][:MOST_LOGS]
    drawn = len(order)
    shaded = sum(b is not None and bool(b.coverage) for row in comparison.bands for b in row[:1])
    curves = drawn * len(comparison.runs[0][0].fit) * (1 + 2 * len(comparison.names) + 4 * shaded)
    pictures = []
    for i in order:
        first = comparison.runs[0][i]
        runs = [row[i] for row in comparison.runs]
        bands = [row[i] for row in comparison.bands]
        caption = (
            f"Free run on {first.log.name} ({first.samples} samples of "
            f"{first.log.sample_time:g} s): measured, simulated, and their difference below."
        )
        if i == worst and len(by_log) > 1:
            caption += (
                f" Of {len(by_log)} logs this is the one that '{comparison.names[best]}' fits "
                f"worst."
            )
        if any(b is not None and b.coverage for b in bands):
            caption += f" Shaded: where {100 * LEVEL:.0f} % of the measurements should lie."
        fits = "; ".join(
            f"{name} {told_fits(run.fit)}" for name, run in zip(comparison.names, runs, strict=True)
        )
        key, told = f"log{i}{first.log.name}", f"Fit of the free run: {fits}."
        picture = run_picture(comparison.names, runs, bands, curves, key, caption, told)
        pictures.append(replace(picture, narrow=drawn > 1))
    return pictures


def run_picture(
    names: Sequence[str],
    runs: Sequence[LogFit],
    bands: Sequence[Bands | None],
    curves: int,
    key: str,
    caption: str,
    told: str,
) -> Picture:
    """Return free runs on one log, of a page with so many curves: light in print, finer zoomed."""
    printed, zoomed = (
        comparison_figure(names, runs, bands, points=points_for(curves, **room))
        for room in ({}, {"most": 10_000, "room": 120_000})
    )
    return Picture(to_svg(printed, key), caption, f"{caption} {told}", chart=chart_of(zoomed))


def _noise_sentences(comparison: Comparison) -> list[str]:
    """Return how much of the error of the best model is noise."""
    verdict = comparison.verdict
    if verdict.diverging:
        return []
    of = f" of '{verdict.best}'" if verdict.models > 1 else ""
    still = [
        f"{MOTION_WORDS.get(s, s)} hardly moved on {run.log.name} and tells little there."
        for run, noise in zip(
            comparison.runs[comparison.best()], comparison.noise[comparison.best()], strict=True
        )
        for s, n in noise.items()
        if not n.moves
    ]
    return [*noise_sentence(verdict.shares, verdict.bounds, of), *map(capital, still)]


def _left_out(comparison: Comparison) -> list[str]:
    count = len(comparison.runs[0])
    if count <= MOST_LOGS:
        return []
    return [
        f"Of {count} logs the one of the lowest fit and the first {MOST_LOGS - 1} others are "
        f"drawn; all are in the tables."
    ]


def _band_sentences(comparison: Comparison) -> list[str]:
    """Return what is notable of the bands: samples outside, and sources of error left out."""
    told = []
    for name, runs, bands in zip(comparison.names, comparison.runs, comparison.bands, strict=True):
        for run, band in zip(runs, bands, strict=True):
            if band is None:
                continue
            told += [f"{name} on {run.log.name}: {c.sentence}" for c in band.coverage.values()
                     if not c.holds]  # fmt: skip
            told += [f"Bands of {name}: {note}" for note in band.notes]
    return list(dict.fromkeys(told))
