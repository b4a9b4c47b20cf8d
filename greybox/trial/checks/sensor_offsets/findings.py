"""Clock offsets, lever arm and heading bias of one ship's instruments, from all its logs together.

Each log gives a quadratic likelihood of all offsets at once; they are pooled, by campaign where
logs differ; then every way to share clocks, with and without lever arm and heading bias, is
compared, so that a late compass is not called a lever arm unless the motion cannot tell them apart.
What is found is told in words, with its repairs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import so_many
from greybox.notebook import with_error
from greybox.numerics.parallel import map_forked
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import Motion
from greybox.trial.checks.sensor_offsets.evidence import (
    Evidence,
    Likelihood,
    coarse_tie,
    expand,
    level,
    search,
)
from greybox.trial.checks.sensor_offsets.input_clock import input_clocks, response_delays
from greybox.trial.checks.sensor_offsets.model import (
    ARM,
    BIAS,
    CLOCKS,
    LEAST_CLOCK,
    LEAST_HEADING,
    MOST_LATE,
    SIGMAS,
    SIZE,
    KinematicModel,
    expected,
    least,
    most_arm,
)
from greybox.trial.checks.sensor_offsets.pool import Pooled, pool
from greybox.trial.checks.sensor_offsets.select import (
    POSITIONS,
    SEPARATED,
    Defect,
    Judged,
    matters,
    possible,
    score_hypotheses,
    separation,
)
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import mend
from greybox.vessel.vessel import Vessel

IDS = ("clock_offset", "lever_arm", "heading_bias")
# beyond these nothing can be said: [rad], [s], [m] and share of the length
_VAGUE_HEADING = np.radians(1.0)
_VAGUE_CLOCK = 0.3
_VAGUE_ARM = (0.5, 0.15)
_OWN_CLOCKS = (("psi",), ("r",), POSITIONS, ("u", "v"))
# in log-likelihood: a log that prefers one of two rivals by this can tell them apart
_TELLS = 3.0
_MOST_NAMED = 4
# means over blocks of at most this time [s]: ties are slower than samples, and what a receiver's
# filter does to its noise within a block is no motion
_STEP = 0.7


@dataclass(frozen=True)
class Campaign:
    """Logs that share their offsets, and what they say together.

    Parameters
    ----------
    members : tuple of int
        Which of the logs.
    names : tuple of str
    recordings : tuple of Recording
    evidence : tuple of Evidence
    pooled : Pooled
    judged : list of Judged
        All hypotheses, best first.
    others : int
        How many logs the ship has in other campaigns.
    turned_over : float
        Widest range of headings in a log [rad].
    step : float
        Longest sample time [s].
    """

    members: tuple[int, ...]
    names: tuple[str, ...]
    recordings: tuple[Recording, ...]
    evidence: tuple[Evidence, ...]
    pooled: Pooled
    judged: list[Judged]
    others: int
    turned_over: float
    step: float

    @property
    def best(self) -> Judged:
        """The hypothesis that the logs prefer."""
        return self.judged[0]


def campaign_findings(campaign: Campaign, vessel: Vessel) -> tuple[list[Finding], list[Outcome]]:
    """Return a finding for each defect that logs share, and what became of the checks."""
    antenna = expected(vessel)[0][ARM]
    told = [d for d in campaign.best.defects if matters(d, vessel, antenna)]
    findings = []
    clocks = [d for d in told if d.id == "clock_offset"]
    base = _base(clocks, campaign, vessel) if clocks else _Base()
    for d in told:
        if d.id == "clock_offset":
            finding = _clock_finding(d, base, campaign)
        elif d.id == "heading_bias":
            finding = _heading_finding(d)
        else:
            finding = _arm_finding(d, antenna)
        findings.append(_judged(finding, d, campaign, vessel))
    return findings, _outcomes(campaign, told, vessel)


@dataclass(frozen=True)
class _Base:
    """The clock that all channels end on."""

    late: float = 0.0
    channels: tuple[str, ...] = ()
    words: str = ""


def _base(clocks: list[Defect], campaign: Campaign, vessel: Vessel) -> _Base:
    """Return the clock that the thrusters' columns share, against the one most sensors share."""
    reference = (clocks[0].against, 0.0)
    all_clocks = [reference, *((d.channels, float(d.value[0])) for d in clocks)]
    positions = [k for k, (names, _) in enumerate(all_clocks) if "x_n" in names]
    # forces move velocities: only positions may be on another clock than they are
    if not positions or positions == [0]:
        return _Base()
    delays = response_delays(campaign.recordings, vessel)
    may = [k for k in input_clocks(delays, all_clocks, vessel) if k in (0, positions[0])]
    seen = ", ".join(f"{n} answers after {d.value:.1f} s" for n, d in sorted(delays.items()))
    against = _list(_words(clocks[0].against))
    if may == [0]:
        return _Base(words=f"the thrusters' columns share the clock of {against} ({seen})")
    if may == positions:
        names, late = all_clocks[positions[0]]
        words = f"the thrusters' columns share the clock of the positions ({seen})"
        return _Base(late, names, words)
    why = f"{seen}, which fits {'either' if may else 'neither'}" if seen else "no answer is seen"
    return _Base(
        words=f"which of these clocks the thrusters' columns share is unknown ({why}), so the "
        f"positions are moved, which no force depends on"
    )


def _clock_finding(d: Defect, base: _Base, campaign: Campaign) -> Finding:
    value, std = float(d.value[0]), float(np.sqrt(d.covariance[0, 0]))
    channels, against = d.channels, d.against
    late = value - base.late
    moved = channels
    # a sensor can be late, not early: then all the others are
    if value < 0 and "x_n" in channels:
        channels, against, value = against, channels, -value
    elif value < 0 and (channels, against) == (("r",), ("psi",)):
        # two by themselves
        channels, against, value = against, channels, -value
        moved, late = channels, value - base.late
    if base.channels and "x_n" in d.channels:
        # the positions stand on the inputs' clock: the others are moved to it
        moved, late = d.against, -base.late
    names = _list(channels)
    half = ""
    if "x_n" in d.channels and abs(abs(value) - 0.5 * campaign.step) < max(2.5 * std, 0.02):
        half = " (half a sample: a simulation by Euler's rule at this step looks the same)"
    return Finding(
        "clock_offset",
        channels[0],
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "s",
        f"{names} {'comes' if len(channels) == 1 else 'come'} {abs(value):.2f} s "
        f"{'late' if value > 0 else 'early'} against {_list(_words(against))}: shifted so, "
        f"positions, velocities and heading agree{half}"
        f"{f'; {base.words}' if base.words and 'x_n' in d.channels else ''}",
        f"shift {_list(moved)} by {-late:+.2f} s (import --fix does), and look for the delay in "
        f"the logger or a filter",
        channels,
        (mend("shift", moved, late=late),),
        True,
    )


def _list(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else names[0]


def _words(names: tuple[str, ...]) -> list[str]:
    said = {"x_n": "the positions", "psi": "the heading", "u": "the velocities", "r": "the rate"}
    if "u" not in names and "v" in names:
        said["v"] = "the sway velocity"
    return [said[n] for n in names if n in said]


def _heading_finding(d: Defect) -> Finding:
    value, std = float(d.value[0]), float(np.sqrt(d.covariance[0, 0]))
    return Finding(
        "heading_bias",
        "psi",
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "rad",
        f"the heading is {with_error(np.degrees(abs(value)), np.degrees(std))} deg "
        f"{'clockwise' if value > 0 else 'anticlockwise'} of the direction in which u and v carry "
        f"the positions (± one standard error); a constant velocity of the water is allowed for",
        f"subtract {value:.4f} rad from psi if the compass is misaligned (import --fix-also "
        f"heading_bias does), or turn u, v by as much if the velocity sensor is",
        ("psi",),
        (mend("turn_heading", ("psi",), angle=value),),
        False,
    )


def _arm_finding(d: Defect, antenna: Array) -> Finding:
    arm, std = d.value, np.sqrt(np.diag(d.covariance))
    ci = tuple((float(a - 1.96 * s), float(a + 1.96 * s)) for a, s in zip(arm, std, strict=True))
    said = f"({antenna[0]:g}, {antenna[1]:g})"
    off = arm - antenna
    return Finding(
        "lever_arm",
        "x_n",
        (float(arm[0]), float(arm[1])),
        ci,
        "m",
        f"the positions are those of a point {arm[0]:+.2f} m forward and {arm[1]:+.2f} m to "
        f"starboard of where u and v hold (the vessel file says {said}): they swing by so much "
        f"when the ship turns",
        f"write antenna = [{arm[0]:.2f}, {arm[1]:.2f}] in [sensors], or import --fix, which moves "
        f"the positions to where the vessel file has them",
        POSITIONS,
        (mend("move_antenna", POSITIONS, x=float(off[0]), y=float(off[1])),),
        True,
    )


def _judged(finding: Finding, d: Defect, campaign: Campaign, vessel: Vessel) -> Finding:
    """Say on which logs a finding rests, and leave it to the user where they do not decide it."""
    evidence = finding.evidence
    count = len(campaign.names)
    if count > 1:
        evidence += f"; {count} logs together say so"
        scatter = _scatter(d, campaign.pooled)
        if scatter:
            evidence += f", each within about {scatter}"
        finding = replace(finding, logs=campaign.names)
    if campaign.others and _differs(d, campaign.pooled):
        evidence += (
            f"; {so_many(campaign.others, 'other log')} of the ship "
            f"{'have' if campaign.others > 1 else 'has'} another value"
        )
    ask = ""
    if not possible(d, vessel):
        size, most = (
            (f"{np.hypot(*d.value):.1f} m", f"{most_arm(vessel):.1f} m")
            if d.id == "lever_arm"
            else (f"{abs(float(d.value[0])):.1f} s", f"{MOST_LATE:g} s")
        )
        what = "an antenna stands on the ship" if d.id == "lever_arm" else "a logger delays by less"
        ask = f"{size} is more than {most}: {what}, so look for another cause"
    else:
        margin, rival = separation(campaign.judged, d)
        if margin < SEPARATED and rival is not None:
            ask = _alternative_explanations(rival, campaign)
    if ask:
        evidence += f"; {ask}"
        finding = replace(
            finding, safe=False, fix=finding.fix.replace("--fix", f"--fix-also {finding.id}", 1)
            if "--fix-also" not in finding.fix else finding.fix,
        )  # fmt: skip
    return replace(finding, evidence=evidence)


def _alternative_explanations(rival: Judged, campaign: Campaign) -> str:
    """Say what else explains as much, and which logs can tell."""
    said = []
    for d in rival.defects:
        if d.id == "clock_offset":
            said.append(f"{_list(d.channels)} {float(d.value[0]):+.2f} s late")
        elif d.id == "lever_arm":
            said.append(f"an antenna at ({d.value[0]:.2f}, {d.value[1]:.2f}) m")
        else:
            said.append(f"a heading bias of {np.degrees(float(d.value[0])):.1f} deg")
    words = f"{' with '.join(said) or 'none of it'} would explain nearly as much of this motion"
    if len(campaign.names) == 1:
        return f"{words}: check this log together with others of the ship, which may tell"
    tells = []
    for name, e in zip(campaign.names, campaign.evidence, strict=True):
        gain = _loglik(e, campaign.best.offsets) - _loglik(e, rival.offsets)
        if abs(gain) > _TELLS:
            tells.append((abs(gain), name, gain > 0))
    tells.sort(reverse=True)
    if not tells:
        return f"{words}, and no log can tell them apart"
    named = ", ".join(f"{n} ({'this' if mine else 'that'})" for _, n, mine in tells[:_MOST_NAMED])
    return f"{words}; what single logs prefer: {named}"


def _loglik(e: Evidence, offsets: Array) -> float:
    return float(e.pull @ offsets - 0.5 * offsets @ e.information @ offsets)


def _rows(d: Defect) -> list[int]:
    if d.id == "lever_arm":
        return [ARM.start, ARM.start + 1]
    if d.id == "heading_bias":
        return [BIAS]
    return [CLOCKS.index(n) for n in (*d.channels, *d.against) if n in CLOCKS]


def _scatter(d: Defect, pooled: Pooled) -> str:
    size = float(np.max(pooled.scatter[_rows(d)]))
    if d.id == "heading_bias":
        return f"{np.degrees(size):.1f} deg" if size > 0.1 * LEAST_HEADING else ""
    if size < 0.1 * LEAST_CLOCK:
        return ""
    return f"{size:.2f} {'m' if d.id == 'lever_arm' else 's'}"


def _differs(d: Defect, pooled: Pooled) -> bool:
    rows = _rows(d)
    if d.id == "clock_offset":
        # two channels that differ alike from those of other campaigns keep their distance
        mine = [CLOCKS.index(n) for n in d.channels if n in CLOCKS]
        theirs = [CLOCKS.index(n) for n in d.against if n in CLOCKS]
        return bool(pooled.differing[mine].any() != pooled.differing[theirs].any())
    return bool(pooled.differing[rows].any())


def _outcomes(campaign: Campaign, told: list[Defect], vessel: Vessel) -> list[Outcome]:
    """Say for each id what its standard error would allow to see."""
    information = np.asarray(np.linalg.inv(campaign.pooled.covariance), dtype=np.float64)
    basis = campaign.best.hypothesis.basis
    apart = campaign.best.hypothesis.apart
    found = {d.id for d in told}
    together = f", {len(campaign.names)} logs together" if len(campaign.names) > 1 else ""
    needs = "needs positions, heading and velocities of a sensor of their own"
    outcomes = []
    if "clock_offset" not in found:
        if apart:
            outcomes.append(_heading_clock_outcome(campaign, together))
        else:
            outcomes.append(_clock_outcome(campaign, information, basis, together))
    if apart:
        return [*outcomes, *(Outcome(i, "cannot tell", needs) for i in IDS[1:])]
    span = np.degrees(campaign.turned_over)
    if "lever_arm" not in found:
        std = _error(information, basis, np.eye(SIZE)[:, ARM])
        vague = float(np.max(std)) > min(_VAGUE_ARM[0], _VAGUE_ARM[1] * vessel.length)
        said = (
            f"the heading turns too little ({span:.0f} deg): standard error "
            f"{float(np.max(std)):.2g} m"
            if vague
            else f"standard error {std[0]:.2g} and {std[1]:.2g} m{together}"
        )
        outcomes.append(Outcome("lever_arm", "cannot tell" if vague else "clean", said))
    if "heading_bias" not in found:
        error = float(_error(information, basis, np.eye(SIZE)[:, [BIAS]])[0])
        vague = error > _VAGUE_HEADING
        said = (
            f"the heading stays within {span:.0f} deg and the speed nearly constant: a bias cannot "
            f"be told from a current (standard error {np.degrees(error):.1f} deg)"
            if vague
            else f"standard error {np.degrees(error):.2f} deg{together}"
        )
        outcomes.append(Outcome("heading_bias", "cannot tell" if vague else "clean", said))
    return outcomes


def _heading_clock_outcome(campaign: Campaign, together: str) -> Outcome:
    """Say that heading and yaw rate agree, and what was compared with nothing."""
    said = f"heading and yaw rate share a clock{together}"
    logged = {n for r in campaign.recordings for n in r.names}
    if "x_n" in logged:
        lacks, alone = "measured u and v", "the positions"
    elif logged & {"u", "v"}:
        lacks, alone = "positions", "the velocities"
    else:
        return Outcome("clock_offset", "clean", said)
    said += f"; no {lacks} to compare {alone} with: whether they do too cannot be told"
    return Outcome("clock_offset", "cannot tell", said, ("r", "psi"))


def _clock_outcome(campaign: Campaign, information: Array, basis: Array, together: str) -> Outcome:
    """Say how well each clock is known, and which cannot be told."""
    known: list[str] = []
    vague: list[str] = []
    sharp: tuple[str, ...] = ()
    seen = sum(np.diag(e.information) for e in campaign.evidence) > np.zeros(SIZE)
    for channels in _OWN_CLOCKS:
        column = np.zeros((SIZE, 1))
        names = CLOCKS if channels == POSITIONS else channels
        rows = [CLOCKS.index(n) for n in names if seen[CLOCKS.index(n)]]
        if not rows:
            continue
        column[rows] = 1.0
        std = float(_error(information, basis, column)[0])
        (vague if std > _VAGUE_CLOCK else known).append(f"{', '.join(channels)} {std:.2g} s")
        sharp += channels if std <= _VAGUE_CLOCK else ()
    if not known:
        said = f"this motion tells no clock apart (standard errors: {'; '.join(vague)})"
        return Outcome("clock_offset", "cannot tell", said)
    said = f"standard errors: {'; '.join(known)}{together}"
    if vague:
        said += f"; cannot tell: {'; '.join(vague)}"
    return Outcome("clock_offset", "clean", said, sharp)


def _error(information: Array, basis: Array, more: Array) -> Array:
    """Return the standard errors of more offsets beside those that were found."""
    left = basis - more @ (more.T @ basis) / float(np.sum(more[:, 0]))
    held = left[:, np.linalg.norm(left, axis=0) > 1e-9]
    wide = np.hstack([more, held])
    covariance = np.linalg.pinv(wide.T @ information @ wide)
    return np.asarray(np.sqrt(np.diag(covariance)[: more.shape[1]]))


@dataclass(frozen=True)
class Tied:
    """What `find_offsets` needs of a log.

    Parameters
    ----------
    name : str
    recording : Recording
        Mended so far.
    motion : Motion or None
        Its columns read as they are meant (see `find_readings`).
    """

    name: str
    recording: Recording
    motion: Motion | None


def find_offsets(logs: Sequence[Tied], vessel: Vessel) -> list[tuple[list[Finding], list[Outcome]]]:
    """Find clock offsets, lever arm and heading bias that logs of one ship share.

    Parameters
    ----------
    logs : sequence of Tied
    vessel : Vessel
        Its antenna is where the positions are taken to be measured.

    Returns
    -------
    list of (findings, outcomes)
        One per log: what was found, and what was compared or why nothing can show it.
    """
    why = "needs heading and yaw rate, or positions, heading and velocities of their own sensor"
    out: list[tuple[list[Finding], list[Outcome]]] = [
        ([], [Outcome(i, "cannot tell", why) for i in IDS]) for _ in logs
    ]
    rows, ties = [], []
    for i, log in enumerate(logs):
        if log.motion is not None and (log.motion.positioned or log.motion.turned):
            rows.append(i)
            ties.append(KinematicModel(log.motion.coarser(_STEP)))
    # a clock of heading against yaw rate alone is another question
    for positioned in (True, False):
        of_kind = [k for k, tie in enumerate(ties) if tie.positioned == positioned]
        if not of_kind:
            continue
        for campaign in _campaigns(
            [logs[rows[k]] for k in of_kind], [ties[k] for k in of_kind], vessel
        ):
            found, said = campaign_findings(campaign, vessel)
            for k in campaign.members:
                out[rows[of_kind[k]]] = (found, said)
    return out


def _campaigns(
    logs: Sequence[Tied], ties: Sequence[KinematicModel], vessel: Vessel
) -> Iterator[Campaign]:
    prior, material = expected(vessel), least(vessel)
    first = map_forked(lambda tie: expand(tie, search(tie, coarse_tie(tie), prior)), ties)
    pooled, splits = pool(first, prior, material)
    evidence: list[Evidence] = list(first)
    for campaign in pooled:
        for i in campaign.logs:
            if len(ties) > 1:
                evidence[i] = expand(ties[i], campaign.offsets)
    pooled, _ = pool(evidence, prior, material, splits)
    for campaign in pooled:
        members = [ties[i] for i in campaign.logs]
        turned = any(t.turned for t in members)
        channels = members[0].motion.values if members[0].positioned else {"psi": 0, "r": 0}
        judged = score_hypotheses(
            tuple(channels), turned=turned, offsets=campaign.offsets,
            covariance=campaign.covariance, vessel=vessel,
            scatter=np.hypot(campaign.scatter, material / SIGMAS),
            antenna=prior[0][ARM],
        )  # fmt: skip
        yield Campaign(
            members=campaign.logs,
            names=tuple(logs[i].name for i in campaign.logs),
            recordings=tuple(logs[i].recording for i in campaign.logs),
            evidence=tuple(evidence[i] for i in campaign.logs),
            pooled=campaign,
            judged=_upheld(judged, members, prior),
            others=len(ties) - len(campaign.logs),
            turned_over=max(float(np.ptp(t.motion["psi"])) for t in members),
            step=max(m.step for i in campaign.logs if (m := logs[i].motion) is not None),
        )


def _upheld(judged: list[Judged], ties: Sequence[KinematicModel], prior: Array) -> list[Judged]:
    """Leave out the hypotheses at the head that the logs do not bear out.

    They are ranked by the quadratic likelihood around one place. The likelihood itself, at what a
    hypothesis says, must gain what it costs: along a valley of rival mends it may not.
    """

    def loss(offsets: Array) -> float:
        return sum(level(Likelihood(tie), offsets, prior) for tie in ties)

    nothing = loss(prior[0])
    for k, h in enumerate(judged):
        if not h.defects or nothing - loss(h.offsets) >= h.cost:
            return judged[k:]
    return judged
