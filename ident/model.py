"""The identification model: names and columns of the standard parameters of one robot.

tau = W theta with, per joint, ten inertial parameters of every link, rotor inertia, viscous and Coulomb friction and
an optional offset, named as in Janot, Vandanjon & Gautier 2014 (M, MX, ..., ZZ, Ia, Fv, Fc, offset).

Coupled motors: with motor speeds C dq (joint side), rotors and motor friction act through C',
    tau += C' (Ia_m o C ddq)  +  C' (fv_m o C dq)  +  C' (fc_m o sign(C dq)).
As in the paper, Ia_j and Fv_j carry the whole diagonal (Ia_j = sum_k C_kj² Ia_mk) and Fc_j the motor's share on its
own joint. What is left of a motor k that moves with several joints are the columns `fv_mk` and `fc_mk`: for TX40,
fc_m6 is sign(dq5 + dq6) in row 5 and sign(dq5 + dq6) - sign(dq6) in row 6. The off-diagonal inertia is fixed by the
diagonal, Ia_m = inv((C o C)') Ia, and belongs to the Ia columns: TX40 then has the paper's 60 base parameters. With
`free_coupling_inertia` it gets columns `ia_mk` of its own (61), which some published results use.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident.kernels import inertial_regressor
from protocols.robot import INERTIAL, Geometry, Robot, geometry

Array = NDArray[np.float64]

OFF_DIAGONAL = 1e-9  # entries of C below this are rounding, not gears

_UNITS = {"m": "kg", "mx": "kg·m", "my": "kg·m", "mz": "kg·m"}
_AXIS_UNITS = {"Ia": "kg·m²", "Fv": "N·m·s/rad", "Fc": "N·m", "offset": "N·m"}
_LINEAR_UNITS = {"kg·m²": "kg", "N·m·s/rad": "N·s/m", "N·m": "N"}  # axis parameters of prismatic joints


@dataclass(frozen=True)
class Model:
    """Columns for one robot.

    Attributes:
        robot: Nominal robot: geometry, coupling, gains, a-priori parameters.
        geometry: Its chain.
        offsets: With a constant torque per joint.
        free_coupling_inertia: See the module.
    """

    robot: Robot
    geometry: Geometry
    offsets: bool = True
    free_coupling_inertia: bool = False

    @classmethod
    def of(cls, robot: Robot, *, offsets: bool = True, free_coupling_inertia: bool = False) -> "Model":
        return cls(robot, geometry(robot), offsets, free_coupling_inertia)

    @property
    def joints(self) -> int:
        return self.robot.joints

    @cached_property
    def coupling(self) -> Array:
        """C, shape (J, J)."""
        return self.robot.coupling_matrix()

    @cached_property
    def coupled(self) -> list[int]:
        """Motors whose speed depends on joints other than their own."""
        off = np.abs(self.coupling - np.diag(np.diag(self.coupling))) > OFF_DIAGONAL
        return [int(k) for k in np.flatnonzero(off.any(axis=1))]

    @cached_property
    def _groups(self) -> list[tuple[str, list[int]]]:
        """Axis parameters after the inertial ones: kind and the joints (or motors) that have it."""
        every = list(range(self.joints))
        groups = [("Ia", every), ("Fv", every), ("Fc", every)]
        groups += [("offset", every)] if self.offsets else []
        groups += [("ia_m", self.coupled)] if self.free_coupling_inertia else []
        return [*groups, ("fv_m", self.coupled), ("fc_m", self.coupled)]

    @cached_property
    def names(self) -> list[str]:
        """Name of every standard parameter, in column order."""
        inertial = [f"{p.upper()}{j + 1}" for j in range(self.joints) for p in INERTIAL]
        return inertial + [f"{kind}{j + 1}" for kind, where in self._groups for j in where]

    @cached_property
    def units(self) -> list[str]:
        """Unit of every standard parameter, in column order."""
        inertial = [_UNITS.get(p, "kg·m²") for _ in range(self.joints) for p in INERTIAL]
        axis = []
        for kind, where in self._groups:
            unit = _AXIS_UNITS[kind.replace("ia_m", "Ia").replace("fv_m", "Fv").replace("fc_m", "Fc")]
            axis += [_LINEAR_UNITS[unit] if self.geometry.prismatic[j] else unit for j in where]
        return inertial + axis

    def regressor(self, q: Array, qd: Array, qdd: Array, out: Array | None = None) -> Array:
        """All columns.

        Args:
            q, qd, qdd: shape (T, J).
            out: Result of an earlier call for as many samples, to be overwritten: zeros cost as much as the columns.

        Returns:
            shape (J, T, P): joint, sample, parameter.
        """
        J, C = self.joints, self.coupling
        samples = q.shape[0]
        W = np.zeros((J, samples, len(self.names))) if out is None else out
        inertial_regressor(self.geometry, q, qd, qdd, W)
        motor_speed, motor_acceleration = qd @ C.T, qdd @ C.T
        column = 10 * J
        for kind, where in self._groups:
            for j in where:
                if kind == "Ia":
                    W[:, :, column] = self._rotor_column(j, qdd, motor_acceleration)
                elif kind == "Fv":
                    W[j, :, column] = qd[:, j]
                elif kind == "Fc":
                    W[j, :, column] = np.sign(qd[:, j])
                elif kind == "offset":
                    W[j, :, column] = 1.0
                elif kind == "ia_m":
                    W[:, :, column] = self._off_diagonal(j, qdd, motor_acceleration)
                elif kind == "fv_m":
                    W[:, :, column] = self._off_diagonal(j, qd, motor_speed)
                else:
                    W[:, :, column] = np.outer(C[j], np.sign(motor_speed[:, j]))
                    W[j, :, column] -= abs(C[j, j]) * np.sign(qd[:, j])
                column += 1
        return W

    def _rotor_column(self, j: int, qdd: Array, motor_acceleration: Array) -> Array:
        """Torque per unit of Ia_j, shape (J, T)."""
        if self.free_coupling_inertia or not self.coupled:
            out = np.zeros(qdd.T.shape)
            out[j] = qdd[:, j]
            return out
        return np.asarray(self.coupling.T @ (self._motor_of_diagonal[:, [j]] * motor_acceleration.T))

    def _off_diagonal(self, k: int, rate: Array, motor_rate: Array) -> Array:
        """C'e_k (C rate)_k without its diagonal, shape (J, T)."""
        c = self.coupling[k]
        return np.asarray(np.outer(c, motor_rate[:, k]) - (c**2)[:, None] * rate.T)

    @cached_property
    def _motor_of_diagonal(self) -> Array:
        """Motor values that give diagonal values, Ia_m = inv((C o C)') Ia, shape (J, J)."""
        return np.asarray(np.linalg.inv((self.coupling**2).T), dtype=float)

    def theta(self, robot: Robot) -> Array:
        """Standard parameters of a robot file, shape (P,)."""
        axes = [joint.parameters for joint in robot.joint]
        C = self.coupling
        diagonal = (C**2).T
        Ia = np.array([a.rotor_inertia_kgm2 for a in axes])
        motor_viscous = np.array([a.motor_viscous_Nms_rad for a in axes])
        motor_coulomb = np.array([a.motor_coulomb_Nm for a in axes])
        values = {
            "Ia": diagonal @ Ia,
            "Fv": np.array([a.viscous_Nms_rad for a in axes]) + diagonal @ motor_viscous,
            "Fc": np.array([a.coulomb_Nm for a in axes]) + np.abs(np.diag(C)) * motor_coulomb,
            "offset": np.array([a.offset_Nm for a in axes]),
            "ia_m": Ia,
            "fv_m": motor_viscous,
            "fc_m": motor_coulomb,
        }
        inertial = [a.inertial() for a in axes]
        return np.concatenate(inertial + [values[kind][where] for kind, where in self._groups])
