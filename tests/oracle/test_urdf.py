"""URDF chains against pinocchio's own inverse dynamics, axes in every direction."""

import os
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from ident.kernels import inertial_regressor
from protocols import config
from protocols.errors import ConfigError
from protocols.robot import Robot, geometry, load
from protocols.urdf import chain

TYPES = ["revolute", "prismatic", "revolute", "revolute"]
AXES = ["0 1 0", "1 2 -0.5", "0 0 -1", "-1 0 0"]


def urdf(types: list[str] = TYPES, axes: list[str] = AXES) -> str:
    links = ['<link name="base"/>']
    joints = []
    for j, (kind, axis) in enumerate(zip(types, axes, strict=True), start=1):
        links.append(
            f'<link name="l{j}"><inertial><mass value="{j}"/><origin xyz=".1 -.2 .{j}" rpy=".{j} .2 -.3"/>'
            f'<inertia ixx=".{j}" iyy=".3" izz=".4" ixy=".01" ixz="-.02" iyz=".03"/></inertial></link>'
        )
        parent = "base" if j == 1 else f"l{j - 1}"
        joints.append(
            f'<joint name="j{j}" type="{kind}"><parent link="{parent}"/><child link="l{j}"/>'
            f'<origin xyz=".{j} .1 -.2" rpy=".4 -.{j} .7"/><axis xyz="{axis}"/>'
            '<limit effort="1" velocity="1" lower="-1" upper="1"/></joint>'
        )
    return f'<robot name="r">{"".join(links)}{"".join(joints)}</robot>'


def robot_toml(names: list[str]) -> str:
    joint = """
[[joint]]
name = "{}"
position_min_rad = -1.0
position_max_rad = 1.0
velocity_max_rad_s = 1.0
torque_max_Nm = 1.0
drive = {{ gear_ratio = 1.0, drive_gain_Nm_A = 1.0, rated_current_A = 1.0, max_current_A = 1.0 }}
"""
    return 'name = "r"\nurdf = "arm.urdf"\n' + "".join(joint.format(n) for n in names)


def write(folder: Path, text: str, names: list[str]) -> Path:
    (folder / "arm.urdf").write_text(text)
    (folder / "robot.toml").write_text(robot_toml(names))
    return folder / "robot.toml"


def test_torques_equal_pinocchio(tmp_path: Path) -> None:
    robot = load(str(write(tmp_path, urdf(), ["j1", "j2", "j3", "j4"])))
    model = pin.buildModelFromUrdf(str(tmp_path / "arm.urdf"))
    data = model.createData()
    rng = np.random.default_rng(5)
    q, qd, qdd = rng.normal(size=(3, 10, 4))
    theta = np.concatenate([j.parameters.inertial() for j in robot.joint])
    ours = (inertial_regressor(geometry(robot), q, qd, qdd) @ theta).T
    theirs = np.array([pin.rnea(model, data, *state) for state in zip(q, qd, qdd, strict=True)])
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


def test_the_loaded_robot_stands_alone(tmp_path: Path) -> None:
    robot = load(str(write(tmp_path, urdf(), ["j1", "j2", "j3", "j4"])))
    assert robot.urdf is None
    assert [j.kind for j in robot.joint] == TYPES
    again = config.parse(config.to_toml(robot), Robot, "again")
    np.testing.assert_array_equal(geometry(again).R0, geometry(robot).R0)


@pytest.mark.parametrize(
    ("text", "names", "sentence"),
    [
        (urdf(), ["j1", "j2", "j4", "j3"], "moving joints are j1, j2, j3, j4, but r has j1, j2, j4, j3"),
        ("<robot", ["j1"], "not a URDF that pinocchio reads"),
        (urdf(["floating"], ["0 0 1"]), ["j1"], "j1 is neither revolute nor prismatic"),
        (urdf().replace('<parent link="l3"/>', '<parent link="l1"/>'), ["j1", "j2", "j3", "j4"], "one serial chain"),
    ],
)
def test_what_is_no_serial_chain_is_refused(tmp_path: Path, text: str, names: list[str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        load(str(write(tmp_path, text, names)))


def test_the_published_urdf_of_the_tx40_has_the_paper_s_frames() -> None:
    shared = Path(os.environ.get("ARMRIG_SHARED", Path(__file__).parents[3] / "shared"))
    path = shared / "data" / "tx40" / "tx40_mdh_modified.urdf"
    if not path.is_file():
        pytest.skip(f"{path.name} is not here; ARMRIG_SHARED names the folder of public recordings")
    robot = config.parse(robot_toml([f"joint_{j}" for j in range(1, 7)]), Robot, "tx40")
    found, _ = chain(path, robot)
    nominal = geometry(load("tx40"))
    # Both follow Khalil's convention but for the offset of q2, q3 and q6: z axes and the distances agree.
    np.testing.assert_allclose(found.R0[:, :, 2], nominal.R0[:, :, 2], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found.p0[2:], axis=1), np.linalg.norm(nominal.p0[2:], axis=1), atol=1e-9)
