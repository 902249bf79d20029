"""Recorded signals to a dataset: aligned torque, zero-phase filtered position, speed and acceleration by differences.

Janot, Vandanjon & Gautier 2014, II.C. Nothing is interpolated over a gap: a gap starts a new segment.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from protocols.errors import ConfigError, DataError

Array = NDArray[np.float64]

FILTER_HZ = 50.0  # paper V.B: five times the bandwidth of the fastest axis
FILTER_ORDER = 4  # paper V.B
GAP = 1.5  # steps of this many periods or more are gaps
JITTER = 0.02  # share of a period by which a step may differ; SYNC grid time has none
NYQUIST_SHARE = 0.9  # a cut-off above this share of half the rate filters nothing
SETTLE = 5.0  # periods of the cut-off after which the ends of the filter disturb accelerations by less than 1e-4
FORGET = 15.5  # periods of the cut-off in which the filter forgets by 1e-16: 37 / (2 pi cos(3 pi / 8))
PIECE = 65536  # rows filtered at a time: 6 axes are 25 MB, and the margins cost 5 % at 5 kHz and 50 Hz
SLOWEST_S = 0.05  # period above which no motion of an arm is seen
STENCIL = 2  # samples either side of the five-point differences


@dataclass(frozen=True)
class Command:
    """What the arm was told to do, on the rows of the signals.

    Attributes:
        reference: Target position active from the instant of the row on, shape (T, J) [rad]; NaN before the first.
        by_drives: The drives controlled position themselves (CSP); else the host controlled torque (CST).
    """

    reference: Array
    by_drives: bool = False


@dataclass(frozen=True)
class Signals:
    """What was measured, SI, joint side, on the time grid of SYNC.

    Attributes:
        source: Name for messages.
        joints: Joint names, J of them.
        t_s: shape (T,) [s].
        q: Position, shape (T, J) [rad].
        tau_Nm: Torque from current, shape (T, J) [N·m]. Row k is the torque at t_s[k] - delay.
        delay_s: Age of the torque, shape (J,) [s]: a mean over the last cycle is half a cycle old.
        notes: What the reader of the recording should know (saturation, ...).
        verdict: `LOSSLESS`, `GAPS(n)` or `UNVERIFIABLE`, as the recorder closed the file.
        sha256: Of the file; empty where there is none.
        command: Gives the reference that the arm was told to follow; None where it is not known. Called by methods that
            simulate only.
    """

    source: str
    joints: list[str]
    t_s: Array
    q: Array
    tau_Nm: Array
    delay_s: Array
    notes: list[str] = field(default_factory=list)
    verdict: str = "UNVERIFIABLE"
    sha256: str = ""
    command: "Callable[[], Command] | None" = None

    def __post_init__(self) -> None:
        shape = (self.t_s.size, len(self.joints))
        if self.q.shape != shape or self.tau_Nm.shape != shape or self.delay_s.shape != shape[1:]:
            raise DataError(
                f"{self.source}: q {self.q.shape}, tau {self.tau_Nm.shape} and delay {self.delay_s.shape} do not fit"
                f" {shape[0]} times and {shape[1]} joints."
            )


@dataclass(frozen=True)
class Segment:
    """Gapless stretch of a dataset, uniform in time.

    Attributes:
        t_s: shape (T,) [s].
        q, qd, qdd: Filtered position, speed, acceleration, shape (T, J) [rad, rad/s, rad/s²].
        tau_Nm: Torque at the same instants, not filtered, shape (T, J) [N·m].
    """

    t_s: Array
    q: Array
    qd: Array
    qdd: Array
    tau_Nm: Array


@dataclass(frozen=True)
class Dataset:
    """Signals ready for regression.

    Attributes:
        source: Name for messages.
        joints: Joint names.
        period_s: Sampling period.
        filter_Hz: Cut-off of the position filter; infinite for none.
        segments: In order of time.
        notes: What was left out and why.
    """

    source: str
    joints: list[str]
    period_s: float
    filter_Hz: float
    segments: list[Segment]
    notes: list[str]

    @property
    def duration_s(self) -> float:
        """Time covered, gaps not counted."""
        return sum(s.t_s.size for s in self.segments) * self.period_s

    def peak_speed(self) -> Array:
        """Largest speed per joint, shape (J,) [rad/s]."""
        return np.asarray(np.max([np.abs(s.qd).max(axis=0) for s in self.segments], axis=0))

    def span(self) -> Array:
        """Range of positions per joint, shape (J,) [rad]."""
        high = np.max([s.q.max(axis=0) for s in self.segments], axis=0)
        return np.asarray(high - np.min([s.q.min(axis=0) for s in self.segments], axis=0))


def prepare(signals: Signals, filter_Hz: float = FILTER_HZ) -> Dataset:
    """Dataset of measured signals.

    Args:
        filter_Hz: Cut-off of the Butterworth filter run forwards and backwards over q; infinite for none.

    Raises:
        DataError: NaN, times that do not increase, or no stretch long enough.
        ConfigError: The cut-off does not fit the sampling rate.
    """
    plan = plan_stretches(signals, filter_Hz)
    segments = [_segment(signals, stretch, plan, filter_Hz) for stretch in plan.stretches]
    return Dataset(signals.source, signals.joints, plan.period_s, filter_Hz, segments, plan.notes)


@dataclass(frozen=True)
class Plan:
    """Which rows of the signals become segments.

    Attributes:
        period_s: Sampling period.
        settle: Rows at both ends that the filter disturbs.
        delay: Of the torque, in rows, shape (J,).
        stretches: Gapless rows, long enough.
        notes: What was left out and why.
    """

    period_s: float
    settle: int
    delay: Array
    stretches: list[slice]
    notes: list[str]

    def inner(self, stretch: slice) -> slice:
        """Rows of a stretch, counted from its start, that are of use: both ends settled, torque known."""
        known = stretch.stop - stretch.start - int(np.ceil(self.delay.max(initial=0.0)))
        return slice(self.settle + STENCIL, known - self.settle - STENCIL)


def plan_stretches(signals: Signals, filter_Hz: float) -> Plan:
    """Gapless stretches of measured signals; raises as `prepare`."""
    _check_values(signals)
    steps = np.diff(signals.t_s)
    period = float(np.median(steps))
    _check_times(signals, steps, period)
    if np.isfinite(filter_Hz) and not 0 < filter_Hz < NYQUIST_SHARE * 0.5 / period:
        raise ConfigError(
            f"filter_Hz = {filter_Hz:g} does not fit {signals.source}, sampled at {1 / period:.0f} Hz;"
            f" choose at most {NYQUIST_SHARE * 0.5 / period:.0f} Hz."
        )
    settle = int(np.ceil(SETTLE / (filter_Hz * period))) if np.isfinite(filter_Hz) else 0
    shortest = 4 * (settle + STENCIL) + int(np.ceil(signals.delay_s.max(initial=0.0) / period)) + 1
    gaps = np.flatnonzero(steps > GAP * period)
    lengths = np.diff([0, *(gaps + 1), signals.t_s.size])
    every = [slice(int(end - n), int(end)) for n, end in zip(lengths, np.cumsum(lengths), strict=True)]
    kept = [s for s in every if s.stop - s.start >= shortest]
    if not kept:
        raise DataError(
            f"{signals.source}: {signals.t_s.size} samples in {len(every)} gapless stretches, none with the"
            f" {shortest} samples ({shortest * period:.2f} s) that the {filter_Hz:g} Hz filter needs. Record longer."
        )
    notes = list(signals.notes)
    if gaps.size:
        longest = gaps[np.argmax(steps[gaps])]
        notes.append(
            f"{signals.source}: {gaps.size} gaps, {float(steps[gaps].sum()):.3f} s in all, the longest"
            f" {steps[longest]:.3f} s after {signals.t_s[longest]:.3f} s; the stretches between them are used one by"
            " one."
        )
    if len(kept) < len(every):
        lost = sum(s.stop - s.start for s in every) - sum(s.stop - s.start for s in kept)
        notes.append(
            f"{signals.source}: {len(every) - len(kept)} stretches between gaps, {lost} samples, are too short to use."
        )
    return Plan(period, settle, signals.delay_s / period, kept, notes)


def pieces(signals: Signals, plan: Plan, filter_Hz: float, rows: int = PIECE) -> Iterator[Segment]:
    """The segments of `prepare` in pieces, so that a recording of any length needs the memory of one piece.

    Every piece is filtered with so many rows around it that it equals the whole to 1e-12 of the range of motion.
    """
    margin = STENCIL + (int(np.ceil(FORGET / (filter_Hz * plan.period_s))) if np.isfinite(filter_Hz) else 0)
    late = int(np.ceil(plan.delay.max(initial=0.0)))
    for stretch in plan.stretches:
        inner = plan.inner(stretch)
        for low in range(stretch.start + inner.start, stretch.start + inner.stop, rows):
            high = min(low + rows, stretch.start + inner.stop)
            around = slice(max(stretch.start, low - margin), min(stretch.stop, high + margin))
            q = lowpass(signals.q[around], plan.period_s, filter_Hz)
            qd, qdd = differences(q, plan.period_s)
            here = slice(low - around.start, high - around.start)
            tau = _aligned(signals.tau_Nm[low : high + late], plan.delay)
            yield Segment(signals.t_s[low:high], q[here], qd[here], qdd[here], tau)


def _check_values(signals: Signals) -> None:
    if signals.t_s.size < 2:
        raise DataError(f"{signals.source}: {signals.t_s.size} samples; a motion of some seconds is needed.")
    if not np.isfinite(signals.t_s).all():
        raise DataError(f"{signals.source}: {np.sum(~np.isfinite(signals.t_s))} times are not numbers.")
    for what, values in (("position", signals.q), ("torque", signals.tau_Nm)):
        bad = ~np.isfinite(values)
        if bad.any():
            row, joint = np.argwhere(bad)[0]
            raise DataError(
                f"{signals.source}: {what} of {signals.joints[joint]} is not a number in {bad[:, joint].sum()} of"
                f" {bad.shape[0]} samples, first at {signals.t_s[row]:.3f} s. Cut that part out or record again."
            )


def _check_times(signals: Signals, steps: Array, period: float) -> None:
    if not (steps > 0).all():
        at = int(np.argmin(steps))
        raise DataError(
            f"{signals.source}: time goes from {signals.t_s[at]:.6f} s to {signals.t_s[at + 1]:.6f} s, sample {at + 1}"
            f" of {signals.t_s.size}; times must increase. Sort or cut the recording there."
        )
    if period > SLOWEST_S:
        raise DataError(
            f"{signals.source}: one sample every {period:g} s is too slow for any arm; times must be in seconds, and"
            " these may be in milliseconds or nanoseconds. Divide them."
        )
    uneven = (np.abs(steps - period) > JITTER * period) & (steps <= GAP * period)
    if uneven.any():
        raise DataError(
            f"{signals.source}: {uneven.sum()} of {steps.size} steps differ by more than {100 * JITTER:.0f} % from"
            f" the period of {1e3 * period:.3f} ms; resample to a uniform grid (SYNC time) first."
        )


def _segment(signals: Signals, stretch: slice, plan: Plan, filter_Hz: float) -> Segment:
    q = lowpass(signals.q[stretch], plan.period_s, filter_Hz)
    tau = _aligned(signals.tau_Nm[stretch], plan.delay)
    qd, qdd = differences(q, plan.period_s)
    inner = plan.inner(stretch)
    return Segment(signals.t_s[stretch][inner], q[inner], qd[inner], qdd[inner], tau[inner])


def lowpass(q: Array, period: float, filter_Hz: float) -> Array:
    """Butterworth filter forwards and backwards, channel by channel: half the memory of all at once.

    Args:
        q: shape (T, J).
        filter_Hz: Cut-off; infinite for none.
    """
    if not np.isfinite(filter_Hz):
        return q
    sos = signal.butter(FILTER_ORDER, filter_Hz, fs=1 / period, output="sos")
    return np.column_stack([signal.sosfiltfilt(sos, channel) for channel in q.T])


def _aligned(tau: Array, delay: Array) -> Array:
    """Torque at the sample times, linear between the two values around each; shorter by the longest delay.

    A mean over the last cycle is half a cycle old: the mean of two neighbours. Its low-pass, cos(pi f T), is 0.998
    at 20 Hz and 1 kHz, small against what the parallel decimation removes.

    Args:
        delay: In samples, shape (J,).
    """
    rows = len(tau) - int(np.ceil(delay.max(initial=0.0)))
    out = np.empty((rows, tau.shape[1]))
    for j, d in enumerate(delay):
        whole, part = int(np.floor(d)), float(d - np.floor(d))
        out[:, j] = (1 - part) * tau[whole : whole + rows, j]
        if part > 0:
            out[:, j] += part * tau[whole + 1 : whole + 1 + rows, j]
    return out


def differences(q: Array, period: float) -> tuple[Array, Array]:
    """Speed and acceleration by five-point central differences; two rows at each end are zero.

    Their relative error, (2 pi f T)^4 / 30, is 5e-7 at 10 Hz and 1 kHz; three points would have 7e-4, of the size of
    the standard deviations that are reported.
    """
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    a, b, c, d, e = q[:-4], q[1:-3], q[2:-2], q[3:-1], q[4:]
    qd[2:-2] = (a - 8 * b + 8 * d - e) / (12 * period)
    qdd[2:-2] = (-a + 16 * b - 30 * c + 16 * d - e) / (12 * period**2)
    return qd, qdd
