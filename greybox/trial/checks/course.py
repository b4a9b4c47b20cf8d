"""Course against heading, where no velocity sensor of its own can judge the compass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import make_motion, smooth
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import mend
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
_LEAST_SPEED = 0.2


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
    if len(rows) < _LEAST_SAMPLES or quick < _LEAST_SPEED:
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
    """Find a compass that points elsewhere than the vessel goes.

    The velocity over ground is a body-fixed direction turned by the heading,
    plus a current and the drift of a turning hull: where the direction is far off
    the bow on every heading and no thruster pushes that way, the heading is wrong.

    Parameters
    ----------
    recording : Recording
        Canonical, with positions or velocities over ground, and heading.
    vessel : Vessel
    """

    def untold(why: str) -> tuple[list[Finding], list[Outcome]]:
        return [], [Outcome("heading_bias", "cannot tell", why)]

    vague = "the log has no velocity sensor of its own, only course and heading"
    course = make_course(recording)
    if course is None:
        return untold("needs positions and heading")
    psi, track = course.psi, course.track
    if not len(psi):
        return untold(f"{vague}, and it hardly moves")
    unit = course.drift(psi)
    mean = complex(unit.mean())
    angle = float(np.angle(mean))
    spread = float(np.ptp(psi))
    sentence = f"{vague}: a bias cannot be told from a drift angle of {np.degrees(angle):.0f} deg"
    astern = abs(abs(angle) - np.pi) < PLAUSIBLE
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
