"""Base parameters: the smallest set that determines the torques, and how the others regroup into it.

Columns of a random regressor are taken in the order of preference of Gautier & Khalil 1990 (IEEE Trans. Robotics and
Automation 6, 368-372), and a column that depends on those before it is dropped. So the names come out as published:
YY, MZ and M of revolute links regroup into the others (ZZ1R = ZZ1 + Ia1 + ...), never the other way round.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.model import Model

Array = NDArray[np.float64]

STATES = 400  # random states: rows outnumber the columns of the longest supported chain several times
DEPENDENT = 1e-9  # share of a column's norm not explained by the columns before it, below which it depends on them
NEGLIGIBLE = 1e-9  # regrouping coefficients below this are rounding

_REVOLUTE_LAST = ("YY", "MZ", "M")
_PRISMATIC_LAST = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")  # a sliding link does not turn against the one before it


@dataclass(frozen=True)
class Base:
    """beta = B theta and, on every motion, W theta = W[:, kept] beta.

    Attributes:
        kept: Columns of the standard parameters that stay, shape (b,), ascending.
        B: shape (b, P); identity on the kept columns.
        names: Paper's names, with R where others were regrouped in.
        units: Of the kept parameters.
        standard: Names of all standard parameters, shape (P,).
    """

    kept: NDArray[np.int64]
    B: Array
    names: list[str]
    units: list[str]
    standard: list[str]

    def relations(self) -> list[str]:
        """`ZZ1R = ZZ1 + Ia1 + 0.0506·M3` for every base parameter that others were regrouped into."""
        out = []
        for row, kept, name in zip(self.B, self.kept, self.names, strict=True):
            terms = [(float(k), self.standard[i]) for i, k in enumerate(row) if k != 0 and i != kept]
            if terms:
                out.append(f"{name} = {self.standard[kept]}" + "".join(_term(k, term) for k, term in terms))
        return out

    @property
    def unidentifiable(self) -> list[str]:
        """Standard parameters that no motion of this robot shows."""
        return [name for name, column in zip(self.standard, self.B.T, strict=True) if not column.any()]


def base_parameters(model: Model) -> Base:
    """Base parameters of a model; depends on the robot's geometry alone."""
    rng = np.random.default_rng(20140101)  # any generic states will do; fixed, so that the answer is
    J = model.joints
    low = [j.position_min_rad for j in model.robot.joint]
    high = [j.position_max_rad for j in model.robot.joint]
    q = rng.uniform(low, high, (STATES, J))
    W = model.regressor(q, rng.normal(size=(STATES, J)), rng.normal(size=(STATES, J)))
    W = W.reshape(-1, W.shape[2])
    kept, B = _select(W, _preference(model))
    regrouped = (B != 0).sum(axis=1) > 1
    names = [model.names[k] + ("R" if r else "") for k, r in zip(kept, regrouped, strict=True)]
    return Base(kept, B, names, [model.units[k] for k in kept], model.names)


def _preference(model: Model) -> list[int]:
    """Columns, the ones to keep first. Rotors come after the inertial classes that keep their name in the papers,
    and before those that lose it."""
    prismatic = model.geometry.prismatic

    def rank(column: int) -> tuple[int, int]:
        if column >= 10 * model.joints:
            return (1, -column)
        name = model.names[column].rstrip("0123456789")
        last = _PRISMATIC_LAST if prismatic[column // 10] else _REVOLUTE_LAST
        return (2 if name in last else 0, -column)

    return sorted(range(len(model.names)), key=rank)


def _select(W: Array, order: list[int]) -> tuple[NDArray[np.int64], Array]:
    """Independent columns in order of preference, and the regrouping matrix."""
    norms = np.linalg.norm(W, axis=0)
    scale = np.where(norms > DEPENDENT * norms.max(), norms, np.inf)  # zero columns: seen by no joint
    basis = np.empty((W.shape[0], 0))
    kept: list[int] = []
    for column in order:
        w = W[:, column] / scale[column]
        rest = w - basis @ (basis.T @ w)
        rest -= basis @ (basis.T @ rest)  # twice is enough (Kahan)
        size = np.linalg.norm(rest)
        if size > DEPENDENT:
            kept.append(column)
            basis = np.column_stack([basis, rest / size])
    kept.sort()
    index = np.array(kept)
    B = np.linalg.lstsq(W[:, index] / norms[index], W, rcond=None)[0] / norms[index][:, None]
    B[np.abs(B) < NEGLIGIBLE] = 0.0
    B[:, index] = np.eye(len(kept))
    return index, B


def _term(k: float, name: str) -> str:
    size = abs(k)
    factor = "" if abs(size - 1) < NEGLIGIBLE else f"{size:.4g}·"
    return f" {'-' if k < 0 else '+'} {factor}{name}"
