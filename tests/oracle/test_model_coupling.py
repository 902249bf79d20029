"""Columns against the physical formula with a coupling matrix, written out motor by motor."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from ident.base import base_parameters
from ident.kernels import inertial_regressor
from ident.model import Model
from ident.writeback import identified_robot
from protocols.robot import Joint, Parameters, Robot, geometry, load

COUPLINGS = {
    "none": None,
    "TX40": [[1, 0, 0], [0, 1, 0], [0, 1, 1]],
    "chain": [[1, 0, 0], [0.3, 1, 0], [-0.5, 1, 1]],
    "scaled": [[1, 0, 0], [0, -2, 0], [0, 0.7, 1.5]],
}


def robot(coupling: list[list[float]] | None, seed: int = 0) -> Robot:
    rng = np.random.default_rng(seed)
    tx40 = load("tx40")
    joints: list[Joint] = []
    for joint in tx40.joint[3:]:
        m, *rest = rng.normal(size=10).tolist()
        other = rng.uniform(0.1, 1, 6).tolist()
        parameters = Parameters(
            mass_kg=m,
            first_moment_kgm=tuple(rest[:3]),
            inertia_kgm2=tuple(rest[3:9]),
            rotor_inertia_kgm2=other[0],
            viscous_Nms_rad=other[1],
            coulomb_Nm=other[2],
            motor_viscous_Nms_rad=other[3],
            motor_coulomb_Nm=other[4],
            offset_Nm=other[5],
        )
        joints.append(msgspec.structs.replace(joint, parameters=parameters))
    return msgspec.structs.replace(tx40, joint=joints, coupling=coupling)


def physical_torque(arm: Robot, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    C = arm.coupling_matrix()
    theta = np.concatenate([j.parameters.inertial() for j in arm.joint])
    tau = (inertial_regressor(geometry(arm), q, qd, qdd) @ theta).T
    for k, joint in enumerate(arm.joint):
        p = joint.parameters
        speed, acceleration = qd @ C[k], qdd @ C[k]
        motor = p.rotor_inertia_kgm2 * acceleration
        motor = motor + p.motor_viscous_Nms_rad * speed + p.motor_coulomb_Nm * np.sign(speed)
        tau += motor[:, None] * C[k]
        tau[:, k] += p.viscous_Nms_rad * qd[:, k] + p.coulomb_Nm * np.sign(qd[:, k]) + p.offset_Nm
    return tau


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("free", [False, True])
def test_columns_times_parameters_are_the_physical_torque(coupling: str, free: bool) -> None:
    arm = robot(COUPLINGS[coupling])
    model = Model.of(arm, free_coupling_inertia=free)
    q, qd, qdd = np.random.default_rng(7).normal(size=(3, 40, 3))
    ours = (model.regressor(q, qd, qdd) @ model.theta(arm)).T
    np.testing.assert_allclose(ours, physical_torque(arm, q, qd, qdd), rtol=0, atol=1e-11)


def test_the_coupled_friction_of_the_tx40_is_in_rows_5_and_6() -> None:
    model = Model.of(load("tx40"))
    qd = np.array([[0, 0, 0, 0, 2.0, -1.0]])
    W = model.regressor(np.zeros((1, 6)), qd, np.zeros((1, 6)))[:, 0]
    np.testing.assert_array_equal(W[:, model.names.index("fc_m6")], [0, 0, 0, 0, 1, 2])  # sign(1) - sign(-1) = 2
    np.testing.assert_array_equal(W[:, model.names.index("fv_m6")], [0, 0, 0, 0, -1, 2])


def test_the_diagonal_is_whole_as_in_the_paper() -> None:
    arm = robot(COUPLINGS["TX40"])
    theta = dict(zip((model := Model.of(arm)).names, model.theta(arm), strict=True))
    rotor = [j.parameters.rotor_inertia_kgm2 for j in arm.joint]
    assert theta["Ia2"] == pytest.approx(rotor[1] + rotor[2])
    assert theta["Ia3"] == pytest.approx(rotor[2])


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_an_identified_robot_has_the_identified_base_parameters(coupling: str) -> None:
    nominal = robot(COUPLINGS[coupling], 0)
    model = Model.of(nominal)
    base = base_parameters(model)
    beta = base.B @ model.theta(robot(COUPLINGS[coupling], 1))
    found = identified_robot(model, base, beta)
    np.testing.assert_allclose(base.B @ model.theta(found), beta, atol=1e-9)
    np.testing.assert_allclose(
        physical_torque(found, *(state := np.random.default_rng(3).normal(size=(3, 20, 3)))),
        physical_torque(robot(COUPLINGS[coupling], 1), *state),
        atol=1e-8,
    )


def test_what_is_already_right_is_not_moved() -> None:
    nominal = load("tx40")
    model = Model.of(nominal)
    base = base_parameters(model)
    found = identified_robot(model, base, base.B @ model.theta(nominal))
    np.testing.assert_allclose(model.theta(found), model.theta(nominal), atol=1e-10)


def test_a_written_robot_file_is_read_back(tmp_path: Path) -> None:
    from protocols import config

    model = Model.of(load("tx40"))
    base = base_parameters(model)
    found = identified_robot(model, base, 1.1 * base.B @ model.theta(model.robot))
    path = tmp_path / "robot2.toml"
    path.write_text(config.to_toml(found), encoding="utf-8")
    assert load(str(path)) == found
