"""Compiled kernels against pinocchio: random chains of 1 to 12 joints of both kinds, random inertial parameters."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from emulator import kernels
from protocols.robot import Geometry

Floats = NDArray[np.float64]

RELATIVE = 1e-12  # of the largest term; both sides are double precision sums of some hundred terms


def random_chain(joints: int, rng: np.random.Generator) -> tuple[Geometry, Floats]:
    """Geometry and links whose masses are positive, as pinocchio needs: it stores the centre of mass."""
    R0 = np.array([pin.exp3(rng.normal(size=3) * 2) for _ in range(joints)])
    p0 = rng.normal(size=(joints, 3)) * 0.4
    geometry = Geometry(R0, p0, rng.integers(0, 2, joints), rng.normal(size=3) * 9.81)
    link = rng.normal(size=(joints, 10))
    link[:, 0] = rng.uniform(0.5, 8.0, joints)
    return geometry, link


def pinocchio_model(geometry: Geometry, link: Floats) -> pin.Model:
    model = pin.Model()
    model.gravity.linear = geometry.gravity
    parent = 0
    for j, (m, mx, my, mz, xx, xy, xz, yy, yz, zz) in enumerate(link):
        kind = pin.JointModelPZ() if geometry.prismatic[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, pin.SE3(geometry.R0[j], geometry.p0[j]), f"joint{j + 1}")
        dynamic = np.array([m, mx, my, mz, xx, xy, yy, xz, yz, zz])  # pinocchio's own order
        model.appendBodyToJoint(parent, pin.Inertia.FromDynamicParameters(dynamic), pin.SE3.Identity())
    return model


@pytest.mark.parametrize("joints", range(1, 13))
def test_inverse_dynamics_and_mass_matrix_equal_pinocchio(joints: int) -> None:
    rng = np.random.default_rng(100 + joints)
    for _ in range(5):
        geometry, link = random_chain(joints, rng)
        model = pinocchio_model(geometry, link)
        data = model.createData()
        chain = (geometry.R0, geometry.p0, geometry.prismatic)
        q, qd, qdd = rng.normal(size=(3, joints)) * np.array([[2.0], [3.0], [10.0]])

        tau = pin.rnea(model, data, q, qd, qdd)
        assert kernels.rnea(*chain, geometry.gravity, link, q, qd, qdd) == pytest.approx(
            tau, rel=0, abs=RELATIVE * np.abs(tau).max()
        )
        N = pin.rnea(model, data, q, qd, np.zeros(joints))
        assert kernels.bias(*chain, geometry.gravity, link, q, qd) == pytest.approx(
            N, rel=0, abs=RELATIVE * np.abs(N).max()
        )
        upper = np.triu(pin.crba(model, data, q))
        M = upper + np.triu(upper, 1).T
        assert kernels.mass_matrix(*chain, link, q) == pytest.approx(M, rel=0, abs=RELATIVE * np.abs(M).max())


def test_both_are_linear_in_parameters_that_no_body_could_have() -> None:
    rng = np.random.default_rng(7)
    geometry, _ = random_chain(6, rng)
    chain = (geometry.R0, geometry.p0, geometry.prismatic)
    a, b = rng.normal(size=(2, 6, 10))
    a[2, 0] = b[2, 0] = 0.0  # first moments without mass
    q, qd, qdd = rng.normal(size=(3, 6))
    for function in (
        lambda link: kernels.rnea(*chain, geometry.gravity, link, q, qd, qdd),
        lambda link: kernels.mass_matrix(*chain, link, q),
    ):
        expected = 2 * function(a) - 3 * function(b)
        assert function(2 * a - 3 * b) == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


def test_inverse_dynamics_is_mass_matrix_times_acceleration_plus_bias() -> None:
    rng = np.random.default_rng(8)
    geometry, link = random_chain(9, rng)
    chain = (geometry.R0, geometry.p0, geometry.prismatic)
    q, qd, qdd = rng.normal(size=(3, 9))
    tau = kernels.rnea(*chain, geometry.gravity, link, q, qd, qdd)
    M, N = kernels.mass_matrix(*chain, link, q), kernels.bias(*chain, geometry.gravity, link, q, qd)
    assert M @ qdd + N == pytest.approx(tau, abs=1e-12 * np.abs(tau).max())
