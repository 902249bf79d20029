"""Harmonics of position, looked for at the full inner rate: decimation would remove those of fast motion."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import linalg, signal

from ident.explain import candidates
from ident.explain.candidates import Batch
from ident.explain.drives import Eccentricity, Ripple, harmonics
from ident.explain.hypothesis import gear
from ident.explain.scene import Scene

Array = NDArray[np.float64]

AR_ORDER = 12  # of the model that whitens the residual
FINE = 0.25  # step of orders times the range travelled [rad of harmonic phase over the range, over 2 pi / 4]
MOST_ORDERS = 3000
PEAKS = 8  # orders per joint that enter the competition
TURNS = 12  # of scan and fit
CLEAR_NATS = 12.0  # of one order, out of some thousands
MOST_HARMONICS = 100


@dataclass(frozen=True)
class Order:
    """One harmonic of position.

    Attributes:
        order: Periods per revolution of the motor.
        per_rad: Periods per joint radian, times 2 pi.
        gain: Held-out log-likelihood gain at the full inner rate [nats].
        c: Coefficients of sine and cosine.
        inside: Share of the harmonic's time below the band that the other hypotheses are judged in.
    """

    order: float
    per_rad: float
    gain: float
    c: tuple[float, float]
    std: float
    inside: float


def orders(scene: Scene, joint: int) -> list[Order]:
    """Harmonics of one joint with a clear held-out gain, strongest first; found in turns, each on what is left."""
    q = [v.motion.q[:, joint] for v in scene.views]
    span = float(np.ptp(np.concatenate(q)))
    if span <= 1e-9 or not scene.weight[joint].any():
        return []
    original = [v.residual[:, joint] - v.residual[:, joint].mean() for v in scene.views]
    # first as it is: where ripple is most of the residual, whitening would take it for the noise
    found = _in_turns(scene, joint, original, span, [], whiten=False)
    return _in_turns(scene, joint, original, span, found, whiten=True)


def _in_turns(
    scene: Scene, joint: int, original: list[Array], span: float, found: list[Order], *, whiten: bool
) -> list[Order]:
    """Orders with those found before, each round on what the ones before leave."""
    found = list(found)
    turns = gear(scene, joint)
    angle = np.concatenate([v.motion.q[:, joint] for v in scene.views]) * turns
    whole = np.concatenate(original)
    cuts = np.cumsum([len(r) for r in original])[:-1]
    residual = _left(whole, angle, found, cuts)
    for _ in range(TURNS):
        fresh = [o for o in _scan(scene, joint, residual, span, whiten=whiten) if o.gain > CLEAR_NATS]
        fresh = [o for o in fresh if all(abs(o.order - f.order) > 1e-9 for f in found)]
        if not fresh or len(found) > MOST_HARMONICS:
            break
        found += fresh
        before = sum(float(r @ r) for r in residual)
        residual = _left(whole, angle, found, cuts)
        if sum(float(r @ r) for r in residual) > 0.995 * before:
            break
    return found


def _left(whole: Array, angle: Array, found: list[Order], cuts: NDArray[np.int64]) -> list[Array]:
    """The residual less its fit by the orders found, by motion."""
    if not found:
        return np.split(whole, cuts)
    X = harmonics(angle, {f"order{k}": o.order for k, o in enumerate(found)})
    A = X.T @ X
    c = np.linalg.solve(A + 1e-6 * np.trace(A) / len(A) * np.eye(len(A)), X.T @ whole)
    return np.split(whole - X @ c, cuts)


def _scan(scene: Scene, joint: int, residual: list[Array], span: float, *, whiten: bool) -> list[Order]:
    """Strongest harmonics of what is left."""
    taps = _whitening(residual) if whiten else np.array([1.0])
    white = [signal.lfilter(taps, [1.0], r) for r in residual]
    innovation = float(np.mean([np.var(w[AR_ORDER:]) for w in white]))
    white = [signal.lfilter(taps, [1.0], w[::-1])[::-1] for w in white]
    response = np.abs(np.fft.rfft(taps, 512)) ** 2
    n_step = 2 * np.pi * FINE / span
    rate = 1 / scene.views[0].motion.dt_s
    ordinary = max(float(np.quantile(np.abs(v.motion.qd[:, joint]), 0.3)) for v in scene.views)
    n_max = min(2 * np.pi * 0.3 * rate / max(ordinary, 1e-9), n_step * MOST_ORDERS)
    per_rad = np.arange(4 * n_step, n_max, n_step)
    if not per_rad.size or innovation <= 0:
        return []
    fold = [scene.fold[joint][scene.row_motion[joint] == k] for k in range(len(scene.views))]
    pieces = sorted({int(f) for part in fold for f in part})
    S = np.zeros((len(pieces), per_rad.size), dtype=complex)
    V = np.zeros((len(pieces), per_rad.size))
    for k, view in enumerate(scene.views):
        row = np.clip(np.searchsorted(view.low.at, np.arange(view.motion.samples)), 0, len(view.low.at) - 1)
        piece = np.searchsorted(pieces, fold[k][row])
        live = (scene.weight[joint][scene.row_motion[joint] == k] > 0)[row].astype(float)
        speed = np.abs(view.motion.qd[:, joint]) * view.motion.dt_s / np.pi  # of Nyquist, per unit of per_rad
        q = view.motion.q[:, joint]
        _project(q, white[k], speed, live, piece, per_rad[0], n_step, response, S, V)
    return _peaks(scene, joint, per_rad, S, V, innovation)


def batches(scene: Scene, joint: int, found: list[Order]) -> list[Batch]:
    """Single orders of ripple and eccentricity, and the series of all clear ones, as candidates."""
    single = [{"order": o.order} for o in found[:PEAKS]]
    made = [candidates.batch(scene, h, joint, single) for h in (Ripple(), Eccentricity())]
    clear = [o.order for o in found if o.gain > CLEAR_NATS][:MOST_HARMONICS]
    for count in sorted({len(clear), max(2, len(clear) // 3)}):
        if len(clear) > 1:
            series = {"order" if k == 0 else f"order{k + 1}": order for k, order in enumerate(clear[:count])}
            made.append(candidates.batch(scene, Ripple(), joint, [series]))
    return [b for b in made if b is not None]


def _peaks(scene: Scene, joint: int, per_rad: Array, S: NDArray[np.complex128], V: Array, noise: float) -> list[Order]:
    total_S, total_V = S.sum(axis=0), V.sum(axis=0)
    gain = np.zeros(per_rad.size)
    for k in range(len(S)):
        rest = np.maximum(total_V - V[k], 1e-300)
        c = (total_S - S[k]) / rest
        gain += (2 * (np.conj(c) * S[k]).real - np.abs(c) ** 2 * V[k]) / (2 * noise)
    c = total_S / np.maximum(total_V, 1e-300)
    turns = gear(scene, joint)
    speed = np.concatenate([np.abs(v.motion.qd[:, joint]) for v in scene.views])
    out: list[Order] = []
    for i in np.argsort(-gain):
        if gain[i] <= 3.0 or len(out) >= PEAKS:
            break
        if any(abs(per_rad[i] - o.per_rad) < 4.5 * (per_rad[1] - per_rad[0]) for o in out):
            continue
        inside = float(np.mean(per_rad[i] * speed / (2 * np.pi) < 0.4 * scene.rate_Hz))
        order = per_rad[i] / turns
        whole = round(order)
        if whole and abs(order - whole) * turns < (per_rad[1] - per_rad[0]):
            order = float(whole)  # the motor's own harmonics are whole numbers
        std = float(np.sqrt(noise / total_V[i]))
        out.append(Order(float(order), float(per_rad[i]), float(gain[i]), (c[i].imag, c[i].real), std, inside))
    return out


def _whitening(residual: list[Array]) -> Array:
    """Prediction error filter of the residual (Yule-Walker), shape (AR_ORDER + 1,)."""
    r = np.zeros(AR_ORDER + 1)
    for x in residual:
        for k in range(AR_ORDER + 1):
            r[k] += float(x[: len(x) - k] @ x[k:])
    r[0] *= 1 + 1e-6
    return np.concatenate([[1.0], -linalg.solve_toeplitz(r[:-1], r[1:])])


@njit(cache=True)
def _project(
    q: Array,
    white: Array,
    speed: Array,
    live: Array,
    piece: NDArray[np.int64],
    first: float,
    step: float,
    response: Array,
    S: NDArray[np.complex128],
    V: Array,
) -> None:
    """Adds sum exp(i n q) r and sum |A(n v)|² / 2 of every order n = first + k step to its piece."""
    last = len(response) - 1
    for t in range(len(q)):
        if live[t] == 0.0:
            continue
        z = np.exp(1j * first * q[t])
        turn = np.exp(1j * step * q[t])
        p = piece[t]
        for k in range(S.shape[1]):
            x = (first + k * step) * speed[t]
            if x >= 0.9:
                break
            S[p, k] += z * white[t]
            V[p, k] += 0.5 * response[int(x * last)]
            z *= turn
