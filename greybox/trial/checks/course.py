"""Course against heading: a compass that points elsewhere than the vessel goes.

Where no measured u and v can judge the compass, the course must keep to the bow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, Outcome, exact_finding
from greybox.trial.checks.motion import make_motion, smooth
from greybox.trial.checks.wind_convention import STEADIER
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import Step, mend
from greybox.vessel.vessel import Vessel

# a hull that goes ahead drifts by less than this; thrusters that push sideways may do more
PLAUSIBLE = np.radians(20)
_LEAST_TURN = np.radians(20)
_LEAST_SHARE = 0.95
_WINDOW = 2.0
# parts of a log that are left out in turn for the error (jackknife)
_BLOCKS = 12
# samples under way, and the speed that is way [m/s]
_LEAST_SAMPLES = 50
LEAST_SPEED = 0.2
# no current carries a vessel sideways so fast [m/s], and no hull drifts at such an angle
_FAST, SIDEWAYS = 4.0, np.radians(60)


@dataclass(frozen=True)
class Course:
    """Heading and velocity over ground while a vessel makes way.

    Parameters
    ----------
    t : ndarray
        (N,) [s].
    psi : ndarray
        (N,) as logged [rad].
    turning : ndarray
        (N,) rate of `psi` [rad/s].
    track : ndarray
        (N,) velocity, north + i east [m/s].
    """

    t: Array
    psi: Array
    turning: Array
    track: NDArray[np.complex128]

    def drift(self, psi: Array) -> NDArray[np.complex128]:
        """Return the direction of the way against a bow that points to `psi`, each of length 1."""
        return np.asarray(self.track / np.abs(self.track) * np.exp(-1j * psi))


def make_course(recording: Recording) -> Course | None:
    """Return the course of a recording, None without positions (or their rates) and heading."""
    names = ("v_n", "v_e", "psi") if "v_n" in recording else ("x_n", "y_n", "psi")
    motion = make_motion(recording, names)
    if motion is None or not all(n in motion for n in names):
        return None
    velocity = _velocity(motion.t, motion[names[0]], motion[names[1]], motion.step, names[0])
    speed = np.hypot(*velocity.T)
    quick = float(np.quantile(speed, 0.9))
    rows = np.flatnonzero(speed > 0.5 * quick)
    if len(rows) < _LEAST_SAMPLES or quick < LEAST_SPEED:
        rows = rows[:0]
    psi = motion["psi"]
    turning = np.gradient(smooth(psi, motion, _WINDOW / 2), motion.step)
    track = velocity[rows, 0] + 1j * velocity[rows, 1]
    return Course(motion.t[rows], psi[rows], turning[rows], track)


def course_scatter(
    courses: Sequence[Course], read: Callable[[Array], Array]
) -> tuple[float, float]:
    """Return how the courses of several logs lie to their headings.

    Parameters
    ----------
    courses : sequence of Course
    read : callable
        ψ as logged -> ψ as it may be meant [rad].

    Returns
    -------
    tuple of float
        Circular variance within the logs, 0 where the course keeps its angle to the bow and 1
        where it goes anywhere; and the mean angle, from the bow to starboard [rad].
    """
    sums = [complex(c.drift(read(c.psi)).sum()) for c in courses]
    count = sum(len(c.psi) for c in courses)
    if not count:
        return 1.0, 0.0
    return 1.0 - sum(map(abs, sums)) / count, float(np.angle(sum(sums)))


def course_findings(recording: Recording, vessel: Vessel) -> tuple[list[Finding], list[Outcome]]:
    """Find a compass that points elsewhere than the vessel goes, or a course that is mirrored.

    A course that turns against the heading is that of positions in other axes, or both heading
    and yaw rate are reversed. The velocity over ground is a body-fixed direction turned by the
    heading, plus a current and the drift of a turning hull: where the direction is far off the
    bow on every heading and no thruster pushes that way, the heading is wrong.

    Parameters
    ----------
    recording : Recording
        Canonical, with positions or velocities over ground, and heading.
    vessel : Vessel
    """

    def untold(why: str) -> tuple[list[Finding], list[Outcome]]:
        return [], [Outcome("heading_bias", "cannot tell", why)]

    vague = "the log has no measured u and v, only course over ground and heading"
    course = make_course(recording)
    if course is None:
        return untold("needs positions and heading")
    psi, track = course.psi, course.track
    if not len(psi):
        return untold(f"{vague}, and it hardly moves")
    if mirrored := _against_heading(recording, course):
        return mirrored, []
    unit = course.drift(psi)
    mean = complex(unit.mean())
    angle = float(np.angle(mean))
    spread = float(np.ptp(psi))
    sentence = f"{vague}: a bias cannot be told from a drift angle of {np.degrees(angle):.0f} deg"
    astern = abs(abs(angle) - np.pi) < PLAUSIBLE
    if not astern and (sideways := _sideways(recording, vessel, course)):
        return sideways, []
    if abs(mean) < _LEAST_SHARE or abs(angle) < PLAUSIBLE or astern or spread < _LEAST_TURN:
        return untold(sentence)
    if _pushed(recording, vessel, angle):
        return untold(f"{sentence}, and the thrusters push that way")
    # a current beside the body-fixed direction, and the drift of a turning hull: all are fitted
    bow = np.exp(1j * psi)
    design = np.column_stack([bow, np.ones(len(psi)), 1j * course.turning * bow])
    bias = _bias(design, track)
    blocks = np.array_split(np.arange(len(psi)), _BLOCKS)
    left = [_bias(np.delete(design, b, axis=0), np.delete(track, b)) for b in blocks]
    apart = np.angle(np.exp(1j * (np.array(left) - bias)))
    error = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum((apart - apart.mean()) ** 2)))
    if abs(bias) - 1.96 * error < PLAUSIBLE:
        return untold(
            f"{vague}: beside a current and the drift of turning, the course lies "
            f"{np.degrees(-bias):.0f} +/- {np.degrees(1.96 * error):.0f} deg off the heading"
        )
    # what a drifting hull may add is unknown: the interval allows for a plausible drift angle
    half = float(np.hypot(1.96 * error, PLAUSIBLE / 2))
    finding = Finding(
        "heading_bias",
        "psi",
        bias,
        (bias - half, bias + half),
        "rad",
        f"beside a current and the drift of turning, the course lies "
        f"{abs(np.degrees(bias)):.0f} deg to {'starboard' if bias < 0 else 'port'} of the heading "
        f"on all headings (over {np.degrees(spread):.0f} deg): a vessel does not go so sideways, "
        f"its compass or antenna pair is turned",
        f"subtract {bias:.3f} rad from psi once its mounting is known (import --fix-also "
        f"heading_bias does)",
        ("psi",),
        (mend("turn_heading", ("psi",), angle=bias),),
        False,
        {"t": course.t, "drift": np.angle(unit)},
    )
    return [finding], []


def sign_finding(
    words: str, channels: tuple[str, ...], repair: tuple[Step, ...], why: str, sure: bool
) -> Finding:
    """Return the finding that channels are reversed, exchanged or turned, as its repair says."""
    kind = "frame" if len(repair) > 1 else "sign"
    flag = "--fix" if sure else f"--fix-also {kind}"
    named = " and ".join(channels)
    fix = f"change the sign of {named} (import {flag} does), or map it with sign = -1"
    value, unit = -1.0, "1"
    if not repair:
        value, fix = 0.0, "exchange latitude and longitude in [columns] and read the raw file again"
    elif len(repair) > 1:
        value, fix = 0.0, f"replace {named} by pi/2 - {named} (import {flag} does)"
    elif repair[0].operation == "exchange":
        value, fix = 0.0, f"exchange {named} (import {flag} does), or correct [columns]"
    elif repair[0].operation == "offset":
        value, unit, fix = np.pi, "rad", f"add half a turn to {named} (import {flag} does)"
    return exact_finding(kind, channels, value, unit, f"{words}: {why}", fix, repair, sure)


def _against_heading(recording: Recording, course: Course) -> list[Finding]:
    """Find a course that turns to starboard where the heading turns to port."""
    as_named, _ = course_scatter([course], lambda psi: psi)
    against, angle = course_scatter([course], lambda psi: -psi)
    still, _ = course_scatter([course], np.zeros_like)
    # a course that hardly turns lies alike to any heading
    if STEADIER * against > as_named or STEADIER * against > still:
        return []
    # where the course would lie to the bow
    off = {"swapped": np.pi / 2 - angle, "y_n": -angle, "x_n": np.pi - angle}
    how = min(off, key=lambda k: abs(np.angle(np.exp(1j * off[k]))))
    channels: tuple[str, ...] = ("x_n", "y_n")
    if how == "swapped":
        words, repair = "x_n and y_n are swapped", mend("exchange", channels)
    else:
        words, channels = f"{how} is reversed", (how,)
        repair = mend("scale", channels, factor=-1.0)
    both = "v_n" in recording
    rest = " and r" if "r" in recording else ""
    why = (
        f"the course turns against the heading, and only so does it keep to the bow, "
        f"{abs(np.degrees(np.angle(np.exp(1j * off[how])))):.0f} deg off; that psi{rest} "
        f"{'are' if rest else 'is'} reversed would explain as much"
    )
    if both:
        # positions and velocity over ground agree: the heading is alone
        channels = ("psi", "r") if rest else ("psi",)
        words = f"psi{rest} {'are' if rest else 'is'} reversed"
        repair = mend("scale", channels, factor=-1.0)
        why = "the course turns against the heading, by the velocity over ground"
    return [sign_finding(words, channels, (repair,), why, False)]


def _sideways(recording: Recording, vessel: Vessel, course: Course) -> list[Finding]:
    """Find a course that lies where no hull goes, at a speed that no current has."""
    drift = course.drift(course.psi)
    mean = complex(drift.mean())
    angle = float(np.angle(mean))
    speed = float(np.median(np.abs(course.track)))
    if speed < _FAST or abs(angle) < SIDEWAYS or abs(mean) > _LEAST_SHARE:
        return []
    if _pushed(recording, vessel, angle):
        return []
    low, high = np.quantile(np.angle(drift / np.exp(1j * angle)), (0.025, 0.975)) + angle
    return [
        Finding(
            "heading_bias", "psi", -angle, (-float(high), -float(low)), "rad",
            f"at {speed:.3g} m/s the course lies {abs(np.degrees(angle)):.0f} deg to "
            f"{'starboard' if angle > 0 else 'port'} of the heading in the mean, "
            f"{np.degrees(low):.0f} to {np.degrees(high):.0f} deg for 95 % of the samples: a "
            f"vessel does not go so sideways, the unit, sign or zero of its heading or of its "
            f"positions is another",
            "compare headings with the courses of straight legs, and correct [columns]",
            ("psi",), picture={"t": course.t, "drift": np.angle(drift)},
        )
    ]  # fmt: skip


def _bias(design: NDArray[np.complex128], track: NDArray[np.complex128]) -> float:
    """Return minus the angle of the body-fixed direction [rad]."""
    return -float(np.angle(np.linalg.lstsq(design, track, rcond=None)[0][0]))


def _velocity(t: Array, north: Array, east: Array, step: float, name: str) -> Array:
    if name == "v_n":
        return np.column_stack([north, east])
    half = max(1, round(_WINDOW / 2 / step))
    position = np.column_stack([north, east])
    out = np.zeros_like(position)
    out[half:-half] = (position[2 * half :] - position[: -2 * half]) / (
        t[2 * half :] - t[: -2 * half]
    )[:, None]
    return out


def _pushed(recording: Recording, vessel: Vessel, angle: float) -> bool:
    """Whether the thrusters' mean force lies on the same side as the drift."""
    from greybox.vessel.force import generalised_force

    if not all(c in recording for c in vessel.commands):
        return False
    commands = {c: recording[c].value[np.isfinite(recording[c].value)] for c in vessel.commands}
    size = min(len(v) for v in commands.values())
    if not size:
        return False
    made = generalised_force(vessel, {c: v[:size] for c, v in commands.items()})
    across = float(np.mean(made.get("tauy", np.zeros(1))))
    # a moment is no part of the force
    forces = [made[name] for name in ("taux", "tauy") if name in made]
    total = sum(float(np.mean(np.abs(f))) for f in forces) or 1.0
    return bool(across * np.sin(angle) > 0.05 * total)
