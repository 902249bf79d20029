"""Rigid-body dynamics of serial chains in compiled code: inverse dynamics and mass matrix.

Recursive Newton-Euler and composite rigid bodies in link frames (Khalil & Dombre, Modeling, ch. 9; Featherstone,
Rigid Body Dynamics Algorithms, ch. 6), on the arrays of `protocols.robot.Geometry` and one row of ten inertial
parameters per link in the order of `protocols.robot.INERTIAL`, inertia at the origin of the link frame.

Everything is linear in the parameters and nothing divides by a mass: massless links and estimates that are not
physical are as good as any other.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Vector = tuple[float, float, float]
Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Machine code at the first call, kept on disk. Without fast-math: results must not depend on the compiler."""
    return cast(Function, numba.njit(cache=True)(function))


@compiled
def _add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _row(x: Floats, j: int) -> Vector:
    return x[j, 0], x[j, 1], x[j, 2]


@compiled
def _set_row(x: Floats, j: int, a: Vector) -> None:
    x[j, 0], x[j, 1], x[j, 2] = a


@compiled
def _to_parent(R: Floats, j: int, a: Vector) -> Vector:
    return (
        R[j, 0, 0] * a[0] + R[j, 0, 1] * a[1] + R[j, 0, 2] * a[2],
        R[j, 1, 0] * a[0] + R[j, 1, 1] * a[1] + R[j, 1, 2] * a[2],
        R[j, 2, 0] * a[0] + R[j, 2, 1] * a[1] + R[j, 2, 2] * a[2],
    )


@compiled
def _to_link(R: Floats, j: int, a: Vector) -> Vector:
    return (
        R[j, 0, 0] * a[0] + R[j, 1, 0] * a[1] + R[j, 2, 0] * a[2],
        R[j, 0, 1] * a[0] + R[j, 1, 1] * a[1] + R[j, 2, 1] * a[2],
        R[j, 0, 2] * a[0] + R[j, 1, 2] * a[1] + R[j, 2, 2] * a[2],
    )


@compiled
def _inertia_times(body: Floats, j: int, a: Vector) -> Vector:
    """Rotational inertia of row j (columns xx, xy, xz, yy, yz, zz at 4..9) times a vector."""
    return (
        body[j, 4] * a[0] + body[j, 5] * a[1] + body[j, 6] * a[2],
        body[j, 5] * a[0] + body[j, 7] * a[1] + body[j, 8] * a[2],
        body[j, 6] * a[0] + body[j, 8] * a[1] + body[j, 9] * a[2],
    )


@compiled
def place(R0: Floats, p0: Floats, prismatic: Ints, q: Floats, R: Floats, p: Floats) -> None:
    """Placement of each link frame in its parent's: fills R, shape (J, 3, 3), and p, shape (J, 3) [m]."""
    for j in range(len(q)):
        if prismatic[j]:
            for i in range(3):
                R[j, i, 0], R[j, i, 1], R[j, i, 2] = R0[j, i, 0], R0[j, i, 1], R0[j, i, 2]
                p[j, i] = p0[j, i] + R0[j, i, 2] * q[j]
        else:
            c, s = np.cos(q[j]), np.sin(q[j])
            for i in range(3):
                x, y = R0[j, i, 0], R0[j, i, 1]
                R[j, i, 0], R[j, i, 1], R[j, i, 2] = c * x + s * y, c * y - s * x, R0[j, i, 2]
                p[j, i] = p0[j, i]


@compiled
def newton_euler(
    R: Floats,
    p: Floats,
    prismatic: Ints,
    gravity: Floats,
    link: Floats,
    qd: Floats,
    qdd: Floats,
    tau: Floats,
    f: Floats,
    n: Floats,
) -> None:
    """Inverse dynamics at placements (R, p): fills tau, shape (J,). f, n: scratch, shape (J, 3).

    Gravity enters as an acceleration of the base.
    """
    J = len(qd)
    w = (0.0, 0.0, 0.0)
    wd = (0.0, 0.0, 0.0)
    a = (-gravity[0], -gravity[1], -gravity[2])
    for j in range(J):
        at = _row(p, j)
        a = _to_link(R, j, _add(a, _add(_cross(wd, at), _cross(w, _cross(w, at)))))
        w = _to_link(R, j, w)
        wd = _to_link(R, j, wd)
        if prismatic[j]:
            a = (a[0] + 2.0 * w[1] * qd[j], a[1] - 2.0 * w[0] * qd[j], a[2] + qdd[j])
        else:
            wd = (wd[0] + w[1] * qd[j], wd[1] - w[0] * qd[j], wd[2] + qdd[j])
            w = (w[0], w[1], w[2] + qd[j])
        m = link[j, 0]
        mc = (link[j, 1], link[j, 2], link[j, 3])
        force = _add(_cross(wd, mc), _cross(w, _cross(w, mc)))
        _set_row(f, j, (m * a[0] + force[0], m * a[1] + force[1], m * a[2] + force[2]))
        moment = _add(_inertia_times(link, j, wd), _cross(w, _inertia_times(link, j, w)))
        _set_row(n, j, _add(moment, _cross(mc, a)))
    for j in range(J - 1, -1, -1):
        tau[j] = f[j, 2] if prismatic[j] else n[j, 2]
        if j > 0:
            force = _to_parent(R, j, _row(f, j))
            moment = _add(_to_parent(R, j, _row(n, j)), _cross(_row(p, j), force))
            _set_row(f, j - 1, _add(_row(f, j - 1), force))
            _set_row(n, j - 1, _add(_row(n, j - 1), moment))


@compiled
def _attach(whole: Floats, j: int, R: Floats, p: Floats) -> None:
    """Adds body j of `whole`, moved to its parent's frame, to body j - 1."""
    m = whole[j, 0]
    at = _row(p, j)
    mc = _to_parent(R, j, (whole[j, 1], whole[j, 2], whole[j, 3]))
    # Columns of R I, then I' = (R I) R' and Steiner's terms -[p][mc] - [mc][p] - m [p][p].
    x = _to_parent(R, j, (whole[j, 4], whole[j, 5], whole[j, 6]))
    y = _to_parent(R, j, (whole[j, 5], whole[j, 7], whole[j, 8]))
    z = _to_parent(R, j, (whole[j, 6], whole[j, 8], whole[j, 9]))
    s = (2.0 * mc[0] + m * at[0], 2.0 * mc[1] + m * at[1], 2.0 * mc[2] + m * at[2])
    dot = at[0] * s[0] + at[1] * s[1] + at[2] * s[2]
    k = j - 1
    whole[k, 0] += m
    for i in range(3):
        whole[k, 1 + i] += mc[i] + m * at[i]
    column = 4
    for a in range(3):
        for b in range(a, 3):
            value = x[a] * R[j, b, 0] + y[a] * R[j, b, 1] + z[a] * R[j, b, 2]
            value -= at[a] * mc[b] + mc[a] * at[b] + m * at[a] * at[b]
            whole[k, column] += value + (dot if a == b else 0.0)
            column += 1


@compiled
def composite_inertia(R: Floats, p: Floats, prismatic: Ints, link: Floats, M: Floats, whole: Floats) -> None:
    """Mass matrix at placements (R, p): fills M, shape (J, J). whole: scratch, shape (J, 10)."""
    J = len(link)
    whole[:, :] = link
    for j in range(J - 1, -1, -1):
        if prismatic[j]:  # unit acceleration along z: m z and mc x z
            f = (0.0, 0.0, whole[j, 0])
            n = (whole[j, 2], -whole[j, 1], 0.0)
        else:  # about z: z x mc and I z
            f = (-whole[j, 2], whole[j, 1], 0.0)
            n = (whole[j, 6], whole[j, 8], whole[j, 9])
        M[j, j] = f[2] if prismatic[j] else n[2]
        for i in range(j, 0, -1):
            f = _to_parent(R, i, f)
            n = _add(_to_parent(R, i, n), _cross(_row(p, i), f))
            M[i - 1, j] = f[2] if prismatic[i - 1] else n[2]
            M[j, i - 1] = M[i - 1, j]
        if j > 0:
            _attach(whole, j, R, p)


@compiled
def rnea(
    R0: Floats, p0: Floats, prismatic: Ints, gravity: Floats, link: Floats, q: Floats, qd: Floats, qdd: Floats
) -> Floats:
    """Inverse dynamics M(q) qdd + N(q, qd) (Janot et al. 2014, eq. (1)) without rotors and friction, shape (J,)."""
    J = len(q)
    R, p, tau, f, n = np.empty((J, 3, 3)), np.empty((J, 3)), np.empty(J), np.empty((J, 3)), np.empty((J, 3))
    place(R0, p0, prismatic, q, R, p)
    newton_euler(R, p, prismatic, gravity, link, qd, qdd, tau, f, n)
    return tau


@compiled
def bias(R0: Floats, p0: Floats, prismatic: Ints, gravity: Floats, link: Floats, q: Floats, qd: Floats) -> Floats:
    """N(q, qd): centrifugal, Coriolis and gravity torques, shape (J,)."""
    return rnea(R0, p0, prismatic, gravity, link, q, qd, np.zeros(len(q)))


@compiled
def mass_matrix(R0: Floats, p0: Floats, prismatic: Ints, link: Floats, q: Floats) -> Floats:
    """M(q) of the links, without rotors, shape (J, J)."""
    J = len(q)
    R, p, M, whole = np.empty((J, 3, 3)), np.empty((J, 3)), np.empty((J, J)), np.empty((J, 10))
    place(R0, p0, prismatic, q, R, p)
    composite_inertia(R, p, prismatic, link, M, whole)
    return M
