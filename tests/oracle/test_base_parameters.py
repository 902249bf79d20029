"""Base parameters: counts and names of the papers, and W theta = W_base beta."""

import msgspec
import numpy as np
import pytest

from ident.base import base_parameters
from ident.model import Model
from protocols.robot import Robot, load

# Janot, Vandanjon & Gautier 2014, Table 3.
ESSENTIAL = {"ZZ1R", "XX2R", "XZ2R", "ZZ2R", "MX2R", "XX3R", "ZZ3R", "MY3R", "MX4", "MY5R", "fv_m6", "fc_m6"}
ESSENTIAL |= {f"{kind}{j}" for kind in ("Fv", "Fc") for j in range(1, 7)} | {"Ia3", "Ia4", "Ia5", "Ia6"}


def test_tx40_has_the_paper_s_60_parameters_by_its_names(tx40: Robot) -> None:
    base = base_parameters(Model.of(tx40))
    assert len(base.names) == 60
    assert len(ESSENTIAL) == 28
    assert set(base.names) >= ESSENTIAL
    assert len(base_parameters(Model.of(tx40, offsets=False)).names) == 54
    assert len(base_parameters(Model.of(tx40, free_coupling_inertia=True)).names) == 61


def test_tx40_regroups_as_published(tx40: Robot) -> None:
    relations = base_parameters(Model.of(tx40)).relations()
    d3, r3, r4 = 0.225, 0.035, 0.225
    assert "MX2R = MX2 + 0.225·M3 + 0.225·M4 + 0.225·M5 + 0.225·M6" in relations
    assert "MY5R = MY5 - MZ6" in relations
    (zz1,) = [r for r in relations if r.startswith("ZZ1R")]
    assert zz1.startswith("ZZ1R = ZZ1 + YY2 + ") and zz1.endswith(" + Ia1")
    assert f"{d3**2 + r3**2:.4g}·M3" in zz1
    (zz3,) = [r for r in relations if r.startswith("ZZ3R")]
    assert f"{2 * r4:.4g}·MZ4" in zz3


@pytest.mark.parametrize("prismatic", [(), (0,), (2,), (1, 4), (0, 1, 2)])
def test_base_columns_carry_the_whole_torque(tx40: Robot, prismatic: tuple[int, ...]) -> None:
    joints = [
        msgspec.structs.replace(j, kind="prismatic" if i in prismatic else "revolute") for i, j in enumerate(tx40.joint)
    ]
    model = Model.of(msgspec.structs.replace(tx40, joint=joints))
    base = base_parameters(model)
    rng = np.random.default_rng(2)
    W = model.regressor(*rng.normal(size=(3, 60, 6))).reshape(360, -1)
    theta = rng.normal(size=W.shape[1])
    np.testing.assert_allclose(W @ theta, W[:, base.kept] @ (base.B @ theta), atol=1e-9 * np.abs(W @ theta).max())
    assert np.linalg.matrix_rank(W) == len(base.names)


def test_one_sliding_axis_has_one_mass() -> None:
    base = base_parameters(Model.of(load("emps")))
    assert base.names == ["M1R", "Fv1", "Fc1", "offset1"]
    assert base.relations() == ["M1R = M1 + Ia1"]
    assert base.units == ["kg", "N·s/m", "N", "N"]
    assert "ZZ1" in base.unidentifiable
