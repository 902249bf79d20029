"""The period of a motion, found in the motion itself: foreign recordings do not say how often they repeat."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOOK_HZ = 40.0  # rate at which lags are tried; the winner is refined at the full rate
SHORTEST_S = 1.0  # shorter repetitions are ripples of a motion, not motions
SAME = 0.006  # share of a joint's range by which two periods may differ in position (thermal drift of a PD loop)
MOVING = 0.02  # share of the peak speed above which a joint moves
LIVELY = 0.3  # share of the time that something must move: a standstill repeats at every lag


HEAD_S, TAIL_S = 0.4, 0.15  # of a periodic stretch in which the loop still settles, or already stops
WHOLE = 0.5  # share of a period from which on a partial one is used where the others can fill it


@dataclass(frozen=True)
class Repetition:
    """Rows start, start + period, ... repeat.

    Attributes:
        start: First row of the first period; may lie before `low`.
        period: Rows per period.
        count: Periods, at least 2.
        low, high: Rows outside of these belong to start-up or stop and are not used.
    """

    start: int
    period: int
    count: int
    low: int
    high: int

    @property
    def end(self) -> int:
        return self.start + self.period * self.count


def find(q: Array, rate_Hz: float) -> Repetition | None:
    """Longest periodic stretch of positions of shape (T, J), without start-up and stop; None if nothing repeats."""
    span = np.ptp(q, axis=0)
    moving = span > 1e-6
    if not moving.any():
        return None
    factor = max(1, round(rate_Hz / LOOK_HZ))
    coarse = (q[::factor, moving] / span[moving]).astype(np.float32)
    speed = np.abs(np.diff(coarse, axis=0, prepend=coarse[:1]))
    lively = np.concatenate([[0], np.cumsum((speed > MOVING * speed.max(axis=0)).any(axis=1))])
    rate = rate_Hz / factor
    best: tuple[int, int, int] | None = None
    for lag in range(int(SHORTEST_S * rate), len(coarse) // 2 + 1):
        same = np.ones(len(coarse) - lag, dtype=bool)
        for channel in coarse.T:
            same &= np.abs(channel[lag:] - channel[:-lag]) < SAME
            if not same.any():
                break
        start, end = _longest(same)
        if end - start < 0.97 * lag or lively[end] - lively[start] < LIVELY * (end - start):
            continue
        if best is None or end + lag - start > 1.2 * (best[2] - best[1]):
            best = lag, start, end + lag
    if best is None:
        return None
    lag, start, end = best
    start, end = start * factor, min(end * factor, len(q))
    period = _refined(q[start:end, moving] / span[moving], lag * factor, factor)
    low, high = start + round(HEAD_S * rate_Hz), end - round(TAIL_S * rate_Hz)
    if high - low < (1 + WHOLE) * period:  # hardly two periods: better a little transient than no repetition
        low, high = start, end
    count = int((high - low) // period)
    count += int((high - low) - count * period > WHOLE * period)
    return Repetition(high - count * period, period, count, low, high) if count >= 2 else None


def _refined(q: Array, lag: int, reach: int) -> int:
    """The lag within `reach` of a coarse one at which positions repeat best."""
    lags = range(max(1, lag - reach), min(len(q) - 1, lag + reach) + 1)
    errors = [float(np.mean((q[n:] - q[:-n]) ** 2)) for n in lags]
    return lags[int(np.argmin(errors))]


def _longest(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """Start and end of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    if not edges.size:
        return 0, 0
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    return int(starts[k]), int(ends[k])
