"""Serial chain of a URDF file: placements for the kernels and nominal inertial parameters, read by pinocchio.

A joint axis that is not z is turned to z: the link frame of `Geometry` is pinocchio's joint frame times the smallest
rotation that takes z to the axis, and inertias are expressed in it. Fixed joints are merged by pinocchio.
"""

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocols.errors import ConfigError
from protocols.robot import Geometry, Robot

Array = NDArray[np.float64]


def chain(path: Path, robot: Robot) -> tuple[Geometry, list[Array]]:
    """Geometry and nominal inertial parameters of a URDF file.

    Args:
        robot: Its joints in order; their names are the URDF's.

    Returns:
        The geometry, with the robot's gravity, and per joint the ten parameters in the order of `INERTIAL`.

    Raises:
        ConfigError: Unreadable, not a serial chain, or other joints than the robot's.
    """
    import pinocchio as pin

    try:
        model = pin.buildModelFromUrdf(str(path))
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"{path}: not a URDF that pinocchio reads: {str(error).splitlines()[0]}.") from error
    names = list(model.names)[1:]
    if names != robot.joint_names:
        raise ConfigError(
            f"{path}: moving joints are {', '.join(names) or '(none)'}, but {robot.name} has"
            f" {', '.join(robot.joint_names)}; use the URDF's names, in its order."
        )
    if list(model.parents)[1:] != list(range(len(names))):
        raise ConfigError(f"{path}: the joints do not form one serial chain from the base to the tool.")
    for name, freedom in zip(names, list(model.nvs)[1:], strict=True):
        if freedom != 1:
            raise ConfigError(f"{path}: {name} is neither revolute nor prismatic, it moves in {freedom} ways.")
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = [
        _axis(pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)[:, model.joints[j].idx_v])
        for j in range(1, len(names) + 1)
    ]
    R0, p0, inertial = [], [], []
    before = np.eye(3)
    for j, (turn, _) in enumerate(axes, start=1):
        placement = model.jointPlacements[j]
        R0.append(before.T @ placement.rotation @ turn)
        p0.append(before.T @ placement.translation)
        body = model.inertias[j].se3Action(pin.SE3(turn.T, np.zeros(3)))
        v = body.toDynamicParameters()  # m, mx, my, mz, xx, xy, yy, xz, yz, zz about the frame origin
        inertial.append(v[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]])
        before = turn
    prismatic = np.array([slides for _, slides in axes])
    return Geometry(np.array(R0), np.array(p0), prismatic, np.array(robot.gravity_m_s2)), inertial


def resolved(path: Path, robot: Robot) -> Robot:
    """The robot with the URDF's placements written into its joints, so that its file stands alone from then on.

    Links to which the robot file gives a mass keep their inertial parameters.

    Raises:
        ConfigError: See `chain`.
    """
    geometry, inertial = chain(path, robot)
    joints = []
    for j, joint in enumerate(robot.joint):
        parameters = joint.parameters
        if parameters.mass_kg == 0:
            m, mx, my, mz, xx, xy, xz, yy, yz, zz = inertial[j].tolist()
            parameters = msgspec.structs.replace(
                parameters, mass_kg=m, first_moment_kgm=(mx, my, mz), inertia_kgm2=(xx, xy, xz, yy, yz, zz)
            )
        joints.append(
            msgspec.structs.replace(
                joint,
                kind="prismatic" if geometry.prismatic[j] else "revolute",
                placement=tuple(tuple(row) for row in [*geometry.R0[j].tolist(), geometry.p0[j].tolist()]),
                parameters=parameters,
            )
        )
    return msgspec.structs.replace(robot, joint=joints, urdf=None)


def _axis(S: Array) -> tuple[Array, int]:
    """Rotation that takes z to a joint's axis, and whether the joint slides.

    Args:
        S: The joint's own column of its Jacobian in its own frame: linear, then angular, shape (6,).
    """
    linear, angular = S[:3], S[3:]
    prismatic = int(np.linalg.norm(linear) > 0.5)
    axis = linear if prismatic else angular
    x, y, c = axis
    if c < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0]), prismatic
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])  # of z x axis = (-y, x, 0)
    return np.eye(3) + cross + cross @ cross / (1 + c), prismatic
