"""The axes of ROS: messages whose meaning ROS defines, as signals of a ship.

By REP 103 the world is east-north-up and the body forward-left-up, so signs and
heading change on the way to north-east-down and forward-starboard-down. Frames whose
names say ``ned`` or ``frd`` are taken as they are.

References
----------
REP 103 (axes and units), REP 145 (IMU), REP 147 (``_ned``, ``_frd``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float64])
Fields = dict[str, float]
Remarks = dict[str, None]

# beyond this a header was stamped by another clock than the recorder's [s]
OTHER_CLOCK = 3600.0

# frames whose axes are those of the world, whatever the message
WORLD_FRAMES = frozenset({"map", "odom", "world", "earth", "enu", "ned", "utm"})
# what the body is called
BODY_FRAMES = frozenset({"base_link", "base_footprint", "base", "body"})


class SkippedMessageError(Exception):
    """The message says that it holds no valid measurement; the argument says why."""


def compass_heading(x: Any, y: Any, z: Any, w: Any, *, ned: bool) -> NDArray[np.float64]:
    """Return the compass direction of the body's x axis from quaternions.

    Parameters
    ----------
    x, y, z, w : array_like
        (N,) each, or numbers; of any length but zero.
    ned : bool
        Whether the world's axes are north-east-down, else east-north-up.

    Returns
    -------
    ndarray
        (N,) [rad], 0 to 2π; NaN where the quaternion gives no direction.
    """
    # what is no quaternion gives no heading, and no warning
    with np.errstate(over="ignore", invalid="ignore"):
        ahead, aside = w * w + x * x - y * y - z * z, 2 * (w * z + x * y)
        yaw = np.arctan2(aside, ahead)
        heading = (yaw if ned else np.pi / 2 - yaw) % (2 * np.pi)
    return np.where((ahead == 0) & (aside == 0), np.nan, heading)


def _heading(q: Mapping[str, Any], *, ned: bool) -> float:
    return float(compass_heading(*(float(q[k]) for k in "xyzw"), ned=ned))


def frame_name(name: Any) -> str:
    """Return the last part of a frame's name, in lower case."""
    return str(name).strip("/").rsplit("/", 1)[-1].casefold()


def is_world(frame: str) -> bool:
    """Whether a frame has the world's axes by its name."""
    return frame in WORLD_FRAMES or frame.endswith("_enu")


def is_ned(frame: str) -> bool:
    """Whether the world's axes are north-east-down by the name of the frame."""
    return frame == "ned" or frame.endswith("_ned")


def is_frd(frame: str) -> bool:
    """Whether the body's axes are forward-right-down by the name of the frame."""
    return "frd" in frame or "ned" in frame


def tells_axes(frame: str) -> bool:
    """Whether the axes of a frame are known by its name; those of a sensor's frame are not."""
    named = is_ned(frame) or is_frd(frame) or "flu" in frame
    return named or is_world(frame) or frame in BODY_FRAMES


def north_east(x: Value, y: Value, *, ned: bool) -> tuple[Value, Value]:
    """Return north and east of a vector along the world's x and y."""
    return (x, y) if ned else (y, x)


def starboard(value: Value, *, frd: bool) -> Value:
    """Return a component along the body's y, or about its z, as positive to starboard."""
    return value if frd else -value


def pose_fields(pose: Mapping[str, Any], ned: bool, remarks: Remarks) -> Fields:
    """Return ``x_n``, ``y_n`` [m] and ``psi`` [rad] of a pose, and remark on its axes."""
    x, y = float(pose["position"]["x"]), float(pose["position"]["y"])
    remarks[
        "world frame north-east-down: positions and heading as they are"
        if ned
        else "world frame east-north-up (REP 103): x_n = y, y_n = x, psi = pi/2 - yaw"
    ] = None
    north, east = north_east(x, y, ned=ned)
    return {"x_n": north, "y_n": east, "psi": _heading(pose["orientation"], ned=ned)}


def twist_fields(twist: Mapping[str, Any], frd: bool, remarks: Remarks) -> Fields:
    """Return ``u``, ``v`` [m/s] and ``r`` [rad/s] of a twist in body axes, and remark on them."""
    remarks[
        "body frame forward-right-down: velocities as they are"
        if frd
        else "body frame forward-left-up (REP 103): u = x, v = -y, r = -yaw rate"
    ] = None
    linear, angular = twist["linear"], twist["angular"]
    return {
        "u": float(linear["x"]),
        "v": starboard(float(linear["y"]), frd=frd),
        "r": starboard(float(angular["z"]), frd=frd),
    }


def _odometry(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    world, body = frame_name(m["header"]["frame_id"]), frame_name(m["child_frame_id"])
    ned = is_ned(world)
    frd = is_frd(body) or (ned and "flu" not in body)
    return pose_fields(m["pose"]["pose"], ned, remarks) | twist_fields(
        m["twist"]["twist"], frd, remarks
    )


def _pose_stamped(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    pose = m["pose"]
    return pose_fields(pose.get("pose", pose), is_ned(frame_name(m["header"]["frame_id"])), remarks)


def _twist_stamped(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    twist = m["twist"]
    twist = twist.get("twist", twist)
    frame = frame_name(m["header"]["frame_id"])
    if is_world(frame):
        remarks[f"its frame '{frame}' is the world's, so its velocities are not u, v"] = None
        return {
            f"{part}.{k}": float(twist[part][k]) for part in ("linear", "angular") for k in "xyz"
        }
    # of a sensor's frame the other signals of the trial tell
    return twist_fields(twist, is_frd(frame), remarks if tells_axes(frame) else {})


def _quaternion_stamped(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    frame = frame_name(m["header"]["frame_id"])
    ned = is_ned(frame)
    if tells_axes(frame):
        remarks["psi = yaw" if ned else "psi = pi/2 - yaw (REP 103)"] = None
    return {"psi": _heading(m["quaternion"], ned=ned)}


def _imu(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    frame = frame_name(m["header"]["frame_id"])
    frd = is_frd(frame)
    found: Fields = {}
    # a first covariance of -1 says that the sensor does not measure the quantity
    if m["angular_velocity_covariance"][0] != -1:
        found["r"] = starboard(float(m["angular_velocity"]["z"]), frd=frd)
        remarks["yaw rate as it is" if frd else "r = -yaw rate (z up, REP 103)"] = None
    if m["orientation_covariance"][0] != -1:
        found["psi"] = _heading(m["orientation"], ned=frd)
        remarks["psi = yaw" if frd else "psi = pi/2 - yaw (REP 103)"] = None
    return found


def _fix(m: Mapping[str, Any], remarks: Remarks) -> Fields:
    status, lat, lon = m["status"]["status"], float(m["latitude"]), float(m["longitude"])
    if status < 0:
        raise SkippedMessageError("they have no fix (status < 0)")
    if not (abs(lat) <= 90 and abs(lon) <= 360):
        raise SkippedMessageError("they hold no position")
    return {"lat": lat, "lon": lon, "altitude": float(m["altitude"])}


# by type of message; each may raise SkippedMessageError, or KeyError where fields are missing
HANDLERS: dict[str, Callable[[Mapping[str, Any], Remarks], Fields]] = {
    "sensor_msgs/msg/NavSatFix": _fix,
    "sensor_msgs/msg/Imu": _imu,
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_stamped,
    "geometry_msgs/msg/QuaternionStamped": _quaternion_stamped,
    "geometry_msgs/msg/TwistStamped": _twist_stamped,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist_stamped,
}
# messages that a driver stamps with the frame of its sensor, whatever their axes
_OF_SENSORS = {
    "geometry_msgs/msg/QuaternionStamped": frozenset({"psi"}),
    "geometry_msgs/msg/TwistStamped": frozenset({"u", "v"}),
    "geometry_msgs/msg/TwistWithCovarianceStamped": frozenset({"u", "v"}),
}


def unsure_fields(kind: str, message: Mapping[str, Any]) -> frozenset[str]:
    """Return the signals of a message whose axes its frame does not tell."""
    names = _OF_SENSORS.get(kind, frozenset())
    if names and tells_axes(frame_name(message["header"]["frame_id"])):
        return frozenset()
    return names
