"""Derivatives of the inverse dynamics of a serial chain by its state, in compiled code.

Singh, Russell & Wensing 2022 (IEEE Robotics and Automation Letters 7, 1775-1782), all vectors in the base frame, with
their Coriolis matrix written out for a rigid body: with points r of density rho that move at v = u + w x r, and a the
angular part of what it is applied to,

    2 B (a, b) = 2 (integral of rho r x (a x v), integral of rho a x v) = 2 (tr(G) a - G a, a x P),

where G is the integral of rho v r' and P the momentum. Both add up over bodies, and both are linear in the parameters.
"""

from typing import NamedTuple

import numpy as np

from emulator.forward import Chain
from emulator.kernels import Floats, Vector, compiled, place

_XX, _XY, _XZ, _YY, _YZ, _ZZ = 4, 5, 6, 7, 8, 9  # columns of a row of inertial parameters
Spatial = tuple[Vector, Vector]  # motions and wrenches: angular part or moment first, about the base origin


class Bodies(NamedTuple):
    """Scratch, one row per joint: its screw and rates, and its link together with all links after it.

    Attributes:
        R, p: Placement in the frame before.
        S: Screw of the joint, shape (J, 6).
        dS: Its rate by the speed of the link before it.
        ddS: Its rate by that link's acceleration, and that of dS by its speed.
        inertia: The ten parameters in the base frame.
        flow: G of the module row by row, then P, shape (J, 12).
        force: Wrench that moves the links.
    """

    R: Floats
    p: Floats
    S: Floats
    dS: Floats
    ddS: Floats
    inertia: Floats
    flow: Floats
    force: Floats


@compiled
def bodies(J: int) -> Bodies:
    return Bodies(
        np.empty((J, 3, 3)),
        np.empty((J, 3)),
        np.empty((J, 6)),
        np.empty((J, 6)),
        np.empty((J, 6)),
        np.empty((J, 10)),
        np.empty((J, 12)),
        np.empty((J, 6)),
    )


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _sum(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def _times(k: float, a: Vector) -> Vector:
    return k * a[0], k * a[1], k * a[2]


@compiled
def _dot(a: Spatial, x: Floats, j: int) -> float:
    """Power of a wrench on the motion in row j, or the like."""
    n, f = a
    turning: float = n[0] * x[j, 0] + n[1] * x[j, 1] + n[2] * x[j, 2]
    moving: float = f[0] * x[j, 3] + f[1] * x[j, 4] + f[2] * x[j, 5]
    return turning + moving


@compiled
def _at(x: Floats, j: int) -> Spatial:
    return (x[j, 0], x[j, 1], x[j, 2]), (x[j, 3], x[j, 4], x[j, 5])


@compiled
def _put(x: Floats, j: int, a: Spatial) -> None:
    (x[j, 0], x[j, 1], x[j, 2]), (x[j, 3], x[j, 4], x[j, 5]) = a


@compiled
def _both(a: Spatial, b: Spatial) -> Spatial:
    return _sum(a[0], b[0]), _sum(a[1], b[1])


@compiled
def _turn_motion(v: Spatial, m: Spatial) -> Spatial:
    """v x m: rate of a motion m that is carried by v."""
    return _cross(v[0], m[0]), _sum(_cross(v[0], m[1]), _cross(v[1], m[0]))


@compiled
def _turn_wrench(v: Spatial, f: Spatial) -> Spatial:
    """v x* f: rate of a wrench f that is carried by v."""
    return _sum(_cross(v[0], f[0]), _cross(v[1], f[1])), _cross(v[0], f[1])


@compiled
def _inertia_times(body: Floats, j: int, m: Spatial) -> Spatial:
    """Wrench of a motion m of the bodies in row j."""
    w, u = m
    h = (body[j, 1], body[j, 2], body[j, 3])
    turning = (
        body[j, _XX] * w[0] + body[j, _XY] * w[1] + body[j, _XZ] * w[2],
        body[j, _XY] * w[0] + body[j, _YY] * w[1] + body[j, _YZ] * w[2],
        body[j, _XZ] * w[0] + body[j, _YZ] * w[1] + body[j, _ZZ] * w[2],
    )
    return _sum(turning, _cross(h, u)), _sum(_times(body[j, 0], u), _cross(w, h))


@compiled
def _coriolis_times(flow: Floats, j: int, a: Vector) -> Spatial:
    """2 B (a, .) of the module."""
    G, trace = flow, flow[j, 0] + flow[j, 4] + flow[j, 8]
    turned = (
        trace * a[0] - G[j, 0] * a[0] - G[j, 1] * a[1] - G[j, 2] * a[2],
        trace * a[1] - G[j, 3] * a[0] - G[j, 4] * a[1] - G[j, 5] * a[2],
        trace * a[2] - G[j, 6] * a[0] - G[j, 7] * a[1] - G[j, 8] * a[2],
    )
    return _times(2.0, turned), _cross(a, (2.0 * flow[j, 9], 2.0 * flow[j, 10], 2.0 * flow[j, 11]))


@compiled
def _times_coriolis(flow: Floats, j: int, S: Spatial) -> Spatial:
    """2 B' S; its linear part is zero."""
    G, trace, a = flow, flow[j, 0] + flow[j, 4] + flow[j, 8], S[0]
    turned = (
        trace * a[0] - G[j, 0] * a[0] - G[j, 3] * a[1] - G[j, 6] * a[2],
        trace * a[1] - G[j, 1] * a[0] - G[j, 4] * a[1] - G[j, 7] * a[2],
        trace * a[2] - G[j, 2] * a[0] - G[j, 5] * a[1] - G[j, 8] * a[2],
    )
    left = _sum(turned, _cross((flow[j, 9], flow[j, 10], flow[j, 11]), S[1]))
    return _times(2.0, left), (0.0, 0.0, 0.0)


@compiled
def _to_base(link: Floats, j: int, R: Floats, p: Floats, out: Floats) -> None:
    """Ten parameters of link j, whose frame lies at (R, p), in the base frame; as `kernels._attach`."""
    m = link[j, 0]
    mc = (
        R[0, 0] * link[j, 1] + R[0, 1] * link[j, 2] + R[0, 2] * link[j, 3],
        R[1, 0] * link[j, 1] + R[1, 1] * link[j, 2] + R[1, 2] * link[j, 3],
        R[2, 0] * link[j, 1] + R[2, 1] * link[j, 2] + R[2, 2] * link[j, 3],
    )
    dot = 0.0
    out[j, 0] = m
    for a in range(3):
        out[j, 1 + a] = mc[a] + m * p[a]
        dot += p[a] * (2.0 * mc[a] + m * p[a])
    column = _XX
    for a in range(3):
        x = R[a, 0] * link[j, _XX] + R[a, 1] * link[j, _XY] + R[a, 2] * link[j, _XZ]
        y = R[a, 0] * link[j, _XY] + R[a, 1] * link[j, _YY] + R[a, 2] * link[j, _YZ]
        z = R[a, 0] * link[j, _XZ] + R[a, 1] * link[j, _YZ] + R[a, 2] * link[j, _ZZ]
        for b in range(a, 3):
            value = x * R[b, 0] + y * R[b, 1] + z * R[b, 2] - p[a] * mc[b] - mc[a] * p[b] - m * p[a] * p[b]
            out[j, column] = value + (dot if a == b else 0.0)
            column += 1


@compiled
def _set_flow(body: Floats, j: int, v: Spatial, flow: Floats) -> None:
    """Fills G = u h' + [w] (integral of rho r r') and P = m u + w x h of the body in row j that moves with v."""
    w, u = v
    h = (body[j, 1], body[j, 2], body[j, 3])
    half = (body[j, _XX] + body[j, _YY] + body[j, _ZZ]) / 2
    columns = (
        (half - body[j, _XX], -body[j, _XY], -body[j, _XZ]),
        (-body[j, _XY], half - body[j, _YY], -body[j, _YZ]),
        (-body[j, _XZ], -body[j, _YZ], half - body[j, _ZZ]),
    )
    for b in range(3):
        flow[j, b], flow[j, 3 + b], flow[j, 6 + b] = _sum(_times(h[b], u), _cross(w, columns[b]))
    flow[j, 9], flow[j, 10], flow[j, 11] = _sum(_times(body[j, 0], u), _cross(w, h))


@compiled
def _outward(chain: Chain, link: Floats, q: Floats, qd: Floats, qdd: Floats, x: Bodies) -> None:
    """Screws, motions and single bodies from the base to the tool."""
    place(chain.R0, chain.p0, chain.prismatic, q, x.R, x.p)
    nought = (0.0, 0.0, 0.0)
    v = (nought, nought)
    acceleration = (nought, (-chain.gravity[0], -chain.gravity[1], -chain.gravity[2]))
    R, p, frame = np.eye(3), np.zeros(3), np.empty((3, 3))
    for j in range(len(q)):
        for r in range(3):
            p[r] += R[r, 0] * x.p[j, 0] + R[r, 1] * x.p[j, 1] + R[r, 2] * x.p[j, 2]
            for c in range(3):
                frame[r, c] = R[r, 0] * x.R[j, 0, c] + R[r, 1] * x.R[j, 1, c] + R[r, 2] * x.R[j, 2, c]
        R, frame = frame, R
        axis = (R[0, 2], R[1, 2], R[2, 2])
        S = (nought, axis) if chain.prismatic[j] else (axis, _cross((p[0], p[1], p[2]), axis))
        dS = _turn_motion(v, S)
        _put(x.S, j, S)
        _put(x.dS, j, dS)
        _put(x.ddS, j, _both(_turn_motion(acceleration, S), _turn_motion(v, dS)))
        v = _sum(v[0], _times(qd[j], S[0])), _sum(v[1], _times(qd[j], S[1]))
        acceleration = (
            _sum(acceleration[0], _sum(_times(qdd[j], S[0]), _times(qd[j], dS[0]))),
            _sum(acceleration[1], _sum(_times(qdd[j], S[1]), _times(qd[j], dS[1]))),
        )
        _to_base(link, j, R, p, x.inertia)
        _set_flow(x.inertia, j, v, x.flow)
        force = _inertia_times(x.inertia, j, acceleration)
        _put(x.force, j, _both(force, _turn_wrench(v, _inertia_times(x.inertia, j, v))))


@compiled
def inverse_dynamics_derivatives(
    chain: Chain, link: Floats, q: Floats, qd: Floats, qdd: Floats, x: Bodies, M: Floats, by_q: Floats, by_qd: Floats
) -> None:
    """Fills M(q), d tau/dq at constant qdd, and d tau/dqd of the links, shape (J, J) each.

    Args:
        x: Scratch.
    """
    _outward(chain, link, q, qd, qdd, x)
    for i in range(len(q) - 1, -1, -1):
        S, dS = _at(x.S, i), _at(x.dS, i)
        IS, left = _inertia_times(x.inertia, i, S), _times_coriolis(x.flow, i, S)
        turned = _both(_coriolis_times(x.flow, i, dS[0]), _turn_wrench(S, _at(x.force, i)))
        forward = _both(_inertia_times(x.inertia, i, _at(x.ddS, i)), turned)  # on joints before i, by q_i
        I_dS = _inertia_times(x.inertia, i, dS)
        rate = _both(_coriolis_times(x.flow, i, S[0]), _both(I_dS, I_dS))  # and by qd_i
        for j in range(i + 1):
            M[i, j] = _dot(IS, x.S, j)
            M[j, i] = M[i, j]
            by_q[j, i] = _dot(forward, x.S, j)
            by_qd[j, i] = _dot(rate, x.S, j)
            by_q[i, j] = _dot(left, x.dS, j) + _dot(IS, x.ddS, j)
            by_qd[i, j] = _dot(left, x.S, j) + 2.0 * _dot(IS, x.dS, j)
        if i > 0:
            for c in range(10):
                x.inertia[i - 1, c] += x.inertia[i, c]
            for c in range(12):
                x.flow[i - 1, c] += x.flow[i, c]
            for c in range(6):
                x.force[i - 1, c] += x.force[i, c]
