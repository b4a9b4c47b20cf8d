"""Measures a predicted run as a trial is measured, and names what was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from greybox.prediction.running import DrawnRuns
from greybox.trial.manoeuvres import (
    Quantity,
    TurningCircle,
    ZigZag,
    measure_stopping,
    measure_turning_circle,
    measure_zigzag,
    without_angle,
)
from greybox.trial.manoeuvres.finding import Manoeuvre

# samples in the time of one ship length, and in all, that are enough to measure by, and the
# fewest in a manoeuvre
_DENSE, _MOST, _LEAST = 25, 1200, 200

LABELS: Mapping[str, str] = {
    "approach_speed": "approach speed",
    "advance": "advance",
    "transfer": "transfer",
    "tactical_diameter": "tactical diameter",
    "steady_diameter": "steady turning diameter",
    "steady_radius": "steady turning radius",
    "steady_yaw_rate": "steady yaw rate",
    "steady_speed": "steady speed",
    "steady_drift_angle": "steady drift angle",
    "speed_loss": "speed loss",
    "time_90": "time to 90 deg",
    "time_180": "time to 180 deg",
    "time_360": "time to 360 deg",
    "first_overshoot": "first overshoot",
    "second_overshoot": "second overshoot",
    "first_check_time": "time to check yaw, first",
    "second_check_time": "time to check yaw, second",
    "initial_turning_time": "initial turning time",
    "initial_turning": "initial turning distance",
    "reach": "reach",
    "period": "period",
    "head_reach": "head reach",
    "track_reach": "track reach",
    "lateral_deviation": "lateral deviation",
    "stopping_time": "time to stop",
    "heading_change": "heading change",
}


def quantities(of: Manoeuvre) -> dict[str, Quantity | None]:
    """Return what was measured of a manoeuvre, by the names of `LABELS`."""
    found: dict[str, Quantity | None] = {"approach_speed": of.approach_speed}
    if isinstance(of, TurningCircle):
        diameter = of.final_diameter
        return found | {
            "advance": of.advance,
            "transfer": of.transfer,
            "tactical_diameter": of.tactical_diameter,
            "steady_diameter": diameter,
            "steady_radius": None if diameter is None else diameter.scaled(0.5, "m"),
            "steady_yaw_rate": of.yaw_rate,
            "steady_speed": of.speed,
            "steady_drift_angle": of.drift_angle,
            "speed_loss": of.speed_loss,
            "time_90": of.time_90,
            "time_180": of.time_180,
            "time_360": of.time_360,
        }
    if isinstance(of, ZigZag):
        nth = dict(enumerate(of.overshoots))
        checked = dict(enumerate(of.check_times))
        return found | {
            "first_overshoot": nth.get(0),
            "second_overshoot": nth.get(1),
            "first_check_time": checked.get(0),
            "second_check_time": checked.get(1),
            "initial_turning_time": of.initial_turning_time,
            "initial_turning": of.initial_turning,
            "reach": of.reach,
            "period": of.period,
        }
    return found | {
        "head_reach": of.head_reach,
        "track_reach": of.track_reach,
        "lateral_deviation": of.lateral_deviation,
        "stopping_time": of.time,
        "heading_change": of.heading_change,
    }


def known_from(of: Manoeuvre) -> dict[str, float]:
    """Return the time from the order until which a run determines each quantity [s].

    Those that the whole manoeuvre determines have none.
    """
    times: dict[str, Quantity | float | None] = {"approach_speed": 0.0}
    if isinstance(of, TurningCircle):
        times |= dict.fromkeys(("advance", "transfer", "time_90"), of.time_90)
        times |= dict.fromkeys(("tactical_diameter", "time_180"), of.time_180)
        times |= {"time_360": of.time_360}
    elif isinstance(of, ZigZag):
        times |= dict.fromkeys(("initial_turning", "initial_turning_time"), of.initial_turning_time)
        times |= {"reach": of.reach}
        executes = [e - of.start for e in of.executes]
        for nth, execute, check in zip(
            ("first", "second"), executes[1:], of.check_times, strict=False
        ):
            times |= {f"{nth}_{n}": execute + check.value for n in ("overshoot", "check_time")}
        if of.period is not None:
            times["period"] = executes[3]
    return {n: t.value if isinstance(t, Quantity) else t for n, t in times.items() if t is not None}


def measure(
    runs: DrawnRuns,
    run: int,
    length: float,
    *,
    rudder: float | None = None,
    full_rudder: float | None = None,
    executes: np.ndarray | None = None,
    heading: float | None = None,
    end_speed: float | None = None,
    reversed_thrust: bool = False,
    scale: float = 1.0,
) -> Manoeuvre | None:
    """Measure one run; what it did not reach is None, as is a zig-zag that never swings back.

    Parameters
    ----------
    runs : DrawnRuns
    run : int
    length : float
        [m]
    rudder, full_rudder : float or None
        Steering angle and the greatest one [rad]; None where no angle steers.
    executes : ndarray or None
        (n,) samples since the order, −1 for those not reached: a zig-zag.
    heading : float or None
        At which a zig-zag is reversed [rad].
    end_speed : float or None
        Surge velocity that ends a stop [m/s].
    reversed_thrust : bool
    scale : float
        Length of the full-scale ship over `length`.
    """
    stop = int(runs.complete[run]) + 1 if runs.complete[run] >= 0 else len(runs.t)
    x_n, y_n = runs.track(run, stop)
    psi, states = runs.psi[:stop, run], runs.states[:stop, :, run]
    start = float(runs.t[runs.order])
    speed = max(float(np.hypot(*states[0, :2])), 1e-9)
    sample_time = float(runs.t[1] - runs.t[0])
    dense = math.floor(length / speed / sample_time / _DENSE)
    thin = max(1, min(dense, (stop - runs.order) // _LEAST), stop // _MOST)
    # counted from the end, so that the last sample stays
    kept = np.arange(stop - 1, -1, -thin)[::-1]
    arrays = runs.t[kept], x_n[kept], y_n[kept], psi[kept], states[kept, 0], states[kept, 1]
    if end_speed is not None:
        return measure_stopping(
            *arrays,
            start=start,
            length=length,
            reversed_thrust=reversed_thrust,
            end_speed=end_speed,
            heading_std=0.0,
            position_std=0.0,
        )
    if executes is None:
        return measure_turning_circle(
            *arrays,
            start=start,
            length=length,
            rudder=rudder,
            full_rudder=full_rudder,
            heading_std=0.0,
            position_std=0.0,
        )
    made = runs.t[runs.order] + sample_time * executes[executes >= 0]
    if len(made) < 2:
        return None
    found = measure_zigzag(
        *arrays,
        # the last execute ends what the one before it began
        executes=[float(e) for e in (made[:-1] if len(made) == len(executes) else made)],
        rudder=0.0 if rudder is None else rudder,
        length=length,
        heading=heading,
        stop=float(runs.t[stop - 1]),
        scale=scale,
        heading_std=0.0,
        position_std=0.0,
    )
    return without_angle(found) if rudder is None else found
