"""Rows that are judged: torque and columns through one low-pass, thinned until neighbours are nearly independent."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal, sparse, stats

from ident.explain.motion import Motion

Array = NDArray[np.float64]

AXIS_HZ, ARM_HZ = 62.5, 50.0  # rate of the rows; half of it is the band
REACH = 6  # rows either side that the low-pass looks at
CUT = 0.85  # of the band: -6 dB
DWELL_S, DWELL_PAD_S = 0.024, 0.03  # slower than DEAD for so long is standing; rows so near to it are left out
DEAD = 0.008  # share of a joint's peak speed
SOFT = 0.0007  # share of a joint's peak speed over which the sign of its speed changes
KAPPA, EARLY_S = 0.3, 0.004  # share of Coulomb friction, and time, that the model of a reversal may be wrong by
BLOCK_S = 0.5  # the floor is the median of such blocks: an event does not raise it


@dataclass(frozen=True)
class Lowpass:
    """Linear-phase low-pass and thinning of one motion's signals, as a sparse matrix.

    Attributes:
        matrix: shape (N, T).
        at: Sample of each row, shape (N,).
    """

    matrix: sparse.csr_array
    at: NDArray[np.int64]

    @classmethod
    def of(cls, samples: int, factor: int, *, circular: bool) -> "Lowpass":
        if factor == 1:
            at = np.arange(samples)
            return cls(sparse.csr_array(sparse.eye_array(samples)), at)
        half = REACH * factor
        taps = signal.firwin(2 * half + 1, CUT / factor, window=("kaiser", 6.0))
        at = np.arange(0, samples - factor // 2, factor) if circular else np.arange(half, samples - half, factor)
        columns = at[:, None] + np.arange(-half, half + 1)
        if circular:
            columns = columns % samples
        rows = np.repeat(np.arange(at.size), taps.size)
        values = np.tile(taps, at.size)
        shape = (at.size, samples)
        return cls(sparse.csr_array(sparse.coo_array((values, (rows, columns.ravel())), shape=shape)), at)

    def __call__(self, values: Array) -> Array:
        """Rows of signals of shape (T, ...): shape (N, ...)."""
        flat = values.reshape(len(values), -1)
        return np.asarray(self.matrix @ flat).reshape(len(self.at), *values.shape[1:])

    @cached_property
    def independent(self) -> float:
        """Share of the rows that is independent under white noise (Bartlett): 1 / sum of squared correlations."""
        middle = self.matrix[[len(self.at) // 2]].toarray()[0]
        spectrum = np.abs(np.fft.rfft(middle[middle != 0], 8192)) ** 2
        full = np.fft.irfft(spectrum)
        step = int(self.at[1] - self.at[0]) if len(self.at) > 1 else 1
        r = full[:4096:step] / full[0]
        return float(1 / (1 + 2 * (r[1:] ** 2).sum()))

    @cached_property
    def white_gain(self) -> float:
        """Variance of a row under white noise of variance 1."""
        middle = self.matrix[[len(self.at) // 2]]
        return float((middle.data**2).sum())


def factor(dt_s: float, joints: int) -> int:
    """Samples per row."""
    return max(1, round(1 / (dt_s * (AXIS_HZ if joints == 1 else ARM_HZ))))


def soft_speed(motions: Sequence[Motion]) -> Array:
    """Speed over which the sign of a joint's speed is taken to change, shape (J,) [rad/s].

    At least three times the noise of the speed, which is what a second difference of it shows.
    """
    peak = np.max([np.abs(m.qd).max(axis=0) for m in motions], axis=0)
    noise = np.max(
        [1.4826 * np.median(np.abs(np.diff(m.qd, n=3, axis=0)), axis=0) / np.sqrt(20) for m in motions], axis=0
    )
    return np.asarray(np.maximum(np.maximum(SOFT * peak, 3 * noise), 1e-9))


def standing(motion: Motion, low: Lowpass, peak: Array) -> NDArray[np.bool_]:
    """Rows at which a joint stands: its friction is whatever it takes. Shape (N, J)."""
    slow = np.abs(motion.qd) < DEAD * peak
    least = max(1, round(DWELL_S / motion.dt_s))
    pad = max(1, round(DWELL_PAD_S / motion.dt_s))
    out = np.zeros((len(low.at), slow.shape[1]), dtype=bool)
    for j, column in enumerate(slow.T):
        dwell = ndimage.binary_opening(column, np.ones(least, dtype=bool))
        out[:, j] = ndimage.binary_dilation(dwell, np.ones(2 * pad + 1, dtype=bool))[low.at] if dwell.any() else False
    return out


def reversal(motion: Motion, low: Lowpass, soft: Array) -> Array:
    """Share of Coulomb friction by which a reversal that is `EARLY_S` earlier or later differs, shape (N, J).

    A real joint sticks for some milliseconds when it turns, which no model without a state predicts.
    """
    shift = max(1, round(EARLY_S / motion.dt_s))
    sign = np.tanh(motion.qd / soft)
    ahead, behind = np.roll(sign, -shift, axis=0), np.roll(sign, shift, axis=0)
    if not motion.circular:
        ahead[-shift:], behind[:shift] = sign[-1], sign[0]
    return np.asarray(ndimage.maximum_filter1d(low(np.abs(ahead - behind) / 2), 3, axis=0))


def repeat_noise(motion: Motion, low: Lowpass, inertia: Array) -> Array | None:
    """Variance of one period's torque in the band, shape (J,), or None where nothing was repeated.

    Args:
        inertia: Of each axis, shape (T, J): what the periods' accelerations differ by is not torque noise.
    """
    if motion.periods < 2:
        return None
    rows = np.stack([low(t - inertia * a) for t, a in zip(motion.each_tau, motion.each_qdd, strict=True)])
    size = max(2, round(BLOCK_S / (motion.dt_s * max(1, int(low.at[1] - low.at[0])))))
    blocks = rows.shape[1] // size
    squares = (rows[:, : blocks * size] ** 2).reshape(motion.periods, blocks, size, -1).sum(axis=(0, 2))
    freedom = (motion.periods - 1) * size * low.independent
    median_of_mean = float(stats.chi2.median(freedom)) / freedom
    return np.asarray(np.median(squares / ((motion.periods - 1) * size), axis=0) / median_of_mean)


def spectral_noise(residual: Array, dt_s: float, low: Lowpass) -> Array:
    """Variance in the band, shape (J,), of noise that is white: from what lies up to two times above the band.

    Args:
        residual: At the inner rate, shape (T, J).
    """
    rate = 1 / dt_s
    band = rate / (2 * max(1, int(low.at[1] - low.at[0])))
    frequency, density = signal.welch(residual, rate, nperseg=min(256, len(residual)), axis=0)
    above = (frequency > 1.3 * band) & (frequency < min(3 * band, 0.45 * rate))
    if not above.any():
        above = frequency > 0.5 * frequency[-1]
    return np.asarray(np.median(density[above], axis=0) * rate / 2 * low.white_gain)
