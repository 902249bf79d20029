"""Parameters of an arm as the simulator takes them, free of what a body could have."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.forward import Terms
from protocols.errors import ConfigError
from protocols.robot import Robot

Array = NDArray[np.float64]

_SAME = 1e-9  # relative; rows of speeds that differ by less are one row


def freeze(owner: object, shapes: dict[str, tuple[int, ...]]) -> None:
    """Makes fields of a dataclass read-only arrays.

    Raises:
        ConfigError: A field has not its shape or holds a value that is not a number.
    """
    for name, shape in shapes.items():
        value = np.array(getattr(owner, name), dtype=float)
        if value.shape != shape:
            raise ConfigError(f"{type(owner).__name__}.{name} has shape {value.shape}; it must be {shape}.")
        if np.isnan(value).any():
            raise ConfigError(
                f"{type(owner).__name__}.{name} holds {np.isnan(value).sum()} values that are not numbers."
            )
        value.setflags(write=False)
        object.__setattr__(owner, name, value)


@dataclass(frozen=True)
class Dynamics:
    """Parameters of one arm: tau = M(q) qdd + N(q, qd) + viscous qd + B' (dry sign(B qd) + skew |B qd|) + offset.

    Linear in every array. With motors that turn with C qd (joint side), a diagonal rotor inertia Ia_m and motor
    frictions fv_m, fc_m, besides joint frictions Fv, Fc:

        rotor = C' diag(Ia_m) C        viscous = diag(Fv) + C' diag(fv_m) C        B = [1; C], dry = [Fc; fc_m]

    Attributes:
        link: Ten inertial parameters of each link in the order of `protocols.robot.INERTIAL`, shape (J, 10).
        rotor: Symmetric, added to the links' mass matrix, shape (J, J) [kg·m²].
        viscous: Symmetric, shape (J, J) [N·m·s/rad].
        offset_Nm: Constant torque, shape (J,). Coulomb friction that differs between the directions is Fc = their
            mean and an offset of half their difference.
        dry_rows: B, a speed with dry friction per row, shape (K, J).
        dry_Nm: Coulomb friction of each row, shape (K,).
        skew_Nms_rad: Half the difference of the viscous frictions in the two directions, for each row, shape (K,).
    """

    link: Array
    rotor: Array
    viscous: Array
    offset_Nm: Array
    dry_rows: Array
    dry_Nm: Array
    skew_Nms_rad: Array

    def __post_init__(self) -> None:
        J, K = len(self.link), len(self.dry_rows)
        freeze(self, {"link": (J, 10), "rotor": (J, J), "viscous": (J, J), "offset_Nm": (J,)})
        freeze(self, {"dry_rows": (K, J), "dry_Nm": (K,), "skew_Nms_rad": (K,)})
        for name in ("rotor", "viscous"):
            matrix = getattr(self, name)
            gap = float(np.abs(matrix - matrix.T).max())
            if gap > _SAME * float(np.abs(matrix).max()):
                raise ConfigError(f"Dynamics.{name} must be symmetric; mirrored entries differ by up to {gap:.3g}.")

    @classmethod
    def of(cls, robot: Robot) -> "Dynamics":
        """Parameters of a robot file."""
        axes = [joint.parameters for joint in robot.joint]
        J, C = robot.joints, robot.coupling_matrix()
        viscous, motor_viscous = ([a.viscous_Nms_rad for a in axes], [a.motor_viscous_Nms_rad for a in axes])
        return cls(
            link=np.array([a.inertial() for a in axes]),
            rotor=C.T @ np.diag([a.rotor_inertia_kgm2 for a in axes]) @ C,
            viscous=np.diag(viscous) + C.T @ np.diag(motor_viscous) @ C,
            offset_Nm=np.array([a.offset_Nm for a in axes]),
            dry_rows=np.vstack([np.eye(J), C]),
            dry_Nm=np.array([a.coulomb_Nm for a in axes] + [a.motor_coulomb_Nm for a in axes]),
            skew_Nms_rad=np.zeros(2 * J),
        ).merged()

    def merged(self) -> "Dynamics":
        """The same arm with parallel rows made one and rows without friction left out; simulates faster."""
        rows: list[Array] = []
        dry: list[float] = []
        skew: list[float] = []
        for row, d, s in zip(self.dry_rows, self.dry_Nm, self.skew_Nms_rad, strict=True):
            if not row.any() or (d == 0 and s == 0):
                continue
            size = row[np.argmax(np.abs(row) > _SAME * np.abs(row).max())]  # of the first entry, which becomes 1
            k = next((k for k, other in enumerate(rows) if np.allclose(row / size, other, rtol=_SAME)), len(rows))
            if k == len(rows):
                rows, dry, skew = [*rows, row / size], [*dry, 0.0], [*skew, 0.0]
            dry[k] += d * abs(size)
            skew[k] += s * size * abs(size)
        B = np.array(rows).reshape(-1, len(self.link))
        return replace(self, dry_rows=B, dry_Nm=np.array(dry), skew_Nms_rad=np.array(skew))

    def terms(self) -> Terms:
        """Arguments of the kernels."""
        return Terms(self.link, self.rotor, self.viscous, self.offset_Nm, self.dry_rows, self.dry_Nm, self.skew_Nms_rad)
