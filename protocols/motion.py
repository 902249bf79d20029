"""`motion.toml`: reference trajectories, evaluated as pure functions of time.

A motion is a list of segments one after the other; each starts where the one before it ended.
"""

import itertools
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from protocols import config
from protocols.errors import ConfigError
from protocols.robot import Robot

Positive = Annotated[float, Meta(gt=0)]


class Reference(msgspec.Struct, frozen=True):
    """A sampled reference.

    Attributes:
        t_s: shape (T,) [s].
        q, qd, qdd: Position, velocity, acceleration, shape (T, J) [rad, rad/s, rad/s²].
    """

    t_s: NDArray[np.float64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    qdd: NDArray[np.float64]


class Fourier(config.Table, frozen=True, kw_only=True, tag="fourier", tag_field="kind"):
    """Periodic Fourier series of Swevers et al. 1997 (also Bona & Curatella, eq. (17)-(19)), blended in and out
    by fifth-order polynomials.

    Attributes:
        base_Hz: Frequency of the first harmonic.
        periods: Whole periods.
        centre_rad: shape (J,).
        sine_rad, cosine_rad: Position amplitude per joint (row) and harmonic.
    """

    base_Hz: Annotated[float, Meta(gt=0)]
    periods: Annotated[int, Meta(ge=1)] = 1
    centre_rad: list[float]
    sine_rad: list[list[float]]
    cosine_rad: list[list[float]]


class Points(config.Table, frozen=True, kw_only=True, tag="polynomial5", tag_field="kind"):
    """Fifth-order polynomials between via points, at rest in each (Khalil & Dombre, Modeling, ch. 13).

    Attributes:
        point_rad: Via points, rows of J.
        move_s: Time of each move, in order; one value stands for all.
        dwell_s: Rest after each move.
    """

    point_rad: list[list[float]]
    move_s: list[Positive]
    dwell_s: Annotated[float, Meta(ge=0)] = 0.0


class Trapezoid(config.Table, frozen=True, kw_only=True, tag="trapezoid", tag_field="kind"):
    """Trapezoidal speed between via points: slow ramps for gravity, bang-bang for friction (where no axis gets to
    its speed).

    Attributes:
        point_rad: Via points, rows of J.
        velocity_rad_s, acceleration_rad_s2: Limits per joint.
        dwell_s: Rest after each move.
    """

    point_rad: list[list[float]]
    velocity_rad_s: list[Positive]
    acceleration_rad_s2: list[Positive]
    dwell_s: Annotated[float, Meta(ge=0)] = 0.0


class Standstill(config.Table, frozen=True, kw_only=True, tag="standstill", tag_field="kind"):
    """Hold the last position."""

    duration_s: Positive


Segment = Fourier | Points | Trapezoid | Standstill


class Motion(config.Table, frozen=True, kw_only=True):
    """One motion.

    Attributes:
        approach_s: Time of the fifth-order move from wherever the arm is to the first position.
        segment: What follows.
    """

    name: str
    approach_s: Positive = 2.0
    segment: Annotated[list[Segment], Meta(min_length=1)]


def _hermite(start: NDArray[np.float64], end: NDArray[np.float64], steps: int, dt: float) -> list[NDArray[np.float64]]:
    """Fifth-order polynomial between two states on steps 1..steps of the grid.

    Args:
        start, end: Position, velocity, acceleration in rows, shape (3, J).

    Returns:
        Position, velocity, acceleration, each of shape (steps, J).
    """
    T = steps * dt
    scale = np.array([[1.0], [T], [T**2 / 2]])
    a, b = (
        start * scale,
        end * scale,
    )  # derivatives in s = t/T, the second halved: Taylor coefficients at s = 0
    rise, slope, curve = b[0] - a.sum(0), b[1] - a[1] - 2 * a[2], b[2] - a[2]
    c = np.array([*a, 10 * rise - 4 * slope + curve, -15 * rise + 7 * slope - 2 * curve, 6 * rise - 3 * slope + curve])
    s = np.arange(1, steps + 1)[:, None] / steps
    k = np.arange(6)
    q = s**k @ c
    qd = (k[1:] * s ** k[:-1]) @ c[1:] / T
    qdd = (k[2:] * k[1:-1] * s ** k[:-2]) @ c[2:] / T**2
    return [q, qd, qdd]


def _fourier(segment: Fourier, dt: float) -> list[NDArray[np.float64]]:
    a, b = np.array(segment.sine_rad).T, np.array(segment.cosine_rad).T
    w = 2 * np.pi * segment.base_Hz * np.arange(1, len(a) + 1)
    t = np.arange(round(segment.periods / segment.base_Hz / dt) + 1) * dt
    sin, cos = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    q = np.array(segment.centre_rad) + sin @ a + cos @ b
    return [q, (cos * w) @ a - (sin * w) @ b, -(sin * w**2) @ a - (cos * w**2) @ b]


def _trapezoid(
    segment: Trapezoid, start: NDArray[np.float64], end: NDArray[np.float64], dt: float
) -> list[NDArray[np.float64]]:
    """All axes start and stop together; the one that needs longest runs at its limits."""
    span = end - start
    speed, accel = np.array(segment.velocity_rad_s), np.array(segment.acceleration_rad_s2)
    distance = np.abs(span)
    ramps = np.where(distance * accel < speed**2, 2 * np.sqrt(distance / accel), distance / speed + speed / accel)
    T = max(1, int(np.ceil(float(ramps.max()) / dt))) * dt
    # Time of acceleration that covers the distance in T at the axis' acceleration: ta (T - ta) a = distance.
    ta = (T - np.sqrt(np.maximum(0.0, T**2 - 4 * distance / accel))) / 2
    ta = np.where(distance > 0, np.maximum(ta, dt), dt)
    peak = span / (T - ta)
    t = np.arange(1, round(T / dt) + 1)[:, None] * dt
    up, down = t < ta, t > T - ta
    q = np.where(
        up,
        start + peak * t**2 / (2 * ta),
        np.where(down, end - peak * (T - t) ** 2 / (2 * ta), start + peak * (t - ta / 2)),
    )
    qd = np.where(up, peak * t / ta, np.where(down, peak * (T - t) / ta, peak + 0 * t))
    qdd = np.where(up, peak / ta, np.where(down, -peak / ta, 0.0))
    return [q, qd, qdd]


def _rest(q: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([q, np.zeros_like(q), np.zeros_like(q)])


def _hold(q: NDArray[np.float64], seconds: float, dt: float) -> list[NDArray[np.float64]]:
    steps = round(seconds / dt)
    return [np.tile(row, (steps, 1)) for row in _rest(q)]


def sample(motion: Motion, robot: Robot, dt: float, start: NDArray[np.float64] | None = None) -> Reference:
    """Reference of a motion on the grid of the SYNC period.

    Every motion starts and ends at rest: a Fourier segment is preceded and followed by a fifth-order blend of
    `approach_s` that takes position, velocity and acceleration to and from the series' own.

    Args:
        dt: Sampling period [s].
        start: Where the arm is, shape (J,) [rad]; the motion's first position where left out.

    Raises:
        ConfigError: A shape does not match the robot, or the reference leaves a joint's position or speed range.
    """
    for number, segment in enumerate(motion.segment):
        _check_shapes(segment, robot.joints, f"{motion.name}: segment {number + 1}")
    approach = max(1, round(motion.approach_s / dt))
    first = _first_position(motion.segment[0])
    if start is None and first is None:
        raise ConfigError(f"{motion.name}: starts with a standstill, which needs to be told where.")
    here = np.asarray(first if start is None else start, dtype=float)
    pieces = [[row[None, :] for row in _rest(here)]]
    for segment in motion.segment:
        if isinstance(segment, Standstill):
            pieces.append(_hold(here, segment.duration_s, dt))
        elif isinstance(segment, Fourier):
            series = _fourier(segment, dt)
            begin, end = (np.array([row[k] for row in series]) for k in (0, -1))
            pieces.append(_hermite(_rest(here), begin, approach, dt))
            pieces.append([row[1:] for row in series])
            here = np.array(segment.centre_rad)
            pieces.append(_hermite(end, _rest(here), approach, dt))
        else:
            points = np.array(segment.point_rad)
            pieces.append(_hermite(_rest(here), _rest(points[0]), approach, dt))
            for k, (a, b) in enumerate(itertools.pairwise(points)):
                if isinstance(segment, Trapezoid):
                    pieces.append(_trapezoid(segment, a, b, dt))
                else:
                    seconds = segment.move_s[0 if len(segment.move_s) == 1 else k]
                    pieces.append(_hermite(_rest(a), _rest(b), max(1, round(seconds / dt)), dt))
                pieces.append(_hold(b, segment.dwell_s, dt))
            here = points[-1]
    q, qd, qdd = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    t_s = dt * np.arange(len(q), dtype=np.float64)
    _check_limits(motion.name, q, qd, robot)
    return Reference(t_s, q, qd, qdd)


def _first_position(segment: Segment) -> NDArray[np.float64] | None:
    if isinstance(segment, Standstill):
        return None
    if isinstance(segment, Fourier):
        return np.array(segment.centre_rad)
    return np.array(segment.point_rad[0])


def _check_shapes(segment: Segment, joints: int, where: str) -> None:
    def need(name: str, found: int, wanted: int) -> None:
        if found != wanted:
            raise ConfigError(f"{where}: {name} has {found} values, {wanted} are needed.")

    if isinstance(segment, Fourier):
        for name in ("centre_rad", "sine_rad", "cosine_rad"):
            need(name, len(getattr(segment, name)), joints)
        for row in (*segment.sine_rad, *segment.cosine_rad):
            need("each row of sine_rad and cosine_rad", len(row), len(segment.sine_rad[0]))
    elif isinstance(segment, Points | Trapezoid):
        for row in segment.point_rad:
            need("each row of point_rad", len(row), joints)
        if isinstance(segment, Trapezoid):
            need("velocity_rad_s", len(segment.velocity_rad_s), joints)
            need("acceleration_rad_s2", len(segment.acceleration_rad_s2), joints)
        elif len(segment.move_s) != 1:
            need("move_s", len(segment.move_s), len(segment.point_rad) - 1)


def _check_limits(name: str, q: NDArray[np.float64], qd: NDArray[np.float64], robot: Robot) -> None:
    for j, joint in enumerate(robot.joint):
        low, high, speed = float(q[:, j].min()), float(q[:, j].max()), float(np.abs(qd[:, j]).max())
        if low < joint.position_min_rad or high > joint.position_max_rad:
            raise ConfigError(
                f"{name}: {joint.name} would move from {low:.4g} to {high:.4g} rad, outside its range"
                f" {joint.position_min_rad:.4g} to {joint.position_max_rad:.4g} rad. Use smaller amplitudes."
            )
        if speed > joint.velocity_max_rad_s:
            raise ConfigError(
                f"{name}: {joint.name} would reach {speed:.4g} rad/s, above its limit of"
                f" {joint.velocity_max_rad_s:.4g} rad/s. Use longer moves or smaller amplitudes."
            )
