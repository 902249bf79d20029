"""Where the excess torque is: which variable of the motion orders it, in which band, when."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.explain.contract import Cell, Curve, Located
from ident.explain.gram import Stage
from ident.explain.scene import Scene

Array = NDArray[np.float64]

BINS = 16
CLEAR = 0.15  # share below which nothing static orders the excess
WINDOW_S = 1.0

UNITS = {
    "position": "rad",
    "speed": "rad/s",
    "size of speed": "rad/s",
    "acceleration": "rad/s²",
    "transmitted torque": "N·m",
    "transmitted power": "W",
    "distance since reversal": "rad",
    "time in session": "s",
    "temperature": "°C",
}


@dataclass(frozen=True)
class Regime:
    """Share of the excess that one variable orders, with its curve."""

    name: str
    share: float
    odd: bool
    curve: Curve


def variables(scene: Scene, joint: int) -> dict[str, Array]:
    """Regime variables on the rows of a joint, shape (n_j,) each."""
    out: dict[str, list[Array]] = {name: [] for name in UNITS}
    sensed = all(v.motion.temperature_C is not None for v in scene.views)
    for view in scene.views:
        at, m = view.low.at, view.motion
        q, v = m.q[:, joint], m.qd[:, joint]
        out["position"].append(q[at])
        out["speed"].append(v[at])
        out["size of speed"].append(np.abs(v)[at])
        out["acceleration"].append(m.qdd[at, joint])
        out["transmitted torque"].append(view.load[at, joint])
        out["transmitted power"].append(view.load[at, joint] * v[at])
        out["distance since reversal"].append(since_reversal(q, v)[at])
        out["time in session"].append(m.clock_s[at])
        if sensed and m.temperature_C is not None:
            out["temperature"].append(m.temperature_C[at, joint])
    return {name: np.concatenate(parts) for name, parts in out.items() if parts}


def since_reversal(q: Array, v: Array) -> Array:
    """Distance travelled since the last change of direction, shape (T,)."""
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(q)))])
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0) + 1
    start = np.zeros(len(q))
    start[turns] = path[turns]
    return np.asarray(path - np.maximum.accumulate(start))


def regimes(scene: Scene, stage: Stage, joint: int) -> list[Regime]:
    """Every regime variable by the share of the excess that it orders, largest first (an analysis of variance)."""
    live = scene.weight[joint] > 0
    if live.sum() < 4 * BINS:
        return []
    r = stage.residual(joint)[live, 0]
    sigma = 1 / np.median(scene.weight[joint][live])
    excess = float(np.sum(r**2)) - live.sum() * scene.independent
    if excess <= 0:
        return []
    found = []
    every = variables(scene, joint)
    direction = np.sign(every["speed"][live])
    for name, values in every.items():
        x = values[live]
        if np.ptp(x) <= 1e-12:
            continue
        even = _ordered(x, r, excess)
        odd = _ordered(x, r * direction, excess) if name != "speed" else 0.0
        is_odd = odd > even
        share = odd if is_odd else even
        signed = r * direction if is_odd else r
        unit = UNITS[name].replace("rad", "m") if scene.model.geometry.prismatic[joint] else UNITS[name]
        over = f"{name} [{unit}]" + (", torque × direction" if is_odd else "")
        found.append(Regime(name, float(np.clip(share, 0, 1)), is_odd, curve(x, signed * sigma, over)))
    return sorted(found, key=lambda f: -f.share)


def locate(scene: Scene, stage: Stage, joint: int, ratio: float) -> Located:
    """One joint's excess, in numbers and a sentence."""
    name = scene.model.robot.joint[joint].name
    found = regimes(scene, stage, joint)
    share = max(0.0, 100 * (1 - 1 / ratio)) if ratio > 0 else 0.0
    band, when = _band(scene, stage, joint), _worst(scene, stage, joint)
    lead = found[0] if found else None
    if lead is None or lead.share < CLEAR:
        regime = "no static variable"
        words = f"no single variable of the motion orders it: dynamic, between {band[0]:.0f} and {band[1]:.0f} Hz"
    else:
        regime = lead.name + (" × direction" if lead.odd else "")
        turn = " and changes sign with direction" if lead.odd else ""
        words = f"{100 * lead.share:.0f} % of that excess is ordered by {lead.name}{turn}"
    sentence = (
        f"{name}: residual {ratio:.3g} times the noise power; {words}; worst at {when[0]:.1f} to {when[1]:.1f} s."
    )
    cells = [Cell(f.name, 100 * f.share, f.odd) for f in found]
    return Located(
        joint=name,
        excess_ratio=float(ratio),
        unexplained_percent=share,
        regime=regime,
        band_Hz=band,
        time_s=when,
        sentence=sentence,
        map=cells,
    )


def curve(x: Array, y: Array, over: str, bins: int = BINS) -> Curve:
    """Mean of y over quantile bins of x, with its 95 % band."""
    order = np.argsort(x, kind="stable")
    groups = [g for g in np.array_split(order, bins) if g.size > 1]
    centre = [float(x[g].mean()) for g in groups]
    mean = np.array([float(y[g].mean()) for g in groups])
    half = np.array([1.96 * float(y[g].std(ddof=1)) / np.sqrt(g.size) for g in groups])
    return Curve(over, centre, mean.tolist(), (mean - half).tolist(), (mean + half).tolist())


def _ordered(x: Array, r: Array, excess: float) -> float:
    """eta² of the excess over quantile bins."""
    order = np.argsort(x, kind="stable")
    total = 0.0
    for group in np.array_split(order, BINS):
        if group.size:
            total += float(group.size * (r[group].mean() ** 2 - 1 / group.size))
    return total / excess


def _band(scene: Scene, stage: Stage, joint: int) -> tuple[float, float]:
    """Frequencies between which the middle 80 % of the residual power lie."""
    r = stage.residual(joint)[:, 0]
    power = np.zeros(0)
    for k in range(len(scene.views)):
        part = r[scene.row_motion[joint] == k]
        spectrum = np.abs(np.fft.rfft(part, 1024)) ** 2 if len(part) <= 1024 else np.abs(np.fft.rfft(part)) ** 2
        grid = np.linspace(0, 1, 257)
        spread = np.interp(grid, np.linspace(0, 1, len(spectrum)), spectrum)
        power = power + spread if power.size else spread
    below = np.cumsum(power) / max(power.sum(), 1e-300)
    half = scene.rate_Hz / 2
    low, high = np.searchsorted(below, [0.1, 0.9])
    return float(low / 256 * half), float(min(high, 256) / 256 * half)


def _worst(scene: Scene, stage: Stage, joint: int) -> tuple[float, float]:
    """Session time of the worst second."""
    r2 = stage.residual(joint)[:, 0] ** 2
    clock = np.concatenate([v.motion.clock_s[v.low.at] for v in scene.views])
    size = max(1, round(WINDOW_S * scene.rate_Hz))
    best, at = -1.0, 0
    for k in range(len(scene.views)):
        rows = np.flatnonzero(scene.row_motion[joint] == k)
        if rows.size < size:
            continue
        energy = np.convolve(r2[rows], np.ones(size), mode="valid")
        if energy.max() > best:
            best, at = float(energy.max()), int(rows[int(np.argmax(energy))])
    return float(clock[at]), float(clock[min(at + size, len(clock) - 1)])
