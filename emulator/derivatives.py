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
from emulator.kernels import Floats, compiled, place

_XX, _XY, _XZ, _YY, _YZ, _ZZ = 4, 5, 6, 7, 8, 9  # columns of a row of inertial parameters


class Bodies(NamedTuple):
    """Scratch, one row per joint: its screw and rates, and its link together with all links after it.

    Vectors of six hold the angular part first; the linear part is that at the base origin.

    Attributes:
        S: Screw of the joint.
        dS: Its rate by the speed of the link before it.
        ddS: Its rate by that link's acceleration, and of dS by its speed.
        inertia: The ten parameters in the base frame.
        momentum, G: P and G of the module, shape (J, 3) and (J, 3, 3).
        force: Moment about the base origin, and force.
    """

    R: Floats
    p: Floats
    S: Floats
    dS: Floats
    ddS: Floats
    inertia: Floats
    momentum: Floats
    G: Floats
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
        np.empty((J, 3)),
        np.empty((J, 3, 3)),
        np.empty((J, 6)),
    )


@compiled
def _add_cross(a: Floats, b: Floats, out: Floats) -> None:
    """out += a x b."""
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]


@compiled
def _add_motion_cross(v: Floats, m: Floats, out: Floats) -> None:
    """out += v x m, the rate of a screw m that moves with v."""
    _add_cross(v[:3], m[:3], out[:3])
    _add_cross(v[:3], m[3:], out[3:])
    _add_cross(v[3:], m[:3], out[3:])


@compiled
def _add_force_cross(v: Floats, f: Floats, out: Floats) -> None:
    """out += v x* f, the rate of a wrench f that moves with v."""
    _add_cross(v[:3], f[:3], out[:3])
    _add_cross(v[3:], f[3:], out[:3])
    _add_cross(v[:3], f[3:], out[3:])


@compiled
def _add_inertia_times(body: Floats, m: Floats, out: Floats) -> None:
    """out += I m, the wrench of a motion m."""
    out[0] += body[_XX] * m[0] + body[_XY] * m[1] + body[_XZ] * m[2]
    out[1] += body[_XY] * m[0] + body[_YY] * m[1] + body[_YZ] * m[2]
    out[2] += body[_XZ] * m[0] + body[_YZ] * m[1] + body[_ZZ] * m[2]
    _add_cross(body[1:4], m[3:], out[:3])
    _add_cross(m[:3], body[1:4], out[3:])
    for i in range(3):
        out[3 + i] += body[0] * m[3 + i]


@compiled
def _to_base(link: Floats, R: Floats, p: Floats, out: Floats) -> None:
    """Ten parameters of a link whose frame lies at (R, p), in the base frame."""
    m = link[0]
    out[0] = m
    mc = np.empty(3)
    for a in range(3):
        mc[a] = R[a, 0] * link[1] + R[a, 1] * link[2] + R[a, 2] * link[3]
        out[1 + a] = mc[a] + m * p[a]
    dot = 0.0
    for a in range(3):
        dot += p[a] * (2.0 * mc[a] + m * p[a])
    column = _XX
    for a in range(3):
        x = R[a, 0] * link[_XX] + R[a, 1] * link[_XY] + R[a, 2] * link[_XZ]
        y = R[a, 0] * link[_XY] + R[a, 1] * link[_YY] + R[a, 2] * link[_YZ]
        z = R[a, 0] * link[_XZ] + R[a, 1] * link[_YZ] + R[a, 2] * link[_ZZ]
        for b in range(a, 3):
            out[column] = x * R[b, 0] + y * R[b, 1] + z * R[b, 2] - p[a] * mc[b] - mc[a] * p[b] - m * p[a] * p[b]
            if a == b:
                out[column] += dot
            column += 1


@compiled
def _flow(body: Floats, v: Floats, momentum: Floats, G: Floats) -> None:
    """Fills P and G of a body in the base frame that moves with v."""
    w, h = v[:3], body[1:4]
    for i in range(3):
        momentum[i] = body[0] * v[3 + i]
    _add_cross(w, h, momentum)
    half = (body[_XX] + body[_YY] + body[_ZZ]) / 2
    second = np.empty(3)  # a column of the integral of rho r r'
    for b in range(3):
        for a in range(3):
            low, high = min(a, b), max(a, b)
            second[a] = -body[_XX + low * (5 - low) // 2 + high]
            G[a, b] = v[3 + a] * h[b]
        second[b] += half
        _add_cross(w, second, G[:, b])


@compiled
def _outward(chain: Chain, link: Floats, q: Floats, qd: Floats, qdd: Floats, x: Bodies) -> None:
    """Screws, motions and single bodies from the base to the tool."""
    J = len(q)
    place(chain.R0, chain.p0, chain.prismatic, q, x.R, x.p)
    v, a, Iv = np.zeros(6), np.zeros(6), np.empty(6)
    R, p, frame = np.eye(3), np.zeros(3), np.empty((3, 3))
    a[3:] = -chain.gravity
    for j in range(J):
        for r in range(3):
            for c in range(3):
                frame[r, c] = R[r, 0] * x.R[j, 0, c] + R[r, 1] * x.R[j, 1, c] + R[r, 2] * x.R[j, 2, c]
            p[r] += R[r, 0] * x.p[j, 0] + R[r, 1] * x.p[j, 1] + R[r, 2] * x.p[j, 2]
        R[:, :] = frame
        S, dS, ddS = x.S[j], x.dS[j], x.ddS[j]
        S[:] = 0.0
        dS[:] = 0.0
        ddS[:] = 0.0
        if chain.prismatic[j]:
            S[3:] = R[:, 2]
        else:
            S[:3] = R[:, 2]
            _add_cross(p, S[:3], S[3:])
        _add_motion_cross(v, S, dS)
        _add_motion_cross(a, S, ddS)
        _add_motion_cross(v, dS, ddS)
        for i in range(6):
            v[i] += S[i] * qd[j]
            a[i] += S[i] * qdd[j] + dS[i] * qd[j]
        _to_base(link[j], R, p, x.inertia[j])
        _flow(x.inertia[j], v, x.momentum[j], x.G[j])
        Iv[:] = 0.0
        _add_inertia_times(x.inertia[j], v, Iv)
        x.force[j, :] = 0.0
        _add_inertia_times(x.inertia[j], a, x.force[j])
        _add_force_cross(v, Iv, x.force[j])


@compiled
def _dot(a: Floats, b: Floats) -> float:
    value = 0.0
    for i in range(len(a)):
        value += a[i] * b[i]
    return value


@compiled
def inverse_dynamics_derivatives(
    chain: Chain, link: Floats, q: Floats, qd: Floats, qdd: Floats, x: Bodies, M: Floats, by_q: Floats, by_qd: Floats
) -> None:
    """Fills M(q), d tau/dq at constant qdd, and d tau/dqd of the links, shape (J, J) each.

    Args:
        x: Scratch.
    """
    J = len(q)
    _outward(chain, link, q, qd, qdd, x)
    IS, left, forward, rate = np.empty(6), np.empty(3), np.empty(6), np.empty(6)
    for i in range(J - 1, -1, -1):
        S, dS, G = x.S[i], x.dS[i], x.G[i]
        trace = G[0, 0] + G[1, 1] + G[2, 2]
        IS[:] = 0.0
        _add_inertia_times(x.inertia[i], S, IS)
        left[:] = 0.0  # angular part of 2 B' S; the linear part is zero
        _add_cross(x.momentum[i], S[3:], left)
        forward[:] = 0.0  # torque on earlier joints by q_i
        rate[:] = 0.0  # and by qd_i
        _add_inertia_times(x.inertia[i], x.ddS[i], forward)
        _add_force_cross(S, x.force[i], forward)
        _add_inertia_times(x.inertia[i], dS, rate)
        for a in range(3):
            turned, by, spun = 0.0, 0.0, 0.0
            for b in range(3):
                turned += G[b, a] * S[b]
                by += G[a, b] * dS[b]
                spun += G[a, b] * S[b]
            left[a] = 2.0 * (left[a] + trace * S[a] - turned)
            forward[a] += 2.0 * (trace * dS[a] - by)
            rate[a] = 2.0 * (rate[a] + trace * S[a] - spun)
            rate[3 + a] = 2.0 * rate[3 + a]
        twice = 2.0 * x.momentum[i]
        _add_cross(dS[:3], twice, forward[3:])
        _add_cross(S[:3], twice, rate[3:])
        for j in range(i + 1):
            M[i, j] = _dot(IS, x.S[j])
            M[j, i] = M[i, j]
            by_q[j, i] = _dot(forward, x.S[j])
            by_qd[j, i] = _dot(rate, x.S[j])
            by_q[i, j] = _dot(left, x.dS[j, :3]) + _dot(IS, x.ddS[j])
            by_qd[i, j] = _dot(left, x.S[j, :3]) + 2.0 * _dot(IS, x.dS[j])
        if i > 0:
            x.inertia[i - 1] += x.inertia[i]
            x.momentum[i - 1] += x.momentum[i]
            x.G[i - 1] += G
            x.force[i - 1] += x.force[i]
