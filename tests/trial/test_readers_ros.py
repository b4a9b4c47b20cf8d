"""Bags are written here by the libraries, and read without them."""

from __future__ import annotations

import json
import math
import re
import sqlite3
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from greybox.errors import LogError
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros import messages as rosmessages
from greybox.trial.readers.ros.axes import compass_heading
from greybox.trial.readers.ros.read import read_bag
from greybox.trial.readers.ros.storage import Channel
from greybox.vessel.toml import load_vessel

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
START = 1_714_550_400  # 2024-05-01 08:00 UTC
CUSTOM = "mytrial/msg/Engine"
for store in (ROS1, ROS2):
    store.register(
        get_types_from_msg("float64 rpm\nint32[3] gears\nfloat32[20] long\nbool on\n", CUSTOM)
    )


def quaternion(store, yaw):
    kind = store.types["geometry_msgs/msg/Quaternion"]
    return kind(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def header(store, t, frame):
    nanos = round(t * 1e9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=nanos // 10**9, nanosec=nanos % 10**9)
    more = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)


def vector(store, x=0.0, y=0.0, z=0.0, kind="Vector3"):
    return store.types[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)


def twist(store, x, y, yaw_rate):
    kind = store.types["geometry_msgs/msg/Twist"]
    return kind(linear=vector(store, x, y), angular=vector(store, z=yaw_rate))


def pose(store, x, y, yaw):
    kind = store.types["geometry_msgs/msg/Pose"]
    return kind(position=vector(store, x, y, kind="Point"), orientation=quaternion(store, yaw))


def odometry(store, t, frame="odom", child="base_link", x=3.0, y=4.0, yaw=0.3, w=-0.1):
    g = store.types
    return g["nav_msgs/msg/Odometry"](
        header=header(store, t, frame),
        child_frame_id=child,
        pose=g["geometry_msgs/msg/PoseWithCovariance"](
            pose=pose(store, x, y, yaw), covariance=np.zeros(36)
        ),
        twist=g["geometry_msgs/msg/TwistWithCovariance"](
            twist=twist(store, 2.0, 0.5, w), covariance=np.zeros(36)
        ),
    )


def fix(store, t, lat=59.0, lon=10.0, status=0):
    g = store.types
    return g["sensor_msgs/msg/NavSatFix"](
        header=header(store, t, "gps"),
        status=g["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=lat,
        longitude=lon,
        altitude=12.0,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )


def imu(store, t, frame="imu_link", yaw=0.3, w=-0.2, known=True):
    none = np.zeros(9)
    none[0] = 0.0 if known else -1.0
    return store.types["sensor_msgs/msg/Imu"](
        header=header(store, t, frame),
        orientation=quaternion(store, yaw),
        orientation_covariance=none,
        angular_velocity=vector(store, z=w),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(store),
        linear_acceleration_covariance=np.zeros(9),
    )


def number(store, value, kind="Float64"):
    return store.types[f"std_msgs/msg/{kind}"](data=value)


def ros1(path, messages, compression=None):
    with Writer1(path) if compression is None else compressed(path, compression) as writer:
        connections = {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            data = ROS1.serialize_ros1(message, kind)
            writer.write(connections[topic], round(time * 1e9), data)
    return path


def compressed(path, kind):
    writer = Writer1(path)
    writer.set_compression(getattr(Writer1.CompressionFormat, kind))
    return writer


def ros2(path, messages, plugin=StoragePlugin.SQLITE3, mode=None):
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            data = ROS2.serialize_cdr(message, kind)
            writer.write(connections[topic], round(time * 1e9), data)
    return path


def drive(store, n=10):
    """Three sensors of a ship that turns to starboard, logged 20 ms late."""
    for k in range(n):
        t = START + 0.1 * k
        yield "/odom", t + 0.02, odometry(store, t, yaw=0.3 - 0.01 * k)
        yield "/gps/fix", t + 0.02, fix(store, t)
        yield "/engine/rpm", t + 0.02, number(store, 100.0 + k)


def mcap(path, rows, *, encoding="json", schema=("", "", b""), **options):
    with open(path, "wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start()
        known = {}
        for topic, time, data in rows:
            if topic not in known:
                number = writer.register_schema(*schema) if schema[0] else 0
                known[topic] = writer.register_channel(topic, encoding, number)
            nanos = round(time * 1e9)
            writer.add_message(known[topic], nanos, data, nanos)
        writer.finish()
    return path


def check_drive(recording, n=10):
    assert set(recording.names) >= {"x_n", "y_n", "psi", "u", "v", "r", "lat", "lon"}
    assert recording.epoch == pytest.approx(START, abs=1e-3)
    np.testing.assert_allclose(recording["x_n"].value, 4.0)
    np.testing.assert_allclose(recording["y_n"].value, 3.0)
    heading = math.pi / 2 - 0.3 + 0.01 * np.arange(n)
    np.testing.assert_allclose(recording["psi"].value, heading, atol=1e-12)
    np.testing.assert_allclose(recording["u"].value, 2.0)
    np.testing.assert_allclose(recording["v"].value, -0.5)
    np.testing.assert_allclose(recording["r"].value, 0.1)
    np.testing.assert_allclose(recording["u"].t, 0.1 * np.arange(n), atol=1e-7)
    np.testing.assert_allclose(recording["engine.rpm"].t, 0.1 * np.arange(n) + 0.02, atol=1e-7)
    np.testing.assert_array_equal(recording["engine.rpm"].value, 100.0 + np.arange(n))
    units = {s.name: s.unit for s in recording.signals}
    assert units["lat"] == "deg"
    assert units["psi"] == "rad"
    assert units["r"] == "rad/s"
    assert units["v"] == "m/s"
    assert units["engine.rpm"] is None
    assert {s.name for s in recording.signals if s.canonical} == {
        "x_n", "y_n", "psi", "u", "v", "r", "lat", "lon",
    }  # fmt: skip
    assert any("REP 103" in n for n in recording.notes)


@pytest.mark.parametrize("compression", [None, "LZ4", "BZ2"])
def test_a_ros1_bag(tmp_path, compression):
    recording = read_bag(ros1(tmp_path / "a.bag", drive(ROS1), compression))
    check_drive(recording)
    assert recording.files[0].name == "a.bag"
    assert recording.files[0].format == "ROS 1 bag"


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (plugin, mode)
        for plugin in StoragePlugin
        for mode in (None, CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE)
        # the database has no compression of its own
        if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)
    ],
)
def test_a_ros2_bag(tmp_path, plugin, mode):
    recording = read_bag(ros2(tmp_path / "b", drive(ROS2), plugin, mode))
    check_drive(recording)
    assert recording.files[0].name == "metadata.yaml"


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_storage_file_alone_and_a_directory_without_metadata(tmp_path, plugin):
    bag = ros2(tmp_path / "b", drive(ROS2), plugin)
    (file,) = [p for p in bag.iterdir() if p.suffix != ".yaml"]
    check_drive(read_bag(file))
    (bag / "metadata.yaml").unlink()
    recording = read_bag(bag)
    check_drive(recording)
    assert any("metadata.yaml is missing" in n for n in recording.notes)


def test_a_database_without_definitions_uses_the_known_types(tmp_path):
    bag = ros2(tmp_path / "b", drive(ROS2))
    with sqlite3.connect(bag / "b.db3") as database:
        database.execute("DROP TABLE message_definitions")
    database.close()
    check_drive(read_bag(bag))


def test_the_ned_frames_are_taken_as_they_are(tmp_path):
    rows = [
        ("/odom", START + k, odometry(ROS2, START + k, "odom_ned", "base_link_frd", w=0.1))
        for k in range(3)
    ]
    recording = read_bag(ros2(tmp_path / "b", rows))
    for name, value in {"x_n": 3, "y_n": 4, "psi": 0.3, "u": 2, "v": 0.5, "r": 0.1}.items():
        np.testing.assert_allclose(recording[name].value, value, err_msg=name)
    assert any("north-east-down" in n for n in recording.notes)


def test_heading_does_not_depend_on_roll_and_pitch(tmp_path):
    # yaw 40 deg in east-north-up, then pitch and roll
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_euler("ZYX", [40, 10, -25], degrees=True).as_quat()
    message = imu(ROS2, START)
    message.orientation = ROS2.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    recording = read_bag(ros2(tmp_path / "b", [("/imu", START, message)]))
    np.testing.assert_allclose(np.degrees(recording["psi"].value), 50.0)


def test_imu_without_orientation_and_the_topic_with_more_messages_keeps_the_name(tmp_path):
    rows = list(drive(ROS2, 5))
    rows += [("/imu", START + 0.05 * k, imu(ROS2, START + 0.05 * k, known=False)) for k in range(9)]
    recording = read_bag(ros2(tmp_path / "b", rows))
    assert len(recording["r"]) == 9
    np.testing.assert_allclose(recording["r"].value, 0.2)
    np.testing.assert_allclose(recording["odom.r"].value, 0.1)
    assert len(recording["psi"]) == 5
    assert not recording["odom.r"].canonical
    assert any("'odom.r'" in n and "(9 messages)" in n for n in recording.notes)


def test_imu_in_a_down_frame_keeps_its_sign(tmp_path):
    message = imu(ROS2, START, "imu_frd", yaw=1.0, w=0.2)
    recording = read_bag(ros2(tmp_path / "b", [("/imu", START, message)]))
    np.testing.assert_allclose(recording["r"].value, 0.2)
    np.testing.assert_allclose(recording["psi"].value, 1.0)


def test_stamped_poses_and_twists(tmp_path):
    g = ROS2.types
    speed = g["geometry_msgs/msg/TwistStamped"]
    place = g["geometry_msgs/msg/PoseStamped"]
    rows = [
        ("/vel", START, speed(header=header(ROS2, START, "base"), twist=twist(ROS2, 1, 2, 3))),
        ("/gpsvel", START, speed(header=header(ROS2, START, "map"), twist=twist(ROS2, 4, 5, 6))),
        ("/pose", START, place(header=header(ROS2, START, "map"), pose=pose(ROS2, 7, 8, 0.0))),
    ]
    recording = read_bag(ros2(tmp_path / "b", rows))
    for name, value in {"u": 1, "v": -2, "r": -3, "x_n": 8, "y_n": 7, "psi": math.pi / 2}.items():
        np.testing.assert_allclose(recording[name].value, value, err_msg=name)
    assert recording["gpsvel.linear.x"].value[0] == 4
    assert any("'map' is the world's" in n for n in recording.notes)


def test_axes_in_the_frame_of_a_receiver_are_decided_by_the_data(tmp_path):
    g = ROS2.types
    speed = g["geometry_msgs/msg/TwistStamped"]
    turn = g["geometry_msgs/msg/QuaternionStamped"]
    rows = []
    for k in range(60):
        t = START + k
        stamped = header(ROS2, t, "gnss")
        # north at 1 m/s, east-north-up; the heading clockwise from north
        rows += [
            ("/velocity", t, speed(header=stamped, twist=twist(ROS2, 0.0, 1.0, 0.0))),
            ("/heading", t, turn(header=stamped, quaternion=quaternion(ROS2, 0.1))),
            ("/fix", t, fix(ROS2, t, lat=59.0 + k / 111_400)),
        ]
    bag = ros2(tmp_path / "b", rows)
    assert read_bag(bag).unsure == {"u", "v", "psi"}
    recording = read_recording(bag, load_vessel("thesis"))
    np.testing.assert_allclose(recording["psi"].value, 0.1)
    np.testing.assert_allclose(recording["v_n"].value, 1.0)
    assert {s.parameters["axes"] for s in recording.steps} == {"east-north-up", "north-east-down"}


def test_fixes_without_a_fix_are_counted_and_left_out(tmp_path):
    rows = [
        ("/fix", START + 0, fix(ROS2, START + 0)),
        ("/fix", START + 1, fix(ROS2, START + 1, status=-1)),
        ("/fix", START + 2, fix(ROS2, START + 2, lat=math.nan)),
        ("/fix", START + 3, fix(ROS2, START + 3, lat=60.0)),
    ]
    recording = read_bag(ros2(tmp_path / "b", rows))
    np.testing.assert_array_equal(recording["lat"].value, [59.0, 60.0])
    np.testing.assert_allclose(recording["lat"].t, [0.0, 3.0])
    assert any("1 message was skipped: they have no fix" in n for n in recording.notes)
    assert any("1 message was skipped: they hold no position" in n for n in recording.notes)


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_other_messages_give_their_numbers(tmp_path, store):
    message = store.types[CUSTOM](
        rpm=120.5, gears=np.array([1, 2, 3], np.int32), long=np.zeros(20, np.float32), on=True
    )
    rows = [("/main/engine", START, message), ("/mode", START, number(store, "auto", "String"))]
    make = ros1 if store is ROS1 else ros2
    recording = read_bag(make(tmp_path / "b.bag", rows))
    assert recording["main.engine.rpm"].value[0] == 120.5
    assert recording["main.engine.gears[2]"].value[0] == 3
    assert recording["main.engine.on"].value[0] == 1
    assert not any("long" in name for name in recording.names)
    assert any("'long' has 20 elements" in n for n in recording.notes)
    assert recording.text["mode"][1].tolist() == ["auto"]


def test_a_header_without_time_uses_the_recorder(tmp_path):
    rows = [("/odom", START + k, odometry(ROS2, 0.0)) for k in range(3)]
    recording = read_bag(ros2(tmp_path / "b", rows))
    np.testing.assert_allclose(recording["u"].t, [0, 1, 2])
    assert any("3 of 3 messages of '/odom' carry no time" in n for n in recording.notes)


def test_headers_of_another_clock_are_not_mixed_with_the_recorder(tmp_path):
    rows = [("/odom", START + k, odometry(ROS2, 5.0 + k)) for k in range(3)]
    recording = read_bag(ros2(tmp_path / "b", rows))
    assert recording.epoch == START
    assert any("come from another clock" in n for n in recording.notes)


def test_a_clock_of_a_simulation_has_no_epoch(tmp_path):
    rows = [("/odom", 5.0 + k, odometry(ROS2, 5.0 + k)) for k in range(3)]
    recording = read_bag(ros2(tmp_path / "b", rows))
    assert recording.epoch is None
    assert any("does not count from 1970" in n for n in recording.notes)


def test_topics_choose_and_rename(tmp_path):
    bag = ros2(tmp_path / "b", drive(ROS2))
    only = read_bag(bag, {"/engine/rpm": "n1"})
    assert only.names == ("n1",)
    recording = read_bag(
        bag,
        {"/odom": "twist.twist.linear.y = left, u=u, r=turn", "/gps/fix": "", "/engine/rpm": ""},
    )
    np.testing.assert_allclose(recording["left"].value, 0.5)
    np.testing.assert_allclose(recording["turn"].value, 0.1)
    assert recording["u"].canonical
    assert not recording["turn"].canonical
    assert recording["left"].unit is None
    assert "lat" in recording
    prefixed = read_bag(bag, {"/odom": "ekf"})
    assert "ekf.psi" in prefixed
    assert not any(s.canonical for s in prefixed.signals)


def test_topics_and_fields_that_are_not_there(tmp_path):
    bag = ros2(tmp_path / "b", drive(ROS2))
    with pytest.raises(LogError, match=r"no topic '/odm'. Did you mean '/odom'.*/engine/rpm"):
        read_bag(bag, {"/odm": ""})
    with pytest.raises(LogError, match=r"no numeric field 'twist.twist.linear.q'"):
        read_bag(bag, {"/odom": "twist.twist.linear.q=u"})


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_with_json(tmp_path, compression):
    rows = [
        ("/a/engine", START + k, json.dumps({"rpm": 10.0 * k, "deep": {"list": [1, k]}}).encode())
        for k in range(4)
    ]
    recording = read_bag(mcap(tmp_path / "a.mcap", rows, compression=compression))
    np.testing.assert_array_equal(recording["a.engine.rpm"].value, [0, 10, 20, 30])
    np.testing.assert_array_equal(recording["a.engine.deep.list[1]"].value, [0, 1, 2, 3])
    np.testing.assert_allclose(recording["a.engine.rpm"].t, [0, 1, 2, 3])
    assert recording.files[0].format == "MCAP"


def test_mcap_with_ros1_messages(tmp_path):
    text, _ = ROS1.generate_msgdef("nav_msgs/msg/Odometry", ros_version=1)
    rows = [
        ("/odom", START + k, bytes(ROS1.serialize_ros1(odometry(ROS1, START + k), ODOMETRY)))
        for k in range(3)
    ]
    schema = ("nav_msgs/Odometry", "ros1msg", text.encode())
    recording = read_bag(mcap(tmp_path / "a.mcap", rows, encoding="ros1", schema=schema))
    np.testing.assert_allclose(recording["r"].value, 0.1)


ODOMETRY = "nav_msgs/msg/Odometry"


def test_fields_that_come_and_go_are_nan(tmp_path):
    rows = [("/a", START + k, json.dumps({f"f{k % 2}": k}).encode()) for k in range(4)]
    rows += [("/a", START + 4, json.dumps({"f0": 1e400, "big": 10**400}).encode())]
    recording = read_bag(mcap(tmp_path / "a.mcap", rows))
    np.testing.assert_array_equal(recording["a.f0"].value, [0, np.nan, 2, np.nan, np.inf])
    np.testing.assert_array_equal(recording["a.f1"].value, [np.nan, 1, np.nan, 3, np.nan])
    assert np.isnan(recording["a.big"].value).all()


# the packages that read bags are an extra

BLOCKED = """
import sys
sys.modules[{package!r}] = None
from greybox.commands.main import main
sys.exit(main(["import", {bag!r}, "--vessel", "thesis", "--out", {out!r}]))
"""


@pytest.mark.parametrize("package", ["rosbags", "ruamel.yaml"])
def test_without_the_extra_one_sentence_says_how_to_get_it(tmp_path, package):
    bag = mcap(tmp_path / "a.mcap", [("/a", START, json.dumps({"x": 1}).encode())])
    script = BLOCKED.format(package=package, bag=str(bag), out=str(tmp_path / "log.csv"))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert f"the package '{package}'" in done.stderr
    assert "pip install 'greybox-marine[ros]'" in done.stderr
    assert not (tmp_path / "log.csv").exists()


def test_other_formats_and_the_axes_of_ros_do_without_the_extra():
    script = """
import sys
for name in ("rosbags", "mcap", "lz4", "zstandard", "ruamel"):
    sys.modules[name] = None
import greybox.trial.readers.csv, greybox.trial.readers.nmea, greybox.trial.readers.mat
from greybox.trial.readers.ros.axes import compass_heading
print(float(compass_heading(0.0, 0.0, 0.0, 1.0, ned=False)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    # the body looks east where it is not turned
    assert float(done.stdout) == pytest.approx(math.pi / 2)


def test_headings_of_many_quaternions():
    yaw = np.array([0.0, 0.3, -2.0])
    q = (np.zeros(3), np.zeros(3), np.sin(yaw / 2), np.cos(yaw / 2))
    np.testing.assert_allclose(compass_heading(*q, ned=True), yaw % (2 * np.pi))
    np.testing.assert_allclose(compass_heading(*q, ned=False), (np.pi / 2 - yaw) % (2 * np.pi))
    wrong = np.array([0.0, np.nan, np.inf, 1e200])
    assert np.isnan(compass_heading(wrong, wrong, wrong, wrong, ned=True)).all()


# files that are damaged, foreign or hostile


def attempt(path):
    """Return the recording, or the message of its error."""
    try:
        return read_bag(path), ""
    except LogError as error:
        return None, str(error)


@pytest.mark.parametrize(
    "text",
    [
        "[1", "a: *b", "- \x01", "!!bool x", '!!float ""', "2024-99-99", "9" * 5000, "[" * 3000,
        "? {a: 1}\n: 2", "just words", "", "rosbag2_bagfile_information: 3", b"\xff\xfe",
    ],
)  # fmt: skip
def test_metadata_that_cannot_be_read_is_done_without(tmp_path, text):
    bag = ros2(tmp_path / "b", drive(ROS2))
    (bag / "metadata.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    recording = read_bag(bag)
    check_drive(recording)
    assert any("metadata.yaml is missing or unreadable" in n for n in recording.notes)


@pytest.mark.parametrize("kind", ["bag", "lz4", "mcap", "zstd", "db3"])
def test_cut_files_are_recovered_or_refused(tmp_path, kind):
    if kind in ("bag", "lz4"):
        file = ros1(tmp_path / "a.bag", drive(ROS1, 30), "LZ4" if kind == "lz4" else None)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        mode = CompressionMode.STORAGE if kind == "zstd" else None
        bag = ros2(tmp_path / "b", drive(ROS2, 30), plugin, mode)
        (file,) = [p for p in bag.iterdir() if p.suffix != ".yaml"]
    whole = file.read_bytes()
    recovered = 0
    for share in np.linspace(0, 0.995, 40):
        cut = tmp_path / f"cut{file.suffix}"
        cut.write_bytes(whole[: int(share * len(whole))])
        recording, message = attempt(cut)
        if recording is None:
            assert re.search(
                "copy the file again|holds no number|no ROS bag|is a bag of format|damaged", message
            )
        else:
            recovered += 1
            np.testing.assert_allclose(recording["u"].value, 2.0)
    assert recovered > (0 if kind == "db3" else 3)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_flipped_bytes_never_raise_anything_else(tmp_path, suffix):
    if suffix == ".bag":
        file = ros1(tmp_path / "a.bag", drive(ROS1, 5))
    else:
        plugin = StoragePlugin.SQLITE3 if suffix == ".db3" else StoragePlugin.MCAP
        bag = ros2(tmp_path / "b", drive(ROS2, 5), plugin)
        (file,) = [p for p in bag.iterdir() if p.suffix != ".yaml"]
    whole = file.read_bytes()
    chance = np.random.default_rng(3)
    hurt = tmp_path / f"hurt{suffix}"
    for _ in range(60):
        data = bytearray(whole)
        for position in chance.integers(0, len(data), 8):
            data[position] = chance.integers(0, 256)
        hurt.write_bytes(data)
        recording, message = attempt(hurt)
        assert recording is not None or len(message) > 20


@pytest.mark.parametrize("head", [b"", b"garbage" * 50, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"])
def test_garbage_is_refused(tmp_path, head):
    file = tmp_path / "a.bag"
    file.write_bytes(head)
    with pytest.raises(LogError, match=r"no ROS bag|no message stands before|holds no number"):
        read_bag(file)


def test_what_is_not_there_or_no_bag(tmp_path):
    with pytest.raises(LogError, match="there is no file"):
        read_bag(tmp_path / "a.bag")
    with pytest.raises(LogError, match=r"holds no \.db3 or \.mcap file"):
        read_bag(tmp_path)
    old = tmp_path / "old.bag"
    old.write_bytes(b"#ROSBAG V1.2\n")
    with pytest.raises(LogError, match="convert it with 'rosbag migrate'"):
        read_bag(old)


def record1(fields, data):
    head = b"".join(
        struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in fields.items()
    )
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def chunk1(kind, stated, data):
    head = {b"op": b"\x05", b"compression": kind, b"size": struct.pack("<I", stated)}
    return b"#ROSBAG V2.0\n" + record1(head, data)


def test_a_chunk_that_states_too_much_is_refused_before_it_is_inflated(tmp_path):
    file = tmp_path / "a.bag"
    file.write_bytes(chunk1(b"lz4", 2**31, b"x"))
    with pytest.raises(LogError, match=f"chunk of {2**31} bytes, at most {limits().held_bytes}"):
        read_bag(file)


@pytest.mark.parametrize("kind", ["lz4", "bz2", "zstd"])
def test_a_chunk_that_holds_more_than_it_states_is_refused(tmp_path, kind):
    import bz2

    import lz4.frame

    zeros = bytes(10**6)
    bomb = {"lz4": lz4.frame.compress, "bz2": bz2.compress, "zstd": zstandard.compress}[kind](zeros)
    file = tmp_path / "a"
    if kind == "zstd":
        content = struct.pack("<QQQII", 0, 0, 1000, 0, 4) + b"zstd"
        content += struct.pack("<Q", len(bomb)) + bomb
        file.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(content)) + content)
    else:
        file.write_bytes(chunk1(kind.encode(), 1000, bomb))
    with pytest.raises(LogError, match="inflates to more than the 1000 bytes that it states"):
        read_bag(file)


def test_many_chunks_exhaust_the_budget(tmp_path, limited):
    import lz4.frame

    limited(unpacked_bytes=10**6, unpacked_ratio=1)
    message = record1({b"op": b"\x04"}, bytes(10**5))
    chunk = chunk1(b"lz4", len(message), lz4.frame.compress(message))
    file = tmp_path / "a.bag"
    file.write_bytes(chunk[:13] + 30 * chunk[13:])
    with pytest.raises(LogError, match="inflates to more than 1000000 bytes"):
        read_bag(file)


def test_a_compressed_file_or_message_that_is_a_bomb_is_refused(tmp_path, limited):
    limited(unpacked_bytes=10**5, unpacked_ratio=1, block_bytes=10**4)
    file = tmp_path / "a.db3.zstd"
    file.write_bytes(zstandard.compress(bytes(10**7)))
    with pytest.raises(LogError, match="inflates to more than 100000 bytes"):
        read_bag(file)
    bag = ros2(tmp_path / "b", drive(ROS2, 1), mode=CompressionMode.MESSAGE)
    with sqlite3.connect(bag / "b.db3") as database:
        bomb = zstandard.compress(bytes(10**7))
        database.execute("UPDATE messages SET data = ?", (bomb,))
    database.close()
    with pytest.raises(LogError, match="inflates to more than"):
        read_bag(bag)


def test_bounds_on_messages_and_numbers(tmp_path, limited):
    bag = ros2(tmp_path / "b", drive(ROS2))
    limited(values=20)
    with pytest.raises(LogError, match="more than 20 numbers"):
        read_bag(bag)
    limited(messages=5)
    with pytest.raises(LogError, match="more than 5 messages"):
        read_bag(bag)


def test_encrypted_and_unknown_compression(tmp_path):
    file = tmp_path / "a.bag"
    head = {b"op": b"\x03", b"encryptor": b"rosbag/AesCbcEncryptor"}
    file.write_bytes(b"#ROSBAG V2.0\n" + record1(head, b""))
    with pytest.raises(LogError, match="is encrypted"):
        read_bag(file)
    file.write_bytes(chunk1(b"rar", 10, b"x"))
    with pytest.raises(LogError, match="compressed with 'rar'"):
        read_bag(file)


@pytest.mark.parametrize(
    "sql",
    [
        "CREATE VIEW messages AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n FROM c) "
        "SELECT 1 AS topic_id, n AS timestamp, zeroblob(100) AS data FROM c",
        "CREATE TABLE messages(id, topic_id, timestamp, data BLOB GENERATED ALWAYS AS "
        "(zeroblob(1000000)))",
    ],
)
def test_a_database_that_would_run_code_is_refused(tmp_path, sql):
    file = tmp_path / "a.db3"
    with sqlite3.connect(file) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)"
        )
        database.execute(sql)
    database.close()
    with pytest.raises(LogError, match="without a plain table 'messages'"):
        read_bag(file)


def test_metadata_cannot_point_outside_nor_make_objects(tmp_path):
    bag = ros2(tmp_path / "b", drive(ROS2))
    secret = ros2(tmp_path / "secret", drive(ROS2)) / "secret.db3"
    meta = bag / "metadata.yaml"
    meta.write_text(
        f"rosbag2_bagfile_information:\n  relative_file_paths: ['../secret/{secret.name}']\n"
    )
    assert [f.name for f in read_bag(bag).files] == ["metadata.yaml", "b.db3"]
    target = tmp_path / "made"
    meta.write_text(f"a: !!python/object/apply:os.system ['touch {target}']\n")
    check_drive(read_bag(bag))
    assert not target.exists()


def decode(definition, data, encoding="ros1"):
    return rosmessages.decoder(Channel("/a", "x/msg/A", encoding, definition))(data)


RULE = "=" * 80


@pytest.mark.parametrize(
    ("definition", "data", "reason"),
    [
        ("x/A a\n", b"", "contains itself"),
        ("x/B b\n", b"", "no definition of 'x/msg/B'"),
        ("float64 ((\n", b"", "cannot be parsed"),
        ("float64 a\n", b"123", "requires a buffer"),
        ("string a\n", struct.pack("<I", 2**31), f"text of {2**31} bytes where 0"),
        ("float64[] a\n", struct.pack("<I", 2**31), f"array of {2**31} where 0"),
        ("float64[4000000000] a\n", b"", "array of 4000000000 where 0"),
        (f"x/B[] b\n{RULE}\nMSG: x/B\n", struct.pack("<I", 2**32 - 1), "more elements than bytes"),
        (f"x/B[3000000000] b\n{RULE}\nMSG: x/B\n", b"", "more elements than bytes"),
        ("# " + "a" * 2**18 + "\n", b"", "its definition has"),
        ("int8 A=[1, 2]\n", b"", "cannot be parsed (AssertionError)"),
        (f"float64[{'9' * 5000}] x\n", b"", "cannot be parsed (ValueError)"),
        ("float64 \n", b"", "cannot be parsed (TypesysError)"),
    ],
)
def test_hostile_definitions(definition, data, reason):
    with pytest.raises(rosmessages.DecodeError, match=re.escape(reason)):
        decode(definition, data)


def test_a_definition_is_never_executed(tmp_path):
    target = tmp_path / "made"
    text = f"float64 a\nstring X=__import__('os').system('touch {target}')\n"
    assert decode(text, struct.pack("<d", 2.5)) == {"a": 2.5}
    assert not target.exists()


def test_cdr_alignment_and_byte_order():
    text = "bool a\nfloat64 b\nstring c\nint16[] d\nuint64 e\n"
    for order, mark in (("<", 1), (">", 0)):
        data = struct.pack(f"{order}?7xdI3sxI3h6xQ", True, 1.5, 3, b"hi\0", 3, 7, 8, 6, 9)
        # the count of `d` stands on 4, its elements follow, `e` on 8
        message = decode(text, bytes([0, mark, 0, 0]) + data, "cdr")
        assert message == {"a": True, "b": 1.5, "c": "hi", "d": [7, 8, 6], "e": 9}


def test_all_topics_unreadable_names_them(tmp_path):
    rows = [("/cam", START, b"\x00\x01")]
    file = mcap(tmp_path / "a.mcap", rows, encoding="protobuf", schema=("foo.Bar", "protobuf", b""))
    with pytest.raises(LogError, match=r"no number that can be read; its topics: /cam \(foo.Bar\)"):
        read_bag(file)


def test_a_failed_checksum_is_noted(tmp_path):
    rows = [("/a", START + k, json.dumps({"x": 1000 + k}).encode()) for k in range(3)]
    file = mcap(tmp_path / "a.mcap", rows, compression=CompressionType.NONE)
    data = file.read_bytes().replace(b"1001", b"1009", 1)
    assert zlib.crc32(data) != zlib.crc32(file.read_bytes())
    file.write_bytes(data)
    recording = read_bag(file)
    assert any("fail their checksum" in n for n in recording.notes)
