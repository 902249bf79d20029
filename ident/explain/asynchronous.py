"""What differs from period to period: events (contact) and lines that keep their own time (fan, mains, neighbour).

Looked for before anything else: a hum that is not seen here is later called an elasticity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ident.explain.scene import Scene, View

Array = NDArray[np.float64]

WINDOW_S = 0.2
EVENT = 60.0  # standard deviations of a window's energy
LINE = 60.0  # times the median of the neighbouring bins; the largest of 10 000 bins of noise reaches 14
LOWEST_HZ, HIGHEST = 1.5, 0.42  # of lines; of the inner rate: the filters' edge looks like a line
CERTAIN = 6.0  # standard deviations of a line's amplitude
NEIGHBOURS = 60  # bins either side
LONE = 0.5  # share of a single recording's excess that one event must hold


@dataclass(frozen=True)
class Event:
    """One thing that happened once.

    Attributes:
        motion: Index of the motion; `period` of its repetition.
        time_s: Start and end in the recording.
        rows: Of the motion, as a slice of its rows.
        torque_Nm: Largest deviation, signed.
        z: Standard deviations.
    """

    motion: int
    period: int
    joint: int
    time_s: tuple[float, float]
    rows: slice
    torque_Nm: float
    z: float


@dataclass(frozen=True)
class Line:
    """A torque of one frequency that is not tied to the motion."""

    joint: int
    frequency_Hz: float
    amplitude_Nm: float
    phase_rad: float
    std_Nm: float
    ratio: float


def events(scene: Scene) -> list[Event]:
    """Events, the strongest first; at most one per joint and motion."""
    found = []
    for k, view in enumerate(scene.views):
        found += _repeated(scene, k, view) if view.motion.periods > 1 else _single(scene, k, view)
    found.sort(key=lambda e: -e.z)
    strongest: list[Event] = []
    for event in found:  # a hit is felt by every joint: one event, where it is strongest
        if not any(e.motion == event.motion and _overlap(e.rows, event.rows) for e in strongest):
            strongest.append(event)
    return strongest


def lines(scene: Scene) -> list[Line]:
    """The strongest line of every joint that has one."""
    found: dict[int, Line] = {}
    for view in scene.views:
        for line in _lines(scene, view):
            if line.joint not in found or line.ratio > found[line.joint].ratio:
                found[line.joint] = line
    return sorted(found.values(), key=lambda line: -line.ratio)


def _deviations(view: View) -> Array:
    """Torque of each period less the mean, without what accelerations differ by, shape (P, T, J)."""
    m = view.motion
    return np.asarray(m.each_tau - view.axis_inertia * m.each_qdd)


def _repeated(scene: Scene, k: int, view: View) -> list[Event]:
    m, low = view.motion, view.low
    rows = np.stack([low(d) for d in _deviations(view)])
    size = max(2, round(WINDOW_S * scene.rate_Hz))
    standing = np.stack([w[scene.row_motion[j] == k] == 0 for j, w in enumerate(scene.weight)], axis=1)
    out = []
    for j in range(scene.joints):
        energy = (rows[:, :, j] ** 2).sum(axis=0) / (scene.floor[j] * (m.periods - 1))
        energy = np.where(standing[:, j], 1.0, energy)
        window = ndimage.uniform_filter1d(energy, size, mode="wrap") * size
        # torques that wander with temperature raise all windows: compare with the ordinary one
        usual = max(float(np.median(window)) / size, 1.0)
        freedom = size * scene.independent * (m.periods - 1)
        z = (window / size / usual - 1) * freedom / np.sqrt(2 * freedom)
        at = int(np.argmax(z))
        if z[at] < EVENT:
            continue
        inside = _around(energy / usual > 9.0, at, size)
        residual = low(m.tau_Nm - view.total)[:, j]
        each = rows[:, inside, j] + residual[inside]
        period = int(np.argmax((each**2).sum(axis=1)))
        peak = rows[period, inside, j][int(np.argmax(np.abs(rows[period, inside, j])))] * m.periods / (m.periods - 1)
        offset = period * (m.samples * m.dt_s)
        times = m.t_s[low.at[inside.start]] + offset, m.t_s[low.at[inside.stop - 1]] + offset
        out.append(Event(k, period, j, (float(times[0]), float(times[1])), inside, float(peak), float(z[at])))
    return out


def _single(scene: Scene, k: int, view: View) -> list[Event]:
    """Without repetition an event is a burst that holds most of the excess and has no like in the motion."""
    out = []
    size = max(2, round(WINDOW_S * scene.rate_Hz))
    for j in range(scene.joints):
        mine = scene.row_motion[j] == k
        r = scene.residual_rows(j)[mine]
        live = scene.weight[j][mine] > 0
        if live.sum() < 10 * size:
            continue
        energy = np.where(live, r**2, 0.0)
        usual = max(float(np.median(energy[live])) / 0.455, 1.0)  # median of chi² with one degree of freedom
        window = ndimage.uniform_filter1d(energy, size) * size
        freedom = size * scene.independent
        z = (window / size / usual - 1) * freedom / np.sqrt(2 * freedom)
        at = int(np.argmax(z))
        if z[at] < EVENT:
            continue
        inside = _around(ndimage.uniform_filter1d(energy, 3) / usual > 9.0, at, size)
        rest = np.delete(window, np.arange(max(0, inside.start - size), min(len(window), inside.stop + size)))
        lone = energy[inside].sum() > LONE * energy.sum() and rest.size and rest.max() < 0.2 * window[at]
        if not lone:
            continue
        torque = view.low(view.residual)[inside, j]
        times = view.motion.t_s[view.low.at[inside.start]], view.motion.t_s[view.low.at[inside.stop - 1]]
        peak = float(torque[int(np.argmax(np.abs(torque)))])
        out.append(Event(k, 0, j, (float(times[0]), float(times[1])), inside, peak, float(z[at])))
    return out


def _lines(scene: Scene, view: View) -> list[Line]:
    m = view.motion
    if m.periods > 1:
        series = _deviations(view).reshape(-1, scene.joints)
    else:
        series = view.residual - ndimage.uniform_filter1d(view.residual, max(3, round(0.5 / m.dt_s)), axis=0)
    n = len(series)
    taper = np.hanning(n)
    power = np.abs(np.fft.rfft(series * taper[:, None], axis=0)) ** 2
    frequency = np.fft.rfftfreq(n, m.dt_s)
    out = []
    for j in range(scene.joints):
        local = ndimage.median_filter(power[:, j], 2 * NEIGHBOURS + 1, mode="nearest")
        ratio = power[:, j] / np.maximum(local, 1e-300)
        ratio[(frequency < LOWEST_HZ) | (frequency > HIGHEST / m.dt_s)] = 0.0
        at = int(np.argmax(ratio))
        wide = (ratio[max(0, at - NEIGHBOURS) : at + NEIGHBOURS] > 0.1 * ratio[at]).sum()
        least = LINE if m.periods > 1 else 4 * LINE
        if ratio[at] < least or wide > 8:
            continue
        line = _fitted(j, series[:, j], view, float(frequency[at]), float(ratio[at]))
        if line.amplitude_Nm > CERTAIN * line.std_Nm:
            out.append(line)
    return out


def _fitted(j: int, series: Array, view: View, frequency: float, ratio: float) -> Line:
    """Frequency refined to a tenth of a bin, amplitude and phase by least squares."""
    m = view.motion
    t = m.t_s[0] + m.dt_s * np.arange(len(series))
    best: tuple[float, float, Array, float] | None = None
    for f in frequency + np.linspace(-0.6, 0.6, 25) / (len(series) * m.dt_s):
        X = np.column_stack([np.sin(2 * np.pi * f * t), np.cos(2 * np.pi * f * t)])
        c, *_ = np.linalg.lstsq(X, series, rcond=None)
        left = float(np.sum((series - X @ c) ** 2))
        if best is None or left < best[0]:
            best = left, float(f), c, float(np.sqrt(left / len(series) * 2 / len(series)))
    if best is None:
        raise ArithmeticError("no frequency was tried")
    _, f, c, std = best
    lost = 1 - 1 / m.periods if m.periods > 1 and abs(f * m.samples * m.dt_s % 1) < 0.02 else 1.0
    return Line(j, f, float(np.hypot(*c)) / lost, float(np.arctan2(c[1], c[0])), std, ratio)


def _around(high: NDArray[np.bool_], at: int, size: int) -> slice:
    """The run of flagged rows around one, gaps shorter than half a window closed."""
    closed = ndimage.binary_closing(high, np.ones(max(2, size // 2), dtype=bool))
    closed[at] = True
    start = at
    while start > 0 and closed[start - 1]:
        start -= 1
    end = at + 1
    while end < len(closed) and closed[end]:
        end += 1
    return slice(max(0, start - 1), min(len(closed), end + 1))


def _overlap(a: slice, b: slice) -> bool:
    return bool(a.start < b.stop + 5 and b.start < a.stop + 5)


def masked(scene: Scene, found: Sequence[Event]) -> None:
    """Rows of events are not judged, on any joint."""
    for event in found:
        for j in range(scene.joints):
            rows = np.flatnonzero(scene.row_motion[j] == event.motion)
            pad = slice(max(0, event.rows.start - 4), event.rows.stop + 4)
            hit = rows[pad]
            scene.weight[j][hit] = 0.0
            scene.W[j][hit] = 0.0
            scene.y[j][hit] = 0.0
