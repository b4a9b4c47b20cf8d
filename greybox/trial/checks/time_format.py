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
        One for all columns of text that were read so, and one for each clock of numbers.
    """
    read = [s for s in recording.steps if s.operation == "pad_fractions" and s.numbers("times")]
    found = [_of_text(read)] if read else []
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
                (_mend(names, len(wrong), float(written[0]), float(meant[0])),),
                True,
                {"t": t, "rows": wrong.rows, "written": written, "meant": meant, "names": names},
            )
        )
    return found


def _mend(names: tuple[str, ...], count: int, written: float, meant: float) -> Step:
    said = {"written": f"{written:.9g} s", "meant": f"{meant:.9g} s"}
    return mend("pad_fractions", names, count=float(count), **said)


def _of_text(read: list[Step]) -> Finding:
    """Return the finding of columns of text that were read as meant; their steps tell where."""
    count = sum(s.number("count") for s in read)
    times = np.array([t for s in read for t in s.numbers("times")])
    late = np.array([t for s in read for t in s.numbers("late")])
    columns = listed(x for s in read for x in s.source)
    first, worst = read[0], int(np.argmax(late))
    said = first.parameters
    return Finding(
        "time_format",
        "t",
        count,
        (count, count),
        "1",
        f"{count:.0f} times of {columns} have fewer digits than the others, such as "
        f"{said.get('written')} for {said.get('meant')} at t = {times[0]:.6g} s: "
        f"their fraction lacks its leading zeros, and would come up to {late[worst]:.3g} s late",
        "none needed: import reads them as they are meant; export times with all their digits",
        ("t",),
        # the times are right already: to pad them again changes nothing
        tuple(read),
        True,
        {"t": times, "meant": times, "written": times + late, "names": first.source},
    )
