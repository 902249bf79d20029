"""Everything that hypotheses look at: motions, the refitted base model on them, rows, weights and noise floor."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.explain import rows
from ident.explain.motion import Motion
from ident.explain.prior import Prior
from ident.explain.rows import Lowpass
from ident.kernels import inertial_regressor
from ident.model import Model

Array = NDArray[np.float64]

FOLDS = 5  # pieces of the rows where there are fewer than three motions
QUIET = 0.003  # share of a joint's torque range that the floor is at least: no drive measures better
REFITS = 3  # of weights and base parameters in turn


@dataclass
class View:
    """One motion as hypotheses see it; all arrays at the inner rate, shape (T, J).

    Attributes:
        load: Torque that moves and holds the links, from the refitted base model.
        total: All of its torque.
        axis_inertia: Of each joint with its rotor; `link_inertia` without.
        residual: Measured torque less `total`.
        cache: What hypotheses compute once for all points of their grids.
    """

    motion: Motion
    low: Lowpass
    load: Array
    total: Array
    axis_inertia: Array
    link_inertia: Array
    cache: dict[str, tuple[Array, ...]] = field(default_factory=dict)

    @property
    def residual(self) -> Array:
        return self.motion.tau_Nm - self.total


@dataclass
class Scene:
    """Recordings, base model and rows.

    Attributes:
        model, prior: Base model and what the robot file believes about it.
        views: One per motion.
        peak, soft: Largest speed, and speed over which the sign of friction changes, shape (J,).
        W: Columns of the base in prior units, per joint, shape (n_j, p), weighted.
        y: Torque less the prior's prediction, per joint, shape (n_j,), weighted.
        weight: 1 / standard deviation, 0 where a row is not judged, per joint.
        fold, motion: Of each row, per joint.
        independent: Share of the rows that is.
        floor: Variance of one period's torque noise in the band, shape (J,).
        floor_from_periods: It was measured, not taken from the spectrum.
        phi: Refitted base parameters in prior units, shape (p,).
    """

    model: Model
    prior: Prior
    views: list[View]
    peak: Array
    soft: Array
    W: list[Array]
    y: list[Array]
    weight: list[Array]
    fold: list[NDArray[np.int64]]
    row_motion: list[NDArray[np.int64]]
    independent: float
    floor: Array
    floor_from_periods: bool
    phi: Array
    theta: Array
    coulomb: Array
    notes: list[str] = field(default_factory=list)

    @property
    def joints(self) -> int:
        return self.model.joints

    @property
    def rate_Hz(self) -> float:
        view = self.views[0]
        return 1 / (view.motion.dt_s * max(1, int(view.low.at[1] - view.low.at[0])))

    def sign(self, view: View, joint: int) -> Array:
        """Direction of motion of a joint, shape (T,)."""
        return np.asarray(np.tanh(view.motion.qd[:, joint] / self.soft[joint]))

    def rows_of(self, joint: int, columns: Sequence[Array]) -> Array:
        """Weighted rows of columns given at the inner rate, one array of shape (T, ...) per motion."""
        parts = [view.low(c) for view, c in zip(self.views, columns, strict=True)]
        stacked = np.concatenate(parts)
        return np.asarray(stacked * self.weight[joint].reshape(-1, *[1] * (stacked.ndim - 1)))

    def refit(self) -> None:
        """Base parameters again, after rows were taken out."""
        ones = [np.ones(len(y)) for y in self.y]
        self.phi = _fit(self.W, self.y, ones)
        self.theta = self.prior.theta + self.prior.sigma * self.phi

    def residual_rows(self, joint: int, phi: Array | None = None) -> Array:
        """Weighted residual of the base model."""
        return np.asarray(self.y[joint] - self.W[joint] @ (self.phi if phi is None else phi))


def build(model: Model, prior: Prior, motions: Sequence[Motion]) -> Scene:
    """Scene of motions with the base model refitted to them."""
    J = model.joints
    peak = np.max([np.abs(m.qd).max(axis=0) for m in motions], axis=0)
    soft = rows.soft_speed(motions)
    factor = rows.factor(motions[0].dt_s, J)
    lows = [Lowpass.of(m.samples, factor, circular=m.circular) for m in motions]
    parts_W, parts_y, mass = [], [], []
    for m, low in zip(motions, lows, strict=True):
        W = regressor(model, m, soft)
        parts_W.append(np.stack([low(W[j]) for j in range(J)]))
        parts_y.append(low(m.tau_Nm).T)
        mass.append(mass_columns(model, m.q[low.at]))
    dwell = [rows.standing(m, low, peak) for m, low in zip(motions, lows, strict=True)]
    tolerance = [rows.reversal(m, low, soft) for m, low in zip(motions, lows, strict=True)]
    W0 = [np.concatenate([p[j] for p in parts_W]) for j in range(J)]
    y0 = [np.concatenate([p[j] for p in parts_y]) for j in range(J)]
    fold, row_motion = _folds([len(low.at) for low in lows])
    periods = np.concatenate([np.full(len(low.at), m.periods) for m, low in zip(motions, lows, strict=True)])
    Wp = [W * prior.sigma for W in W0]
    yp = [y - W @ prior.theta for y, W in zip(y0, W0, strict=True)]
    measured = any(m.periods > 1 for m in motions)
    scale = np.array([max(np.std(y), 1e-12) for y in y0])
    live = [~np.concatenate([d[:, j] for d in dwell]) for j in range(J)]
    gain = lows[0].white_gain
    floor = (0.03 * scale) ** 2
    phi = np.zeros(len(prior.theta))
    weight = [np.where(live[j], 1 / np.sqrt(floor[j]), 0.0) for j in range(J)]
    phi = _fit(Wp, yp, weight)
    views: list[View] = []
    for _ in range(REFITS):
        theta = prior.theta + prior.sigma * phi
        views = [view(model, m, low, theta, soft, D) for m, low, D in zip(motions, lows, mass, strict=True)]
        floor = _floor(views, scale, gain)
        coulomb = coulomb_level(model, theta)
        weight = []
        for j in range(J):
            edge = np.concatenate([t[:, j] for t in tolerance])
            variance = floor[j] / periods + (rows.KAPPA * coulomb[j] * edge) ** 2
            weight.append(np.where(live[j], 1 / np.sqrt(variance), 0.0))
        before, phi = phi, _fit(Wp, yp, weight)
        if np.abs(phi - before).max() < 0.01:
            break
    theta = prior.theta + prior.sigma * phi
    views = [view(model, m, low, theta, soft, D) for m, low, D in zip(motions, lows, mass, strict=True)]
    return Scene(
        model=model,
        prior=prior,
        views=views,
        peak=peak,
        soft=soft,
        W=[W * w[:, None] for W, w in zip(Wp, weight, strict=True)],
        y=[y * w for y, w in zip(yp, weight, strict=True)],
        weight=weight,
        fold=[fold] * J,
        row_motion=[row_motion] * J,
        independent=lows[0].independent,
        floor=floor,
        floor_from_periods=measured,
        phi=phi,
        theta=theta,
        coulomb=coulomb_level(model, theta),
    )


def regressor(model: Model, motion: Motion, soft: Array) -> Array:
    """Columns of the base model with a sign of speed that changes over `soft`, shape (J, T, P)."""
    W = model.regressor(motion.q, motion.qd, motion.qdd)
    C = model.coupling
    motor = motion.qd @ C.T
    motor_soft = np.sqrt((C**2) @ soft**2)
    for column, name in enumerate(model.names):
        if name.startswith("Fc"):
            j = int(name[2:]) - 1
            W[j, :, column] = np.tanh(motion.qd[:, j] / soft[j])
        elif name.startswith("fc_m"):
            k = int(name[4:]) - 1
            W[:, :, column] = np.outer(C[k], np.tanh(motor[:, k] / motor_soft[k]))
            W[k, :, column] -= abs(C[k, k]) * np.tanh(motion.qd[:, k] / soft[k])
    return W


def mass_columns(model: Model, q: Array) -> Array:
    """What inertial parameters contribute to the diagonal of the mass matrix, shape (J, N, 10 J)."""
    zero = np.zeros_like(q)
    still = inertial_regressor(model.geometry, q, zero, zero)
    out = np.empty_like(still)
    for j in range(model.joints):
        unit = zero.copy()
        unit[:, j] = 1.0
        out[j] = inertial_regressor(model.geometry, q, zero, unit)[j] - still[j]
    return out


def coulomb_level(model: Model, theta: Array) -> Array:
    """Dry friction of each joint, with what coupled motors add, shape (J,)."""
    value = dict(zip(model.names, theta, strict=True))
    return np.array([abs(value[f"Fc{j + 1}"]) for j in range(model.joints)])


def view(model: Model, motion: Motion, low: Lowpass, theta: Array, soft: Array, mass: Array | None = None) -> View:
    """A motion with the base model's torques on it.

    Args:
        mass: `mass_columns` at its rows, where they are at hand.
    """
    J = model.joints
    if mass is None:
        mass = mass_columns(model, motion.q[low.at])
    W = regressor(model, motion, soft)
    load = (W[:, :, : 10 * J] @ theta[: 10 * J]).T
    total = (W @ theta).T
    link = np.maximum(mass @ theta[: 10 * J], 0.0).T
    rotor = np.array([theta[model.names.index(f"Ia{j + 1}")] for j in range(J)])
    spread = np.arange(motion.samples)
    link_inner = np.column_stack([np.interp(spread, low.at, column) for column in link.T])
    return View(motion, low, load, total, link_inner + np.maximum(rotor, 0.0), link_inner)


def _floor(views: Sequence[View], scale: Array, gain: float) -> Array:
    """Variance of one period's torque in the band, shape (J,)."""
    repeated = [
        (rows.repeat_noise(v.motion, v.low, v.axis_inertia), len(v.low.at) * (v.motion.periods - 1)) for v in views
    ]
    known = [(value, share) for value, share in repeated if value is not None]
    if known:
        floor = sum(value * share for value, share in known) / sum(share for _, share in known)
    else:
        floor = np.median([rows.spectral_noise(v.residual, v.motion.dt_s, v.low) for v in views], axis=0)
    return np.asarray(np.maximum(floor, (QUIET * scale) ** 2 * 0.1))


def _fit(W: Sequence[Array], y: Sequence[Array], weight: Sequence[Array]) -> Array:
    """Posterior mean of parameters with prior N(0, 1), shape (p,)."""
    p = W[0].shape[1]
    A, b = np.eye(p), np.zeros(p)
    for Wj, yj, wj in zip(W, y, weight, strict=True):
        scaled = Wj * wj[:, None]
        A += scaled.T @ scaled
        b += scaled.T @ (yj * wj)
    return np.asarray(np.linalg.solve(A, b), dtype=float)


def _folds(counts: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Fold and motion of each row: motions are folds where there are three or more, else contiguous pieces."""
    motion = np.concatenate([np.full(n, k) for k, n in enumerate(counts)])
    if len(counts) >= 3:
        order = motion if len(counts) <= FOLDS else motion % FOLDS
        return order.astype(np.int64), motion
    pieces = FOLDS if len(counts) == 1 else 3
    fold = np.concatenate([k * pieces + np.arange(n) * pieces // n for k, n in enumerate(counts)])
    return fold.astype(np.int64), motion
