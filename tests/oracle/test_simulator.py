"""The closed-loop simulator against pinocchio, scipy's DOP853, conserved energy and closed forms."""

import numpy as np
import pinocchio as pin
import pytest

from emulator.forward import Chain, smooth_acceleration, workspace
from emulator.simulator import Dynamics
from protocols.robot import Geometry

Array = np.ndarray


def random_arm(joints: int, rng: np.random.Generator) -> tuple[Geometry, Dynamics, pin.Model]:
    """A chain of both kinds of joints with physical links, full rotor and viscous matrices, and its pinocchio twin."""
    R0 = np.array([pin.exp3(rng.normal(size=3) * 2) for _ in range(joints)])
    p0 = rng.normal(size=(joints, 3)) * 0.3
    place = Geometry(R0, p0, rng.integers(0, 2, joints), rng.normal(size=3) * 5)
    model, parent, link = pin.Model(), 0, []
    model.gravity.linear = place.gravity
    for j in range(joints):
        inertia = pin.Inertia.Random()
        kind = pin.JointModelPZ() if place.prismatic[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, pin.SE3(R0[j], p0[j]), f"joint{j + 1}")
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()  # pinocchio's own order
        link.append([m, mx, my, mz, xx, xy, xz, yy, yz, zz])
    C = np.eye(joints) + np.diag(rng.uniform(0.2, 1.0, joints - 1), -1)
    rows = np.vstack([np.eye(joints), C[1:]])
    dynamics = Dynamics(
        link=np.array(link),
        rotor=C.T @ np.diag(rng.uniform(0.1, 0.5, joints)) @ C,
        viscous=C.T @ np.diag(rng.uniform(0.1, 2.0, joints)) @ C,
        offset_Nm=rng.normal(size=joints),
        dry_rows=rows,
        dry_Nm=rng.uniform(0.2, 2.0, len(rows)),
        skew_Nms_rad=rng.normal(size=len(rows)) * 0.3,
    )
    return place, dynamics, model


def acceleration_by_pinocchio(model: pin.Model, d: Dynamics, k: float, q: Array, qd: Array, tau: Array) -> Array:
    """The direct model written out in numpy around pinocchio's mass matrix and bias."""
    data = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    M = upper + np.triu(upper, 1).T + d.rotor
    speed = d.dry_rows @ qd
    friction = d.viscous @ qd + d.dry_rows.T @ (d.dry_Nm * np.tanh(k * speed) + d.skew_Nms_rad * abs(speed))
    return np.linalg.solve(M, tau - pin.rnea(model, data, q, qd, 0 * qd) - friction - d.offset_Nm)


@pytest.mark.parametrize("joints", range(1, 13))
def test_acceleration_equals_pinocchio(joints: int) -> None:
    rng = np.random.default_rng(500 + joints)
    place, dynamics, model = random_arm(joints, rng)
    arm = Chain(place.R0, place.p0, place.prismatic, place.gravity), dynamics.terms()
    qdd = np.empty(joints)
    for _ in range(5):
        q, qd, tau = rng.normal(size=(3, joints)) * np.array([[2.0], [3.0], [10.0]])
        assert smooth_acceleration(*arm, np.full(len(dynamics.dry_Nm), 20.0), q, qd, tau, workspace(joints), qdd)
        expected = acceleration_by_pinocchio(model, dynamics, 20.0, q, qd, tau)
        assert qdd == pytest.approx(expected, rel=0, abs=1e-12 * np.abs(expected).max() * joints)
