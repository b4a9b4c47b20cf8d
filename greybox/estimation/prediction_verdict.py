"""How well a model's free run predicts held-out logs, as values.

The numbers come from `greybox.validation.judge_prediction`; here they are weighed
against limits, and sentences are rendered from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar

import numpy as np

from greybox.channels import MOTION_WORDS
from greybox.errors import so_many
from greybox.estimation.verdict import Divergence, Reason
from greybox.notebook import DisplayMixin, number, table


def channel_words(channel: str) -> str:
    """Return what a state is called, its symbol where it has no name."""
    return MOTION_WORDS.get(channel, channel)


class PredictionLevel(StrEnum):
    """How well a free run predicts; the values are the words that users read."""

    GOOD = "good"
    LIMITED = "limited"
    POOR = "poor"
    NOT_JUDGED = "not judged"


class JudgedOn(StrEnum):
    """Which logs a prediction was judged on; the values stand in files."""

    HELD_OUT = "held-out"
    VALIDATION = "validation"
    OWN = "own"


def seconds(time: float) -> str:
    """Return a time [s] with its unit, whole seconds of a long one."""
    return f"{time:.3g} s" if time < 1000 else f"{time:.0f} s"


@dataclass(frozen=True)
class PredictionLimits:
    """The limits of the levels.

    Parameters
    ----------
    good, usable : float
        Greatest root mean square error of a free run as a share of the channel's own
        standard deviation: three quarters, and half, of its variance explained. They are
        the bounds of "very good" and "satisfactory" of Moriasi et al. (2007).
    coverage : float
        Least share of the measurements inside the bands of 95 %: beyond it misses are more
        than three times as frequent as the bands say.
    noise : float
        Times the sensor's noise that a channel must move to count: below it noise alone
        leaves an error of a third of the spread.
    speed : float
        Share of the ship's speed that a channel must move to count, the yaw rate times the
        ship's length: 0.6 degrees of drift.
    held : float
        Greatest share of command settings of the logs with which, where they are held, a free
        run diverges: two of sixteen, since these are the outermost ones.

    References
    ----------
    Moriasi et al. (2007), table 4: RSR at most 0.50 is very good, above 0.70 unsatisfactory.
    """

    good: float = 0.5
    usable: float = 0.7
    coverage: float = 0.85
    noise: float = 3.0
    speed: float = 0.01
    held: float = 0.125

    def to_dict(self) -> dict[str, float]:
        """Return the limits for JSON."""
        return dict(vars(self))


LIMITS = PredictionLimits()
# why parts were not left out where seconds were few
TOO_SHORT = "time was too short to estimate without a part: allow more with --effort"


@dataclass(frozen=True)
class BandShare:
    """How many measurements lie inside the bands of 95 %.

    Parameters
    ----------
    share : float
    interval : tuple of float
        Of Wilson (95 %), by `independent` trials.
    samples : int
    independent : float
        Independent samples that these are worth: errors of one run are related.
    """

    share: float
    interval: tuple[float, float]
    samples: int
    independent: float


@dataclass(frozen=True)
class ChannelPrediction:
    """How well free runs predict one channel.

    Parameters
    ----------
    channel, unit : str
    rmse : float
        Root mean square error of the free runs [unit]; infinite where one diverges.
    spread : float
        Root mean square deviation of the measurements from the mean of their log [unit]: the
        error of the best constant.
    noise : float or None
        What the sensor's noise alone would leave of the error [unit]; None where not known.
    moves : bool
        Whether the channel moves by more than its noise, and enough to matter.
    horizon : float
        Up to which runs from measured states beat the constant [s].
    lasting : bool
        Whether they do so to the end of the logs.
    bands : BandShare, optional
    memory : float, optional
        Time over which the errors are related: their correlation, integrated [s].
    own : float, optional
        Root mean square error of free runs on the logs of the estimate itself [unit].
    elsewhere : float, optional
        That where whole logs, of a kind of manoeuvre where there are several, were left out of
        an estimate in turn [unit].
    """

    channel: str
    unit: str
    rmse: float
    spread: float
    noise: float | None
    moves: bool
    horizon: float
    lasting: bool
    bands: BandShare | None = None
    memory: float | None = None
    own: float | None = None
    elsewhere: float | None = None

    @property
    def error(self) -> float:
        """The error as a share of the spread; infinite where nothing moved."""
        return self.rmse / self.spread if self.spread > 0 else float("inf")

    @property
    def fit(self) -> float:
        """The fit (6.12) of all logs together [%]."""
        return 100 * (1 - self.error)

    @property
    def words(self) -> str:
        """What the channel is called."""
        return channel_words(self.channel)


def _in_runs(lost: int, count: int) -> str:
    """Return in how many runs of several, and that the time that follows is the first one's."""
    return f" in {lost} of {count} runs, first" if count > 1 else ""


@dataclass(frozen=True)
class RunsDiverge(Reason):
    """Free runs leave their bound.

    Parameters
    ----------
    logs : tuple of str
    count : int
        Of all runs.
    after : float
        Of the first to do so [s].
    """

    logs: tuple[str, ...]
    count: int
    after: float

    kind: ClassVar[str] = "runs_diverge"

    @property
    def sentence(self) -> str:
        """How many, and when."""
        where = _in_runs(len(self.logs), self.count)
        return f"its free run diverges{where} after {seconds(self.after)}"


class RefitsDiverge(RunsDiverge):
    """Free runs of models that were estimated without a part of the logs leave their bound."""

    kind: ClassVar[str] = "refits_diverge"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """How many, and when."""
        return (
            f"estimated without a part of the logs its free run on this part diverges"
            f"{_in_runs(len(self.logs), self.count)} after {seconds(self.after)}"
        )


@dataclass(frozen=True)
class Elsewhere(Reason):
    """Motions that the other logs do not show are followed less well than asked.

    Parameters
    ----------
    kinds : tuple of str
        Of manoeuvres that were left out of an estimate in turn; none where logs were.
    whole : bool
        Whether whole logs were left out, not parts of a single one.
    errors : mapping of str to float
        A channel that moves, as a share of its spread.
    diverged, count : int
        Runs that leave their bound, and all.
    """

    kinds: tuple[str, ...]
    whole: bool
    errors: Mapping[str, float]
    diverged: int
    count: int

    kind: ClassVar[str] = "elsewhere"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """What was left out, and how far the error went."""
        if self.kinds:
            what = f"a kind of manoeuvre that the estimate did not use ({', '.join(self.kinds)})"
        else:
            what = f"{'a log' if self.whole else 'parts of the log'} that the estimate did not use"
        if self.diverged:
            far = "its free run diverges"
            far += f" in {self.diverged} of {self.count} runs" * (self.count > 1)
        else:
            worst = max(self.errors, key=lambda c: self.errors[c])
            far = (
                f"the error of {channel_words(worst)} is {100 * self.errors[worst]:.0f} % of its "
                f"spread"
            )
        return f"on {what}, each left out in turn, {far}: add logs of the motion to be predicted"


@dataclass(frozen=True)
class HeldCommandsDiverge(Reason):
    """The free run diverges, or goes astern, where commands are held as they were in the logs.

    Parameters
    ----------
    commands : mapping of str to float
        What they are held at in the first run that does, in the units of the log.
    after : float
        [s]
    count, settings : int
        Runs that do, and all.
    """

    commands: Mapping[str, float]
    after: float
    count: int
    settings: int

    kind: ClassVar[str] = "held_commands_diverge"

    @property
    def sentence(self) -> str:
        """At which commands, and when."""
        at = ", ".join(f"{name} {value:.3g}" for name, value in self.commands.items())
        return (
            f"its free run diverges or goes astern with {self.count} of {self.settings} settings "
            f"of the commands of the logs, each held constant, first after {self.after:.3g} s "
            f"({at})"
        )


class SomeHeldDiverge(HeldCommandsDiverge):
    """As `HeldCommandsDiverge`, with so few settings that it does not decide."""

    kind: ClassVar[str] = "some_held_commands_diverge"
    fatal: ClassVar[bool] = False


@dataclass(frozen=True)
class LargeError(Reason):
    """A channel is followed less well than asked.

    Parameters
    ----------
    channel : str
    error : float
        As a share of the spread.
    limit : float
    horizon : float
        Up to which a constant is beaten [s].
    """

    channel: str
    error: float
    limit: float
    horizon: float

    kind: ClassVar[str] = "large_error"

    @property
    def sentence(self) -> str:
        """By how much, or from when on a constant is better."""
        who = channel_words(self.channel)
        if self.error >= 1:
            when = f"after {seconds(self.horizon)}" if self.horizon > 0 else "from the start"
            return f"{who} is worse than a constant {when}"
        return (
            f"the error of {who} is {self.percent} % of its spread "
            f"({100 * self.limit:.0f} % is allowed)"
        )

    @property
    def percent(self) -> str:
        """The error in percent; what is above a limit must not be rounded to it."""
        digits = 0 if round(100 * self.error) > round(100 * self.limit) else 1
        return f"{100 * self.error:.{digits}f}"


@dataclass(frozen=True)
class NarrowBands(Reason):
    """Too many measurements lie outside the bands.

    Parameters
    ----------
    channel : str
    share : float
    interval : tuple of float
    limit : float
    """

    channel: str
    share: float
    interval: tuple[float, float]
    limit: float

    kind: ClassVar[str] = "narrow_bands"

    @property
    def sentence(self) -> str:
        """How many the bands hold."""
        return (
            f"the 95 % bands of {channel_words(self.channel)} hold {100 * self.share:.0f} % "
            f"({100 * self.interval[0]:.0f}-{100 * self.interval[1]:.0f}) of the measurements "
            f"({100 * self.limit:.0f} % is required)"
        )


@dataclass(frozen=True)
class NothingHeldOut(Reason):
    """The model was judged on the logs that it was estimated on.

    Parameters
    ----------
    because : str
    """

    because: str

    kind: ClassVar[str] = "nothing_held_out"

    @property
    def sentence(self) -> str:
        """Why, and what to do."""
        return (
            f"judged on its own logs, nothing was held out, because "
            f"{self.because.rstrip('.')} (give logs to --validate)"
        )


@dataclass(frozen=True)
class NotRefitted(Reason):
    """Some parts could not be left out: the rest does not give an estimate, or time was short.

    Parameters
    ----------
    parts, count : int
        Of all parts.
    because : str
    in_time : bool
        Whether there was time to see what the others do for.
    """

    parts: int
    count: int
    because: str
    in_time: bool = True

    kind: ClassVar[str] = "not_refitted"
    fatal: ClassVar[bool] = False

    @property
    def _left(self) -> str:
        return f"{self.parts} of {self.count} parts {'was' if self.parts == 1 else 'were'}"

    @property
    def sentence(self) -> str:
        """How many, and what the first lacks."""
        if not self.in_time:
            return f"{self._left} not judged: {TOO_SHORT}"
        return (
            f"{self._left} not judged: without {'it' if self.parts == 1 else 'them'} the logs "
            f"do not "
            f"suffice for an estimate ({self.because.rstrip('.')})"
        )


@dataclass(frozen=True)
class NothingMoved(Reason):
    """No channel moved enough to tell anything."""

    kind: ClassVar[str] = "nothing_moved"

    @property
    def sentence(self) -> str:
        """What was seen."""
        return "no channel moved beyond its noise, so its prediction was not tested"


@dataclass(frozen=True)
class HardlyMoved(Reason):
    """A channel does not decide.

    Parameters
    ----------
    channel, unit : str
    spread : float
    noise : float or None
    """

    channel: str
    unit: str
    spread: float
    noise: float | None

    kind: ClassVar[str] = "hardly_moved"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """How little it moved."""
        beside = "" if self.noise is None else f" beside a noise of {self.noise:.2g}"
        return (
            f"{channel_words(self.channel)} hardly moved ({self.spread:.2g} {self.unit}{beside}) "
            f"and does not decide"
        )


@dataclass(frozen=True)
class NoisierThanStated(Reason):
    """Errors are mostly white, and far above the noise that the vessel file states.

    Parameters
    ----------
    channel, unit : str
    seen, stated : float
        Standard deviation of the white noise in the errors, and that of the vessel file [unit].
    """

    channel: str
    unit: str
    seen: float
    stated: float

    kind: ClassVar[str] = "noisier_than_stated"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """Both levels, and where to write the true one."""
        return (
            f"errors of {channel_words(self.channel)} are mostly white noise of {self.seen:.2g} "
            f"{self.unit}, and the vessel file states {self.stated:.2g}: if its sensor is that "
            f"noisy, write {self.channel}_std = {self.seen:.2g} under [sensors]"
        )


@dataclass(frozen=True)
class NoBands(Reason):
    """The bands could not be judged.

    Parameters
    ----------
    because : str
    """

    because: str

    kind: ClassVar[str] = "no_bands"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """Why."""
        return f"there are no bands to judge: {self.because}"


@dataclass(frozen=True)
class DrawsDiverge(Reason):
    """Models within the standard errors diverge, so that there is no band.

    Parameters
    ----------
    logs : tuple of str
    count : int
        Of all runs.
    """

    logs: tuple[str, ...]
    count: int

    kind: ClassVar[str] = "draws_diverge"

    @property
    def sentence(self) -> str:
        """On how many logs."""
        return (
            f"{f'in {len(self.logs)} of {self.count} runs ' * (self.count > 1)}half of the models "
            f"within its standard errors diverge, so it has no bands"
        )


@dataclass(frozen=True, repr=False)
class PredictionVerdict(DisplayMixin):
    """What a model's free run is good for.

    Parameters
    ----------
    level : PredictionLevel
    because : tuple of Reason
        Those that decide first.
    channels : tuple of ChannelPrediction
    judged_on : JudgedOn
    logs : tuple of str
        Names of the logs that were predicted.
    parts : int
        Groups of them that were left out in turn; 0 where none were.
    samples : int
    limits : PredictionLimits
        That the level was found by.
    """

    level: PredictionLevel
    because: tuple[Reason, ...] = ()
    channels: tuple[ChannelPrediction, ...] = ()
    judged_on: JudgedOn = JudgedOn.HELD_OUT
    logs: tuple[str, ...] = ()
    parts: int = 0
    samples: int = 0
    limits: PredictionLimits = field(default=LIMITS)

    @property
    def fit(self) -> dict[str, float]:
        """Fit (6.12) of each channel [%]."""
        return {c.channel: c.fit for c in self.channels}

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square error of each channel [m/s, rad/s]."""
        return {c.channel: c.rmse for c in self.channels}

    @property
    def coverage(self) -> dict[str, float]:
        """Share of the measurements inside the bands, by channel that has some."""
        return {c.channel: c.bands.share for c in self.channels if c.bands is not None}

    @property
    def reason(self) -> str:
        """Why this level, in one sentence without its stop."""
        fatal = [r for r in self.because if r.fatal]
        several = [r for r in fatal if isinstance(r, LargeError) and r.error < 1]
        if len(several) > 1:
            # one sentence for all channels of which the same is said
            told = ", ".join(f"{channel_words(r.channel)} {r.percent} %" for r in several)
            whole = (
                f"the error is too large a share of the spread ({told}; "
                f"{100 * several[0].limit:.0f} % is allowed)"
            )
            sentences = [
                whole if r is several[0] else r.sentence for r in fatal if r not in several[1:]
            ]
            return "; ".join(sentences)
        if fatal:
            return "; ".join(r.sentence for r in fatal)
        if self.level is not PredictionLevel.GOOD:
            return "tests and held-out runs were not asked for"
        return (
            f"the error of {', '.join(c.words for c in self.channels if c.moves)} is at most "
            f"{100 * max(c.error for c in self.channels if c.moves):.0f} % of the spread "
            f"({100 * self.limits.good:.0f} % is allowed)"
        )

    @property
    def text(self) -> str:
        """``good``, ``limited: reason`` or ``poor: reason``."""
        if self.level in (PredictionLevel.GOOD, PredictionLevel.NOT_JUDGED):
            return str(self.level)
        return f"{self.level}: {self.reason}"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the level, a sentence each."""
        return tuple(r.sentence for r in self.because)

    @property
    def judged_words(self) -> str:
        """What the prediction was judged on, in words."""
        several = len(set(self.logs)) > 1
        return {
            JudgedOn.HELD_OUT: f"{so_many(self.parts, 'part')} of the log{'s' * several}, "
            + ("each left out of an estimate in turn" if self.parts != 1 else "left out of it"),
            JudgedOn.VALIDATION: f"{so_many(len(self.logs), 'log')} kept from the "
            f"estimate that was judged",
            JudgedOn.OWN: f"the log{'s' * several} of the estimate",
        }[self.judged_on]

    def summary(self) -> str:
        """Return the level, its reasons and a row for each channel as text."""
        return "\n".join([self.text, *self.table()])

    def table(self) -> list[str]:
        """Return a row for each channel as text, and below it what they were judged on."""
        head, rows = self.rows()
        wide = [max(len(r[i]) for r in [head, *rows]) for i in range(len(head))]
        lines = [
            "  " + "  ".join(cell.ljust(w) for cell, w in zip(row, wide, strict=True)).rstrip()
            for row in [head, *rows]
        ]
        return [
            *lines,
            f"  on {self.judged_words}",
            *(f"  {r.sentence}" for r in self.because if not r.fatal),
        ]

    def rows(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Return the header and a row for each channel, as cells of a table."""
        head = ("channel", "error", "noise alone", "spread", "unit", "fit [%]", "in the 95 % band",
                "beats a constant", "")  # fmt: skip
        return head, [
            (
                c.words,
                number(c.rmse, 3) if np.isfinite(c.rmse) else "diverged",
                number(c.noise, 2),
                number(c.spread, 3),
                c.unit,
                number(c.fit, 3),
                "–"
                if c.bands is None
                else f"{100 * c.bands.share:.0f} % ({100 * c.bands.interval[0]:.0f}-"
                f"{100 * c.bands.interval[1]:.0f})",
                f"to the end ({seconds(c.horizon)})" if c.lasting else seconds(c.horizon),
                "" if c.moves else "hardly moved",
            )
            for c in self.channels
        ]

    def _parts(self) -> tuple[str, ...]:
        return (table(*self.rows()),)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        bands = {c.channel: c.bands for c in self.channels if c.bands is not None}
        return {
            "level": str(self.level),
            "text": self.text,
            "reason": self.reason,
            "because": [r.to_dict() for r in self.because],
            "fit": self.fit,
            "coverage": self.coverage,
            "coverage_interval": {n: list(b.interval) for n, b in bands.items()},
            "independent_samples": {n: b.independent for n, b in bands.items()},
            "rmse": self.rmse,
            "own_rmse": {c.channel: c.own for c in self.channels if c.own is not None},
            "elsewhere_rmse": {
                c.channel: c.elsewhere for c in self.channels if c.elsewhere is not None
            },
            "memory": {c.channel: c.memory for c in self.channels if c.memory is not None},
            "noise": {c.channel: c.noise for c in self.channels},
            "spread": {c.channel: c.spread for c in self.channels},
            "moves": {c.channel: c.moves for c in self.channels},
            "horizon": {c.channel: c.horizon for c in self.channels},
            "lasting": {c.channel: c.lasting for c in self.channels},
            "judged_on": str(self.judged_on),
            "logs": list(self.logs),
            "parts": self.parts,
            "samples": self.samples,
            "limits": self.limits.to_dict(),
        }


NOT_JUDGED = PredictionVerdict(PredictionLevel.NOT_JUDGED)


def weigh_prediction(
    channels: Sequence[ChannelPrediction],
    judged_on: JudgedOn,
    *,
    logs: Sequence[str] = (),
    parts: int = 0,
    samples: int = 0,
    found: Sequence[Reason] = (),
    limits: PredictionLimits = LIMITS,
) -> PredictionVerdict:
    """Weigh what free runs did on logs against the limits.

    Good: every channel that moves is followed, and its bands hold. Poor: a run diverges, on a
    log or where commands are held, or no channel moves and is usable. Limited: all between,
    and whatever was judged on its own logs.

    Parameters
    ----------
    channels : sequence of ChannelPrediction
    judged_on : JudgedOn
    logs, parts, samples
        As `PredictionVerdict`.
    found : sequence of Reason
        What is known beside the channels, such as `RunsDiverge`.
    limits : PredictionLimits
    """
    moving = [c for c in channels if c.moves]
    away = RunsDiverge | Divergence | HeldCommandsDiverge
    diverges = [r for r in found if r.fatal and isinstance(r, away)]
    large = [
        LargeError(c.channel, c.error, limits.good, c.horizon)
        for c in moving
        if not c.error <= limits.good
    ]
    narrow = [
        NarrowBands(c.channel, c.bands.share, c.bands.interval, limits.coverage)
        for c in moving
        if c.bands is not None and c.bands.interval[1] < limits.coverage
    ]
    decisive: list[Reason] = [
        *diverges,
        *(large if not diverges else []),
        *narrow,
        *([] if moving else [NothingMoved()]),
        *(r for r in found if r.fatal and r not in diverges),
    ]
    usable = any(c.error <= limits.usable for c in moving)
    if diverges or not usable:
        level = PredictionLevel.POOR
    else:
        level = PredictionLevel.LIMITED if decisive else PredictionLevel.GOOD
    told = [HardlyMoved(c.channel, c.unit, c.spread, c.noise) for c in channels if not c.moves]
    return PredictionVerdict(
        level,
        (*decisive, *told, *(r for r in found if not r.fatal)),
        tuple(channels),
        judged_on,
        tuple(logs),
        parts,
        samples,
        limits,
    )
