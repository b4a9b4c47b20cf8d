"""The part of a diagnosis' page on causes: their numbers, evidence, groups, the search."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from greybox.diagnosis.causes import known_causes
from greybox.diagnosis.result import Diagnosis, DiagnosisVerdict, Found
from greybox.notebook import with_error
from greybox.report.diagnosis_figures import ranked_for_picture, ranking_figure
from greybox.report.figures import narrow
from greybox.report.model_difference import shown_unit, unbroken
from greybox.report.page import Picture, Section, Table

# of causes that the log shows without a force model
_OUTSIDE = ["none needed", "none needed"]


def cause_section(diagnosis: Diagnosis) -> Section:
    """Show why: causes, their numbers, groups that look alike, and the search."""
    told = {
        DiagnosisVerdict.NAMED: "",
        DiagnosisVerdict.PARTLY: "These causes are confirmed, and an error beyond noise remains.",
        DiagnosisVerdict.NONE: f"{diagnosis.tried} causes were tried; held-out logs "
        "confirm none of them.",
        DiagnosisVerdict.CONFUSED: "Each of these explains the logs about as well as the others. "
        "A model with the wrong one fits these logs, and may fail on the next.",
        DiagnosisVerdict.UNEXPLAINED: f"None of the {diagnosis.tried} causes that were tried "
        "explains the errors.",
    }[diagnosis.verdict]
    if diagnosis.partial:
        helping = ", ".join(c.key for c in diagnosis.partial)
        told = f"{told} No better than a generic force would be: {helping}.".strip()
    found = _all_found(diagnosis)
    points = [f"{_called(c)}: {c.evidence}." for c in found]
    return Section(
        "2. The cause"
        if diagnosis.verdict == DiagnosisVerdict.NAMED and len(found) == 1
        else "2. Causes",
        [told] if told else [],
        list(_ranking(diagnosis, [c.key for c in (*diagnosis.causes, *diagnosis.candidates)])),
        [t for t in (_numbers(found), _proofs(found, diagnosis.tried)) if t],
        points=[*points, *_groups(diagnosis)],
    )


def _called(cause: Found) -> str:
    return cause.key if cause.key == cause.title else f"{cause.key} ({cause.title})"


def _all_found(diagnosis: Diagnosis) -> tuple[Found, ...]:
    every = (*diagnosis.causes, *diagnosis.partial, *diagnosis.candidates)
    return tuple({c.key: c for c in every}.values())


def _numbers(found: Sequence[Found]) -> Table | None:
    rows = []
    for cause in found:
        for name, q in cause.parameters.items():
            if not q.std > 0:
                continue
            value = unbroken(with_error(q.value, q.std))
            unit = shown_unit(q.unit)
            if q.unit == "rad":
                unit = f"rad ({with_error(np.rad2deg(q.value), np.rad2deg(q.std))} deg)"
            rows.append([cause.key, name, value, unit])
    caption = "What was estimated, ± one standard error"
    return Table(caption, ["cause", "parameter", "value", "unit"], rows) if rows else None


def _proofs(found: Sequence[Found], tried: int) -> Table | None:
    rows = [
        [
            c.key, probability(c.p_value), probability(c.p_adjusted),
            *_falls(c),
        ]
        for c in found
    ]  # fmt: skip
    head = ["cause", "p", f"p, {tried} causes tried", "estimation logs", "held-out ± std. error"]
    caption = "Evidence: probability of no such effect, and fall of −2 log L"
    return Table(caption, head, rows) if rows else None


def _falls(cause: Found) -> list[str]:
    if np.isnan(cause.gain):
        return _OUTSIDE
    if not np.isfinite(cause.held_out):
        return [f"{cause.gain:.1f}", cause.proved]
    return [f"{cause.gain:.1f}", f"{cause.held_out:.1f} ± {cause.held_out_std:.1f}"]


def probability(p: float) -> str:
    """Return a p-value as text, without the digits of one that rounding decides."""
    return unbroken(f"{p:.2g}" if p >= 1e-16 else "below 1e-16")


def _groups(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield how the members of confused groups show themselves, where a trial must look."""
    known = known_causes()
    for group in diagnosis.groups:
        option = "--between" if len(group) == 2 else "--for causes"
        yield (
            f"These logs cannot tell {' from '.join(group)}. A trial in which their effects "
            f"differ most tells them apart; greybox design {option} plans it."
        )
        for member in group:
            cause = known.get(member.partition(":")[0])
            if cause is not None:
                yield (f"{member} looks like {cause.signature}. Its extension: {cause.extension}.")


def _ranking(diagnosis: Diagnosis, kept: Sequence[str]) -> Iterator[Picture]:
    for i, step in enumerate(diagnosis.steps):
        if not step:
            continue
        shown = ranked_for_picture(step, kept)
        best = shown[0]
        more = (
            f" The other {len(step) - len(shown)} are not drawn." if len(step) > len(shown) else ""
        )
        held = "cannot tell apart" if diagnosis.candidates else "names"
        named = (
            f"Bold: the causes that the verdict {held}."
            if any(r.key in kept for r in shown)
            else "The verdict names none of these."
        )
        caption = (
            f"Step {i + 1} of the search: fall of −2 log L of each cause as its sensitivity "
            f"predicts it, as a refit finds it, and as held-out logs confirm it (95 % interval). "
            f"{named}{more}"
        )
        gain = "was not refitted" if best.gain is None else f"gained {best.gain:.0f}"
        alternative = (
            f"{caption} Best of {len(step)}: {best.key}, which promised {best.promise:.0f} and "
            f"{gain}."
        )
        yield narrow(ranking_figure(step, kept), f"step{i}", caption, alternative)
