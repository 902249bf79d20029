"""Recordings by others: written here with the `mcap` package's own writer, message by message, mixed up."""

import io

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from protocols import topics
from protocols.errors import DataError
from protocols.recording import read_recording
from protocols.robot import load


def joint_states(
    names: list[str],
    position: np.ndarray,
    effort: np.ndarray,
    t_s: np.ndarray,
    *,
    stamped: bool = True,
    compression: CompressionType = CompressionType.LZ4,
) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=4096, compression=compression)
    writer.start("ros2", "a stranger")
    schema = writer.register_schema(topics.JOINT_STATE.name, "ros2msg", topics.JOINT_STATE.text.encode())
    other = writer.register_channel("/camera/info", "cdr", schema)
    channel = writer.register_channel("/arm/joint_states", "cdr", schema)
    for q, tau, t in zip(position, effort, t_s, strict=True):
        t_ns = round(float(t) * 1e9)
        values = {
            **topics.stamp(t_ns if stamped else 0),
            "header.frame_id": "base",
            "name": names,
            "position": q.tolist(),
            "velocity": [0.0] * len(names),
            "effort": tau.tolist(),
        }
        data = topics.JOINT_STATE.encode(values)
        writer.add_message(channel, log_time=t_ns, data=data, publish_time=t_ns)
        writer.add_message(other, log_time=t_ns, data=data[:-8], publish_time=t_ns)
    writer.finish()
    return out.getvalue()


@pytest.fixture
def motion():
    rng = np.random.default_rng(5)
    t = 1.7e9 + np.arange(400) * 0.002 + rng.uniform(-0.0004, 0.0004, 400)
    return rng.normal(size=(400, 6)), rng.normal(size=(400, 6)), t


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("stamped", [True, False])
def test_joint_states_alone_are_enough(motion, compression, stamped):
    q, tau, t = motion
    robot = load("tx40")
    names = [*robot.joint_names[::-1], "gripper"]  # another order, and one joint more
    wide = [np.column_stack([x[:, ::-1], np.zeros(400)]) for x in (q, tau)]
    data = joint_states(names, *wide, t, stamped=stamped, compression=compression)
    recording = read_recording(data, robot)
    np.testing.assert_array_equal(recording.position_rad, q)
    np.testing.assert_array_equal(recording.effort_Nm, tau)
    assert recording.period_s == pytest.approx(0.002, rel=1e-3)
    np.testing.assert_allclose(np.diff(recording.t_s), recording.period_s)
    assert (recording.verdict, recording.drives, recording.rig) == ("UNVERIFIABLE", None, None)
    with pytest.raises(DataError, match="has efforts, not currents"):
        recording.current_A()


def test_a_hole_in_the_stamps_is_a_gap(motion):
    q, tau, t = motion
    keep = np.r_[0:100, 150:400]
    recording = read_recording(joint_states(load("tx40").joint_names, q[keep], tau[keep], t[keep]), load("tx40"))
    assert [(g.cycles, len(g.joints)) for g in recording.gaps] == [(50, 6)]
    assert recording.stretches() == [slice(0, 100), slice(100, 350)]


def test_nan_is_refused_with_its_place(motion):
    q, tau, t = motion
    tau[17, 3] = np.nan
    tau[20, 3] = np.inf
    with pytest.raises(DataError, match=r"foreign.mcap: effort of joint4 is nan in row 17 of 400 \(2 such values\)"):
        read_recording(joint_states(load("tx40").joint_names, q, tau, t), load("tx40"), "foreign.mcap")


def test_what_is_missing_is_said(motion):
    q, tau, t = motion
    robot = load("tx40")
    with pytest.raises(DataError, match=r"no robot file is attached. Give one with --robot"):
        read_recording(joint_states(robot.joint_names, q, tau, t))
    with pytest.raises(DataError, match=r"has the joints a, .* but not joint1, .*joint6 of the robot TX40"):
        read_recording(joint_states(list("abcdef"), q, tau, t), robot)
    with pytest.raises(DataError, match="the joint states have no effort"):
        read_recording(joint_states(robot.joint_names, q, tau[:, :0], t), robot)
    with pytest.raises(DataError, match=r"the time stamps do not increase \(row 400 of 400\)|\(row 200 of 400\)"):
        read_recording(joint_states(robot.joint_names, q, tau, np.r_[t[:200], t[:200]]), robot)


def test_neither_cycles_nor_joint_states():
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("/chatter", "cdr", schema)
    writer.add_message(channel, 1, b"\0\1\0\0\2\0\0\0a\0", 1)
    writer.finish()
    with pytest.raises(DataError, match=r"has neither /drives/cycle nor a topic of type sensor_msgs/msg/JointState"):
        read_recording(out.getvalue(), load("tx40"))


def test_other_encodings_are_named():
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
    channel = writer.register_channel("/joint_states", "json", schema)
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    with pytest.raises(DataError, match="/joint_states is encoded as json by jsonschema; cdr by ros2msg is read"):
        read_recording(out.getvalue(), load("tx40"))
