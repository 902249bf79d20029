"""Recordings to motions: repeated motions averaged over their periods, everything else as it is."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ident.dataset import Segment, Signals, prepare
from ident.explain import period
from protocols.errors import DataError

Array = NDArray[np.float64]

FILTER_HZ = 100.0  # of positions; four times the band that is judged, so that its fall does not show
FILTER_SHARE = 0.4  # of the sampling rate, at most
INNER_HZ = 500.0  # columns are evaluated at this rate: a reversal takes some ms
SHORTEST_S = 1.5  # of a motion
JUMP, JUMP_SHARE, JUMP_PAD_S = 3.0, 0.1, 0.3  # times faster than the rest, in the first tenth; settling after it
CLIPPED = 8  # samples in a row at the extreme value of a torque that no live signal repeats


@dataclass(frozen=True)
class Temperature:
    """Motor temperatures.

    Attributes:
        t_s: Since the start of the recording, shape (S,).
        motor_C: shape (S, J).
    """

    t_s: Array
    motor_C: Array


@dataclass(frozen=True)
class Run:
    """One recording of a session.

    Attributes:
        signals: As measured.
        start_s: When it was started, since the start of the session.
        temperature: None where it was not recorded.
    """

    signals: Signals
    start_s: float = 0.0
    temperature: Temperature | None = None


@dataclass(frozen=True)
class Motion:
    """One stretch of motion at the inner rate, averaged over its periods.

    Attributes:
        source: Name for messages.
        run: Index of the recording.
        clock_s: Session time of each row (of a repeated motion: the mean over its periods), shape (T,).
        t_s: Time in the recording of each row of the first period, shape (T,).
        dt_s: Step.
        q, qd, qdd, tau_Nm: shape (T, J).
        periods: How many were averaged.
        circular: The end joins the beginning.
        each_tau, each_qdd: What the periods differ by from their mean, shape (periods, T, J).
        temperature_C: Of the motors, shape (T, J); None where not recorded.
        measured: Torque is from currents that the drives measured, whose age is known; else it may be a command.
    """

    source: str
    run: int
    clock_s: Array
    t_s: Array
    dt_s: float
    q: Array
    qd: Array
    qdd: Array
    tau_Nm: Array
    periods: int
    circular: bool
    each_tau: Array
    each_qdd: Array
    temperature_C: Array | None = None
    measured: bool = False

    @property
    def samples(self) -> int:
        return len(self.t_s)

    def part(self, rows: slice) -> "Motion":
        """A piece of a motion, which no longer joins its ends."""
        return replace(
            self,
            clock_s=self.clock_s[rows],
            t_s=self.t_s[rows],
            q=self.q[rows],
            qd=self.qd[rows],
            qdd=self.qdd[rows],
            tau_Nm=self.tau_Nm[rows],
            circular=False,
            each_tau=self.each_tau[:, rows],
            each_qdd=self.each_qdd[:, rows],
            temperature_C=None if self.temperature_C is None else self.temperature_C[rows],
        )


def motions(
    runs: Sequence[Run], names: Sequence[str], *, fold: bool = True, filter_Hz: float = FILTER_HZ
) -> list[Motion]:
    """Motions of recordings of one robot.

    Args:
        fold: Average repeated motions over their periods; else every recording is used whole, as it was measured.

    Raises:
        DataError: Recordings of another robot, NaN, or too short.
    """
    if not runs:
        raise DataError("No recording to explain was given.")
    out: list[Motion] = []
    for index, run in enumerate(runs):
        if list(run.signals.joints) != list(names):
            raise DataError(
                f"{run.signals.source} has the joints {', '.join(run.signals.joints)}, but the robot has"
                f" {', '.join(names)}: recordings of different robots cannot be explained together."
            )
        rate = 1 / float(np.median(np.diff(run.signals.t_s))) if run.signals.t_s.size > 2 else 1000.0
        dataset = prepare(run.signals, min(filter_Hz, FILTER_SHARE * rate))
        for segment in dataset.segments:
            out += _of_segment(run, index, _after_jump(segment), dataset.period_s, fold=fold)
    if not out:
        raise DataError(
            f"{runs[0].signals.source}: no stretch is {SHORTEST_S:g} s long. Record at least some seconds of motion."
        )
    return out


def clipped(runs: Sequence[Run]) -> list[str]:
    """A sentence per joint whose torque signal stands at its extreme value."""
    notes = []
    for run in runs:
        for name, tau in zip(run.signals.joints, run.signals.tau_Nm.T, strict=True):
            extreme = np.abs(tau) >= np.abs(tau).max() * (1 - 1e-9)
            longest = max((sum(1 for _ in g) for k, g in itertools.groupby(extreme) if k), default=0)
            if longest >= CLIPPED and np.ptp(tau) > 0:
                notes.append(
                    f"{run.signals.source}: the torque of {name} stands at its extreme of {np.abs(tau).max():.3g} N·m"
                    f" for {longest} samples in a row; a saturated drive or a clipped signal. What happens there is not"
                    " seen: record with smaller accelerations."
                )
    return notes


def _of_segment(run: Run, index: int, segment: Segment, period_s: float, *, fold: bool) -> list[Motion]:
    """The periodic stretch of a segment as one motion, what is before and after it as others."""
    T = segment.t_s.size
    if period_s * T < SHORTEST_S:
        return []
    rate = 1 / period_s
    found = period.find(segment.q, rate) if fold else None
    factor = max(1, int(rate / INNER_HZ + 0.01))
    if found is None:
        return [_single(run, index, segment, period_s, factor)]
    out = [_repeated(run, index, segment, period_s, factor, found)]
    rest = slice(found.high, T)
    if T - found.high > found.period // 2 and _moves(segment, rest):
        out += _of_segment(run, index, _cut(segment, rest), period_s, fold=fold)
    return out


def _after_jump(segment: Segment) -> Segment:
    """Without a start-up jump: a drive that homes, many times faster than anything after it."""
    T = segment.t_s.size
    head = int(JUMP_SHARE * T)
    speed = np.abs(segment.qd)
    rest = speed[head:].max(axis=0)
    jumps = np.flatnonzero((speed[:head] > JUMP * np.maximum(rest, 1e-9)).any(axis=1) & (rest > 0).any())
    if not jumps.size:
        return segment
    step = segment.t_s[1] - segment.t_s[0]
    return _cut(segment, slice(min(T, int(jumps[-1]) + round(JUMP_PAD_S / step)), T))


def _moves(segment: Segment, rows: slice) -> bool:
    """Some joint moves as fast as it usually does for a fair part of the rows."""
    share = np.abs(segment.qd[rows]) > 0.1 * np.abs(segment.qd).max(axis=0)
    return bool(share.mean(axis=0).max() > 0.3)


def _cut(segment: Segment, rows: slice) -> Segment:
    return Segment(segment.t_s[rows], segment.q[rows], segment.qd[rows], segment.qdd[rows], segment.tau_Nm[rows])


def _single(run: Run, index: int, segment: Segment, period_s: float, factor: int) -> Motion:
    tau = _smoothed(segment.tau_Nm, factor)
    pick = slice(None, None, factor)
    t = segment.t_s[pick]
    J = tau.shape[1]
    return Motion(
        source=run.signals.source,
        run=index,
        clock_s=run.start_s + t,
        t_s=t,
        dt_s=period_s * factor,
        q=segment.q[pick],
        qd=segment.qd[pick],
        qdd=segment.qdd[pick],
        tau_Nm=tau[pick],
        periods=1,
        circular=False,
        each_tau=np.zeros((0, t.size, J)),
        each_qdd=np.zeros((0, t.size, J)),
        temperature_C=_temperature(run, t[None]),
        measured=bool((run.signals.delay_s > 0).any()),
    )


def _repeated(
    run: Run, index_of_run: int, segment: Segment, period_s: float, factor: int, found: period.Repetition
) -> Motion:
    P, L = found.count, found.period
    rows = found.start + np.arange(P * L)
    used = ((rows >= found.low) & (rows < found.high)).reshape(P, L)
    index = np.clip(rows, 0, segment.t_s.size - 1).reshape(P, L)
    pick = slice(None, None, factor)

    def fold(values: Array) -> tuple[Array, Array]:
        """Mean over the periods, shape (T, J), and what each differs by, (P, T, J); start-up is that mean."""
        each = values[index[:, pick]]
        live = used[:, pick, None]
        mean = (each * live).sum(axis=0) / live.sum(axis=0)
        return mean, (each - mean) * live

    (q, _), (qd, _), (qdd, each_qdd) = (fold(v) for v in (segment.q, segment.qd, segment.qdd))
    tau, each_tau = fold(_smoothed(segment.tau_Nm, factor))
    t = (segment.t_s[0] + period_s * rows.reshape(P, L))[:, pick]
    return Motion(
        source=run.signals.source,
        run=index_of_run,
        clock_s=run.start_s + t.mean(axis=0),
        t_s=t[0],
        dt_s=period_s * factor,
        q=q,
        qd=qd,
        qdd=qdd,
        tau_Nm=tau,
        periods=P,
        circular=True,
        each_tau=each_tau,
        each_qdd=each_qdd,
        temperature_C=_temperature(run, t),
        measured=bool((run.signals.delay_s > 0).any()),
    )


def _smoothed(tau: Array, factor: int) -> Array:
    """Zero-phase low-pass that lets every `factor`-th sample be picked; the same length."""
    if factor == 1:
        return tau
    taps = signal.firwin(8 * factor + 1, 0.7 / factor)
    half = 4 * factor
    padded = np.pad(tau, ((half, half), (0, 0)), mode="edge")
    return np.asarray(signal.oaconvolve(padded, taps[:, None], mode="valid", axes=0))


def _temperature(run: Run, t_s: Array) -> Array | None:
    """Mean over periods of the motor temperatures at times of shape (P, T); shape (T, J)."""
    if run.temperature is None or run.temperature.t_s.size == 0:
        return None
    columns = [np.interp(t_s, run.temperature.t_s, values).mean(axis=0) for values in run.temperature.motor_C.T]
    return np.column_stack(columns)
