"""Identified base parameters back into a robot file, for the emulator and for control.

Base parameters do not determine the standard ones. Of all standard parameters that give the identified base values,
the ones nearest to the nominal robot are taken, distances counted in the nominal 1-sigma where the file has it. The
torques are those of the identified model; a single mass remains mostly prior. Consistency (positive masses and
inertias) is not enforced: `physically_consistent` says whether it was examined.
"""

import msgspec
import numpy as np
from numpy.typing import NDArray

from ident.base import Base
from ident.model import Model
from protocols.robot import Joint, Parameters, Robot

Array = NDArray[np.float64]


def identified_robot(model: Model, base: Base, beta: Array) -> Robot:
    """The nominal robot with parameters moved onto `beta`.

    Args:
        beta: Base parameters, shape (b,).
    """
    nominal = model.theta(model.robot)
    scale = prior_sigma(model)
    BD = base.B * scale
    step = np.linalg.lstsq(BD @ BD.T, beta - base.B @ nominal, rcond=None)[0]
    return _with(model, nominal + scale * (BD.T @ step))


def prior_sigma(model: Model) -> Array:
    """1-sigma of each standard parameter; 1 where the robot file has none, shape (P,)."""
    known = [j if j.sigma is None else msgspec.structs.replace(j, parameters=j.sigma) for j in model.robot.joint]
    sigma = model.theta(msgspec.structs.replace(model.robot, joint=known))
    has = np.array([j.sigma is not None for j in model.robot.joint])
    owner = np.array(
        [int(name.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz_")) - 1 for name in model.names]
    )
    return np.where(has[owner] & (sigma > 0), sigma, 1.0)


def _with(model: Model, theta: Array) -> Robot:
    """Robot whose `model.theta` is `theta`."""
    J = model.joints
    value = dict(zip(model.names, theta, strict=True))
    C2 = (model.coupling**2).T
    nominal = [j.parameters for j in model.robot.joint]
    rotor = np.linalg.inv(C2) @ [value[f"Ia{j + 1}"] for j in range(J)]
    motor_viscous = np.array([value.get(f"fv_m{k + 1}", p.motor_viscous_Nms_rad) for k, p in enumerate(nominal)])
    motor_coulomb = np.array([value.get(f"fc_m{k + 1}", p.motor_coulomb_Nm) for k, p in enumerate(nominal)])
    viscous = np.array([value[f"Fv{j + 1}"] for j in range(J)]) - C2 @ motor_viscous
    coulomb = np.array([value[f"Fc{j + 1}"] for j in range(J)]) - np.abs(np.diag(model.coupling)) * motor_coulomb
    joints: list[Joint] = []
    for j, joint in enumerate(model.robot.joint):
        ten = [float(v) for v in theta[10 * j : 10 * j + 10]]
        parameters = Parameters(
            mass_kg=ten[0],
            first_moment_kgm=(ten[1], ten[2], ten[3]),
            inertia_kgm2=(ten[4], ten[5], ten[6], ten[7], ten[8], ten[9]),
            rotor_inertia_kgm2=float(rotor[j]),
            viscous_Nms_rad=float(viscous[j]),
            coulomb_Nm=float(coulomb[j]),
            motor_viscous_Nms_rad=float(motor_viscous[j]),
            motor_coulomb_Nm=float(motor_coulomb[j]),
            offset_Nm=float(value.get(f"offset{j + 1}", joint.parameters.offset_Nm)),
        )
        joints.append(msgspec.structs.replace(joint, parameters=parameters))
    return msgspec.structs.replace(model.robot, joint=joints)
