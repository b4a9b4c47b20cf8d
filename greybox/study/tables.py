"""Tables of normalised estimation errors, beside the published ones."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, fields
from importlib import resources

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Mean and standard deviation of one parameter's normalised error over runs."""

    table: str
    set: str
    estimator: str
    parameter: str
    mean: float
    sd: float
    published_mean: float | None
    published_sd: float | None
    runs: int

    @classmethod
    def of(
        cls, table: str, of: str, estimator: str, parameter: str, errors: Array,
        there: tuple[str, str] | None = None,
    ) -> Row:  # fmt: skip
        """Return the row of some runs' errors (R,), beside the published mean and deviation."""
        mean, sd, count = summarise(errors)
        if there is None:
            return cls(table, of, estimator, parameter, mean, sd, None, None, count)
        known_mean, known_sd = map(float, there)
        return cls(table, of, estimator, parameter, mean, sd, known_mean, known_sd, count)


def normalised(estimates: Array, true: float, reference: float | None = None) -> Array:
    """Return (estimate − true) / |reference|, the reference being the true value by default.

    In Tables 6.2-6.7 the reference of the linear damping terms is 1 + Xu,
    because the thesis estimates 1 + Xu.
    """
    return (estimates - true) / abs(true if reference is None else reference)


def to_csv(rows: Iterable[Row]) -> str:
    """Return the rows as CSV, a column for each field."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([f.name for f in fields(Row)])
    for r in rows:
        writer.writerow(
            [
                r.table,
                r.set,
                r.estimator,
                r.parameter,
                f"{r.mean:.6g}",
                f"{r.sd:.6g}",
                "" if r.published_mean is None else f"{r.published_mean:g}",
                "" if r.published_sd is None else f"{r.published_sd:g}",
                r.runs,
            ]
        )
    return out.getvalue()


def published(chapter: str) -> list[dict[str, str]]:
    """Return the published table of a chapter as rows of its CSV.

    Parameters
    ----------
    chapter : {"chapter4", "chapter6"}
    """
    text = (resources.files("greybox.study") / "published" / f"{chapter}.csv").read_text("utf-8")
    return list(csv.DictReader(io.StringIO(text)))


def summarise(errors: Array) -> tuple[float, float, int]:
    """Return mean, standard deviation and count of the finite errors."""
    good = errors[np.isfinite(errors)]
    if len(good) < 2:
        return float("nan"), float("nan"), len(good)
    return float(good.mean()), float(good.std(ddof=1)), len(good)
