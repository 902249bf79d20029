"""Identification's regressor against pinocchio, for chains of revolute and prismatic joints."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from ident.kernels import inertial_regressor
from protocols.robot import Geometry

PINOCCHIO_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # its inertia is xx, xy, yy, xz, yz, zz


def random_chain(joints: int, rng: np.random.Generator, prismatic: NDArray[np.int64]) -> Geometry:
    R0 = np.array([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(joints)])
    R0 *= np.linalg.det(R0)[:, None, None]  # proper rotations
    return Geometry(R0, rng.normal(size=(joints, 3)), prismatic, rng.normal(size=3) * 9)


def pinocchio_model(geometry: Geometry) -> pin.Model:
    model = pin.Model()
    model.gravity.linear = geometry.gravity
    for j, kind in enumerate(geometry.prismatic):
        joint = pin.JointModelPZ() if kind else pin.JointModelRZ()
        model.addJoint(j, joint, pin.SE3(geometry.R0[j], geometry.p0[j]), f"j{j}")
    return model


@pytest.mark.parametrize("joints", [1, 2, 3, 6, 7, 12])
def test_regressor_equals_pinocchio(joints: int) -> None:
    rng = np.random.default_rng(joints)
    geometry = random_chain(joints, rng, rng.integers(0, 2, joints))
    model = pinocchio_model(geometry)
    data = model.createData()
    q, qd, qdd = rng.normal(size=(3, 5, joints))
    ours = inertial_regressor(geometry, q, qd, qdd)
    for t in range(5):
        theirs = pin.computeJointTorqueRegressor(model, data, q[t], qd[t], qdd[t]).reshape(joints, joints, 10)
        expected = theirs[:, :, PINOCCHIO_ORDER].reshape(joints, -1)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(ours[:, t] / scale, expected / scale, rtol=0, atol=1e-12)


def test_a_joint_does_not_feel_the_links_before_it() -> None:
    rng = np.random.default_rng(1)
    W = inertial_regressor(random_chain(4, rng, np.zeros(4, dtype=np.int64)), *rng.normal(size=(3, 7, 4)))
    for joint in range(4):
        assert not W[joint, :, : 10 * joint].any()
