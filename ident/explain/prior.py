"""What the robot file believes: standard parameters with their 1-sigma."""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ident.model import Model
from protocols.robot import Robot

Array = NDArray[np.float64]

WIDE = 3.0  # sigma of a parameter without a prior, in multiples of the torque that it could make typical


@dataclass(frozen=True)
class Prior:
    """beta ~ N(theta, diag(sigma²)); a parameter with sigma 0 is not refitted.

    Attributes:
        theta, sigma: Standard parameters in the order of the model, shape (P,).
        unknown: Joints whose robot file states no 1-sigma.
    """

    theta: Array
    sigma: Array
    unknown: list[str]

    @classmethod
    def of(cls, model: Model) -> "Prior":
        """Prior of a robot file; wide where it states none: inertias of a body of its size, any friction."""
        robot = model.robot
        theta = model.theta(robot)
        unknown = [j.name for j in robot.joint if j.sigma is None]
        sigma = model.theta(_with_sigma(robot))
        for column, name in enumerate(model.names):
            j = int(name.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz_")) - 1
            joint = robot.joint[j]
            if joint.sigma is None and not name.startswith("offset"):
                sigma[column] = _wide(name, float(theta[column]), joint.torque_max_Nm, joint.velocity_max_rad_s)
        return cls(theta, np.abs(sigma), unknown)


def _with_sigma(robot: Robot) -> Robot:
    joints = [j if j.sigma is None else msgspec.structs.replace(j, parameters=j.sigma) for j in robot.joint]
    return msgspec.structs.replace(robot, joint=joints)


def _wide(name: str, value: float, torque_Nm: float, speed: float) -> float:
    """Sigma that rules out nothing that the drive could move."""
    kind = name.rstrip("0123456789")
    if kind in {"Fc", "fc_m"}:
        return 0.3 * torque_Nm
    if kind in {"Fv", "fv_m"}:
        return 0.3 * torque_Nm / speed
    if kind == "M":
        return max(abs(value), torque_Nm / 10)
    return max(abs(value), torque_Nm / 50)
