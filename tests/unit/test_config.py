"""Robot, rig and motion files: what is refused, and in which words."""

from pathlib import Path

import numpy as np
import pytest

from protocols import config, motion, rig, robot
from protocols.errors import ConfigError

AXIS = """
[[joint]]
name = "{name}"
position_min_rad = -3.0
position_max_rad = 3.0
velocity_max_rad_s = 5.0
torque_max_Nm = 10.0
[joint.drive]
gear_ratio = 32
drive_gain_Nm_A = 10.0
rated_current_A = 1.0
max_current_A = 2.0
"""


def two_axes(extra: str = "") -> robot.Robot:
    text = 'name = "two"\n' + extra + AXIS.format(name="a") + AXIS.format(name="b")
    return config.parse(text, robot.Robot, "two.toml")


def rig_text(period_us: int = 1000, drives: int = 2, joints: str = "ab") -> str:
    lines = [
        f'name = "r"\nrobot = "two.toml"\nsync_period_us = {period_us}\n[[bus]]\nname = "can0"\nchannel = "127.0.0.1:1"'
    ]
    lines += [f'[[drive]]\njoint = "{joints[k]}"\nbus = "can0"\nnode = {k + 1}' for k in range(drives)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = ", "two.toml: not valid TOML"),
        ('name = "x"\njoint = []', "0 joints; serial chains of 1 to 12"),
        ('name = "x"\ncolour = 1\njoint = []', "unknown key `colour`"),
        ('name = "x"' + AXIS.format(name="a") + "gear = 3", "unknown key `gear`, at joint[0].drive"),
        ('name = "x"' + AXIS.format(name="a") * 2, "joint names must differ, not a, a"),
        (
            'name = "x"\ncoupling = [[1.0, 1.0], [1.0, 1.0]]' + AXIS.format(name="a") + AXIS.format(name="b"),
            "coupling is singular",
        ),
        ('name = "x"\n[[joint]]\nname = "a"', "missing key `position_min_rad`"),
        (
            'name = "x"' + AXIS.format(name="a").replace("= -3.0", "= 4.0"),
            "position_min_rad = 4 must be below position_max_rad = 3",
        ),
        ('name = "x"\n[[effect]]\neffect = "gremlins"' + AXIS.format(name="a"), "Invalid enum value 'gremlins'"),
    ],
)
def test_bad_robot_files_are_refused_in_a_sentence(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        config.parse(text, robot.Robot, "two.toml")
    assert message in str(error.value)
    assert error.value.exit_code == 2


def test_a_file_survives_writing_and_reading() -> None:
    arm = two_axes("coupling = [[1.0, 0.0], [1.0, 1.0]]\n")
    assert config.parse(config.to_toml(arm), robot.Robot, "again") == arm


def test_missing_files_name_what_is_shipped() -> None:
    with pytest.raises(ConfigError, match="nowhere: no such file, and not one of the shipped .*tx40"):
        config.locate("nowhere")


def test_coupling_converts_positions_and_torques_both_ways() -> None:
    arm = two_axes("coupling = [[1.0, 0.0], [1.0, 1.0]]\n")
    q = np.array([[0.3, -0.7]])
    assert arm.joint_position(arm.motor_counts(q)) == pytest.approx(q)
    assert arm.motor_counts(q)[0, 1] == pytest.approx((0.3 - 0.7) * arm.joint[1].drive.counts_per_rad)
    tau = np.array([[4.0, 5.0]])
    assert arm.joint_torque(arm.drive_current(tau)) == pytest.approx(tau)
    # Power does not depend on which side of the gear it is counted on: tau . dq = (G i) . (C dq).
    dq = np.array([0.2, 0.9])
    motor_torque = arm.drive_current(tau)[0] * arm.drive_gains()
    assert tau[0] @ dq == pytest.approx(motor_torque @ (arm.coupling_matrix() @ dq))


def test_a_rig_needs_one_drive_for_each_joint() -> None:
    arm = two_axes()
    with pytest.raises(ConfigError, match="drives are given for a, but two has a, b; every joint needs exactly one"):
        rig.check(config.parse(rig_text(drives=1), rig.Rig, "r.toml"), arm, "r.toml")


def test_an_impossible_bus_is_refused_with_its_load() -> None:
    cell = config.parse(rig_text(period_us=250), rig.Rig, "r.toml")
    assert cell.loads()["can0"] == pytest.approx((65 + 2 * 135 + 2 * 115) / 250)
    with pytest.raises(ConfigError, match="bus can0 would be 226 % full \\(2 drives every 250 us, worst case\\)"):
        rig.check(cell, two_axes(), "r.toml")


def test_two_drives_may_not_share_a_node_id() -> None:
    with pytest.raises(ConfigError, match="node 1 appears twice on bus can0"):
        config.parse(rig_text().replace("node = 2", "node = 1"), rig.Rig, "r.toml")


def test_a_recording_never_learns_what_the_emulator_knows() -> None:
    text = rig_text() + '\n[emulated]\nmachine = "truth.toml"\nseed = 7'
    assert "truth" not in config.to_toml(config.parse(text, rig.Rig, "r.toml").for_recording())


SEGMENTS = {
    "fourier": motion.Fourier(
        base_Hz=0.5, periods=2, centre_rad=[0.2, 0.0], sine_rad=[[0.3, 0.2], [0.1, 0.0]], cosine_rad=[[0.1, 0.0]] * 2
    ),
    "polynomial5": motion.Points(point_rad=[[0.0, 0.0], [1.0, -1.0], [-1.0, 0.5]], move_s=[0.8], dwell_s=0.1),
    "trapezoid": motion.Trapezoid(
        point_rad=[[0.0, 0.0], [1.0, 0.1]], velocity_rad_s=[2.0, 1.0], acceleration_rad_s2=[10.0, 5.0], dwell_s=0.1
    ),
}


@pytest.mark.parametrize("kind", SEGMENTS)
def test_references_are_their_own_derivatives_and_end_at_rest(kind: str) -> None:
    dt = 1e-4
    plan = motion.Motion(name="m", segment=[SEGMENTS[kind]])
    ref = motion.sample(plan, two_axes(), dt, np.array([0.5, -0.5]))
    assert ref.q[0] == pytest.approx([0.5, -0.5])
    assert np.gradient(ref.q, dt, axis=0)[1:-1] == pytest.approx(ref.qd[1:-1], abs=2e-3)
    middle = np.abs(np.diff(ref.qdd, axis=0)).max(axis=1) < 0.1  # away from the steps of a trapezoid
    inner = np.flatnonzero(middle[1:-1] & middle[:-2] & middle[2:]) + 1
    assert np.gradient(ref.qd, dt, axis=0)[inner] == pytest.approx(ref.qdd[inner], abs=2e-2)
    assert ref.qd[[0, -1]] == pytest.approx(np.zeros((2, 2)), abs=1e-9)


def test_a_motion_beyond_the_joint_is_refused_with_numbers() -> None:
    far = motion.Motion(name="far", segment=[motion.Points(point_rad=[[0.0, 0.0], [3.5, 0.0]], move_s=[4.0])])
    with pytest.raises(ConfigError, match="far: a would move from 0 to 3.5 rad, outside its range -3 to 3 rad"):
        motion.sample(far, two_axes(), 1e-3)
    fast = motion.Motion(name="fast", segment=[motion.Points(point_rad=[[0.0, 0.0], [1.0, 0.0]], move_s=[0.1])])
    with pytest.raises(ConfigError, match="a would reach 18.75 rad/s, above its limit of 5 rad/s"):
        motion.sample(fast, two_axes(), 1e-3)


def test_a_motion_for_another_arm_is_refused() -> None:
    plan = motion.Motion(name="m", segment=[motion.Points(point_rad=[[0.0], [1.0]], move_s=[1.0])])
    with pytest.raises(ConfigError, match="segment 1: each row of point_rad has 1 values, 2 are needed"):
        motion.sample(plan, two_axes(), 1e-3)


def test_shipped_files_load() -> None:
    library = Path(config.__file__).parent / config.SHIPPED
    assert {p.name for p in library.glob("*-rig.toml")} >= {"tx40-rig.toml", "emps-rig.toml"}
    for path in library.glob("*-rig.toml"):
        _, arm = rig.load_rig(str(path))
        prefix = path.name.removesuffix("-rig.toml")
        for name in ("train", "test"):
            plan = config.read(config.locate(f"{prefix}-{name}"), motion.Motion)
            motion.sample(plan, arm, 1e-3)
