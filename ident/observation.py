"""Dataset and model to the linear system Y = W beta + rho (Janot, Vandanjon & Gautier 2014, eq. (4))."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ident.base import Base
from ident.dataset import Dataset, Segment
from ident.model import Model
from ident.units import check_units
from protocols.errors import ConfigError, DataError

Array = NDArray[np.float64]

DECIMATE_TO_HZ = 50.0  # paper V.B: 5 kHz / 100
CHEBYSHEV_ORDER, CHEBYSHEV_RIPPLE_DB, CHEBYSHEV_CUT = 8, 0.05, 0.8  # MATLAB's decimate
EDGE = 4  # decimated samples left out at each end, where the filter has seen one side only
SLOW = 0.02  # share of a joint's peak speed below which the sign of its friction is uncertain
STILL = 1e-3  # range of positions below which a joint did not move [rad or m]
BLOCK = 16384  # full-rate samples whose columns are in memory at a time
PADDING = 80  # decimated samples either side of a block: the filter forgets by a factor 10 in 10 of them


@dataclass(frozen=True)
class Observation:
    """Rows on a common, decimated time grid.

    Attributes:
        source: Name for messages.
        joints: Joint names, J of them.
        t_s: shape (N,) [s].
        first: Rows that start a new gapless stretch, shape (N,).
        W: shape (J, N, b).
        y: Torque, shape (J, N) [N·m].
        used: False where a joint (or a motor that drives it) is too slow for the sign of its friction, shape (J, N).
        rate_Hz: Of the grid.
        bandwidth_Hz: Of torque and columns.
        notes: What was left out and why.

    Raises:
        DataError: A row used is not a number.
    """

    source: str
    joints: list[str]
    t_s: Array
    first: NDArray[np.bool_]
    W: Array
    y: Array
    used: NDArray[np.bool_]
    rate_Hz: float
    bandwidth_Hz: float
    notes: list[str]

    def __post_init__(self) -> None:
        bad = ~(np.isfinite(self.W).all(axis=2) & np.isfinite(self.y)) & self.used
        if bad.any():
            joint, row = np.argwhere(bad)[0]
            raise DataError(
                f"{self.source}: the row of {self.joints[joint]} at {self.t_s[row]:.3f} s is not a number. Cut that"
                " part out or record again."
            )

    @property
    def rows(self) -> int:
        return int(self.used.sum())

    def predict(self, beta: Array) -> Array:
        """W beta, shape (J, N) [N·m]."""
        return np.asarray(self.W @ beta)


def relative_error(observations: Sequence[Observation], beta: Array) -> tuple[float, Array]:
    """||Y - W beta|| / ||Y|| in percent over all rows used, and per joint, shape (J,); NaN for a joint without."""
    rho, torque = (
        np.sqrt(sum((np.where(o.used, v, 0.0) ** 2).sum(axis=1) for o, v in zip(observations, values, strict=True)))
        for values in ([o.y - o.predict(beta) for o in observations], [o.y for o in observations])
    )
    per_joint = np.divide(rho, torque, out=np.full(len(torque), np.nan), where=torque > 0)
    return 100 * float(np.linalg.norm(rho) / np.linalg.norm(torque)), 100 * per_joint


def observe(
    dataset: Dataset,
    model: Model,
    base: Base,
    decimate_to_Hz: float = DECIMATE_TO_HZ,
    speed_threshold: float | None = None,
) -> Observation:
    """Linear system of a dataset: the same decimation filter over torque and every column.

    No row of a joint that does not move is used: static friction takes any value.

    Args:
        decimate_to_Hz: Rate of the rows; infinite for no decimation.
        speed_threshold: Rows slower than this are not used [rad/s]; 0 keeps all, None is `SLOW` of the peak speed.

    Raises:
        ConfigError: More than the sampling rate was asked for.
        DataError: No stretch is long enough to decimate, or positions are not the joints' in rad.
    """
    units = check_units(dataset, model.robot)
    rate = 1 / dataset.period_s
    if np.isfinite(decimate_to_Hz) and decimate_to_Hz > 1.0001 * rate:
        raise ConfigError(f"decimate_to_Hz = {decimate_to_Hz:g} is more than the {rate:.0f} Hz of {dataset.source}.")
    factor = max(1, round(rate / decimate_to_Hz)) if np.isfinite(decimate_to_Hz) else 1
    still = dataset.span() < STILL
    slow = SLOW * dataset.peak_speed() if speed_threshold is None else np.full(model.joints, speed_threshold)
    slow = np.where(still, np.inf, slow)
    parts = [
        _rows(segment, model, base, factor, slow)
        for segment in dataset.segments
        if segment.t_s.size > (2 * EDGE + 2) * factor
    ]
    if not parts:
        longest = max(s.t_s.size for s in dataset.segments) * dataset.period_s
        raise DataError(
            f"{dataset.source}: the longest gapless stretch, {longest:.2f} s, is too short to decimate to"
            f" {rate / factor:.0f} Hz. Record longer."
        )
    times, W, y, used = zip(*parts, strict=True)
    first = np.concatenate([np.arange(t.size) == 0 for t in times])
    keep = np.concatenate(used, axis=1)
    notes = [*dataset.notes, *units]
    for name, span in zip(np.array(dataset.joints)[still], dataset.span()[still], strict=True):
        notes.append(f"{dataset.source}: {name} moved by only {span:.2g} rad; its rows are not used.")
    if len(parts) < len(dataset.segments):
        notes.append(f"{dataset.source}: {len(dataset.segments) - len(parts)} gapless stretches are too short.")
    if not keep.all():
        shares = ", ".join(f"{name} {100 * (1 - k.mean()):.0f} %" for name, k in zip(dataset.joints, keep, strict=True))
        notes.append(f"{dataset.source}: rows left out around zero speed: {shares}.")
    return Observation(
        source=dataset.source,
        joints=dataset.joints,
        t_s=np.concatenate(times),
        first=first,
        W=np.concatenate(W, axis=1),
        y=np.concatenate(y, axis=1),
        used=keep,
        rate_Hz=rate / factor,
        bandwidth_Hz=min(dataset.filter_Hz, CHEBYSHEV_CUT * rate / (2 * factor) if factor > 1 else rate / 2),
        notes=notes,
    )


def usable(model: Model, qd: Array, slow: Array) -> NDArray[np.bool_]:
    """Where neither a joint nor a coupled motor that drives it is slow, shape (J, T).

    Args:
        qd: shape (T, J).
        slow: Speeds below which the sign of friction is uncertain, shape (J,); infinite for a joint at rest.
    """
    slow_motor = np.abs(model.coupling) @ np.where(np.isfinite(slow), slow, 0.0)
    moving = (np.abs(qd) >= slow).T
    turning = (np.abs(qd @ model.coupling.T) >= slow_motor).T
    for k in model.coupled:
        moving = moving & (turning[k] | (model.coupling[k] == 0)[:, None])
    return moving


def _rows(
    segment: Segment, model: Model, base: Base, factor: int, slow: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Times, columns, torque and usable rows of one stretch, decimated."""
    samples = segment.t_s.size
    edge = EDGE if factor > 1 else 0
    grid = np.arange(edge * factor, samples - edge * factor, factor)
    W = np.empty((model.joints, grid.size, len(base.names)))
    y = np.empty((model.joints, grid.size))
    for start in range(0, samples, BLOCK):
        low, high = max(0, start - PADDING * factor), min(samples, start + BLOCK + PADDING * factor)
        here = (grid >= start) & (grid < start + BLOCK)
        part = slice(low, high)
        columns = model.regressor(segment.q[part], segment.qd[part], segment.qdd[part])[:, :, base.kept]
        for j in range(model.joints):
            W[j, here] = decimate(columns[j], factor)[grid[here] - low]
            y[j, here] = decimate(segment.tau_Nm[part, j : j + 1], factor)[grid[here] - low, 0]
    # The filter spreads a change of sign over its neighbours: one decimated sample either side counts as slow too.
    reach = np.arange(-factor, factor + 1) if factor > 1 else np.zeros(1, dtype=int)
    near = np.clip(grid[:, None] + reach, 0, samples - 1)
    used = np.asarray(usable(model, segment.qd, slow)[:, near].all(axis=2))
    return segment.t_s[grid], W, y, used


def decimate(columns: Array, factor: int) -> Array:
    """Zero-phase Chebyshev low-pass of MATLAB's decimate over each column; the caller picks every factor-th row."""
    if factor == 1:
        return columns
    sos = signal.cheby1(CHEBYSHEV_ORDER, CHEBYSHEV_RIPPLE_DB, CHEBYSHEV_CUT / factor, output="sos")
    out = np.zeros_like(columns)
    seen = np.flatnonzero(columns.any(axis=0))
    padding = min(columns.shape[0] - 1, 10 * factor)
    if seen.size:
        out[:, seen] = signal.sosfiltfilt(sos, columns[:, seen], axis=0, padlen=padding)
    return out
