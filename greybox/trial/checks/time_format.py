"""Fractions of a second without their leading zeros, as a finding."""

from __future__ import annotations

import numpy as np

from greybox.trial.checks.finding import Finding
from greybox.trial.checks.signal_quality import clocks, listed
from greybox.trial.raw_log import Recording
from greybox.trial.steps import Step, mend
from greybox.trial.time_format import unpadded_numbers

_FIX = "put the zeros before the fractions again (import --fix does)"


def time_format_findings(recording: Recording) -> list[Finding]:
    """Find times whose fraction of a second was written without its leading zeros.

    Parameters
    ----------
    recording : Recording
        Canonical signals.

    Returns
    -------
    list of Finding
        One for each column of text that was read so, and one for each clock of numbers.
    """
    found = [_of_text(s) for s in recording.steps if s.operation == "pad_fractions"]
    for names, t in clocks(recording):
        zero = recording.epoch or 0.0
        wrong = unpadded_numbers(t + zero)
        if not len(wrong):
            continue
        meant = wrong.times - zero
        written = t[wrong.rows]
        worst = int(np.argmax(written - meant))
        found.append(
            Finding(
                "time_format",
                "t",
                float(len(wrong)),
                (float(len(wrong)), float(len(wrong))),
                "1",
                f"{len(wrong)} of {len(t)} times of {listed(names)} lack leading zeros in their "
                f"fraction of a second, the first at t = {meant[0]:.6g} s, written as "
                f"{written[0]:.6g} s; they come up to {written[worst] - meant[worst]:.3g} s late "
                f"and seem to go back behind",
                _FIX,
                ("t",),
                (mend("pad_fractions", names, count=float(len(wrong)), first=float(meant[0])),),
                True,
                {"t": t, "rows": wrong.rows, "written": written, "meant": meant, "names": names},
            )
        )
    return found


def _of_text(step: Step) -> Finding:
    count = step.number("count")
    times, late = np.array(step.numbers("times")), np.array(step.numbers("late"))
    return Finding(
        "time_format",
        "t",
        count,
        (count, count),
        "1",
        f"{', '.join(step.source)}: {step.sentence}; the first stands at t = {times[0]:.6g} s, and "
        f"would come up to {late.max():.3g} s late",
        "export the times with all digits; import reads them as they are meant",
        ("t",),
        # the times are right already: to pad them again changes nothing
        (step,),
        True,
        {"t": times, "meant": times, "written": times + late, "names": step.source},
    )
