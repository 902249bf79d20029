"""Parameters of the identification model as the simulator takes them."""

from collections.abc import Callable

import numpy as np
import pytest

from emulator.simulator import Dynamics
from ident.model import Model


def _to_dynamics(model: Model, theta: np.ndarray) -> Dynamics:
    """Written out here too, independently of `ident`: the columns Ia and Fv carry whole diagonals."""
    J, C = model.joints, model.coupling
    value = dict(zip(model.names, theta, strict=True))
    Ia, Fv, Fc, offset, viscous_m, dry_m = (
        np.array([value.get(f"{kind}{j + 1}", 0.0) for j in range(J)])
        for kind in ("Ia", "Fv", "Fc", "offset", "fv_m", "fc_m")
    )
    off_diagonal = C.T @ np.diag(viscous_m) @ C
    off_diagonal -= np.diag(np.diag(off_diagonal))
    return Dynamics(
        link=theta[: 10 * J].reshape(J, 10),
        rotor=C.T @ np.diag(np.linalg.solve((C**2).T, Ia)) @ C,
        viscous=np.diag(Fv) + off_diagonal,
        offset_Nm=offset,
        dry_rows=np.vstack([np.eye(J), C]),
        dry_Nm=np.concatenate([Fc - np.abs(np.diag(C)) * dry_m, dry_m]),
        skew_Nms_rad=np.zeros(2 * J),
    ).merged()


@pytest.fixture(scope="session")
def to_dynamics() -> Callable[[Model, np.ndarray], Dynamics]:
    return _to_dynamics
