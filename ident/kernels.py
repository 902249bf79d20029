"""Regressor of a serial chain, compiled: torque = regressor x standard inertial parameters.

Written for identification alone and independently of the emulator's dynamics; both are checked against pinocchio.
Linear in the ten parameters of a link, so it also serves parameters that no body could have (masses of zero).
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocols.robot import Geometry

Array = NDArray[np.float64]


def inertial_regressor(geometry: Geometry, q: Array, qd: Array, qdd: Array, out: Array | None = None) -> Array:
    """Columns of the 10 J inertial parameters, rigid bodies under gravity.

    Args:
        q, qd, qdd: shape (T, J) [rad, rad/s, rad/s²].
        out: Where to write, shape (J, T, 10 J) or more columns, zero where this function leaves zeros.

    Returns:
        shape (J, T, 10 J): joint first (the rows of one joint are the sub-system of Janot et al. 2014, eq. (5)), then
        sample, then parameter in the order of `protocols.robot.INERTIAL` link by link. Joint i's entries for links
        before i are zero.
    """
    samples, joints = q.shape
    out = np.zeros((joints, samples, 10 * joints)) if out is None else out
    _fill(
        geometry.R0,
        geometry.p0,
        geometry.prismatic,
        geometry.gravity,
        np.ascontiguousarray(q),
        np.ascontiguousarray(qd),
        np.ascontiguousarray(qdd),
        out,
    )
    return out


@njit(cache=True)
def _fill(  # noqa: PLR0912, PLR0915  (one straight recursion: calls between pieces cost more than the work)
    R0: Array,
    p0: Array,
    prismatic: NDArray[np.int64],
    gravity: Array,
    q: Array,
    qd: Array,
    qdd: Array,
    out: Array,
) -> None:
    """Newton-Euler forward recursion in link frames; the screw of every earlier joint is carried along.

    The torque of joint i due to link k is s·n + u·f, with (f, n) the wrench that moves link k, at the origin of frame
    k, s the axis of joint i and u its linear velocity there per unit of joint speed. With the acceleration a of the
    origin (less gravity), angular velocity w and acceleration dw, the wrench is linear in m, h = m c and I:
    f = m a + dw x h + w x (w x h),  n = h x a + I dw + w x (I w).
    """
    samples, joints = q.shape
    s = np.empty((joints, 3))
    u = np.empty((joints, 3))
    R = np.empty((3, 3))
    p = np.empty(3)
    x = np.empty(3)
    y = np.empty(3)
    B = np.empty((3, 3))
    for t in range(samples):
        w0, w1, w2 = 0.0, 0.0, 0.0
        d0, d1, d2 = 0.0, 0.0, 0.0
        a0, a1, a2 = -gravity[0], -gravity[1], -gravity[2]
        for k in range(joints):
            # placement of frame k in frame k-1
            if prismatic[k] == 1:
                for r in range(3):
                    for c in range(3):
                        R[r, c] = R0[k, r, c]
                    p[r] = p0[k, r] + R0[k, r, 2] * q[t, k]
            else:
                ct, st = np.cos(q[t, k]), np.sin(q[t, k])
                for r in range(3):
                    R[r, 0] = R0[k, r, 0] * ct + R0[k, r, 1] * st
                    R[r, 1] = R0[k, r, 1] * ct - R0[k, r, 0] * st
                    R[r, 2] = R0[k, r, 2]
                    p[r] = p0[k, r]
            # acceleration of the new origin as a point of link k-1: a + dw x p + w x (w x p)
            x[0], x[1], x[2] = w1 * p[2] - w2 * p[1], w2 * p[0] - w0 * p[2], w0 * p[1] - w1 * p[0]
            y[0] = a0 + d1 * p[2] - d2 * p[1] + w1 * x[2] - w2 * x[1]
            y[1] = a1 + d2 * p[0] - d0 * p[2] + w2 * x[0] - w0 * x[2]
            y[2] = a2 + d0 * p[1] - d1 * p[0] + w0 * x[1] - w1 * x[0]
            a0 = R[0, 0] * y[0] + R[1, 0] * y[1] + R[2, 0] * y[2]
            a1 = R[0, 1] * y[0] + R[1, 1] * y[1] + R[2, 1] * y[2]
            a2 = R[0, 2] * y[0] + R[1, 2] * y[1] + R[2, 2] * y[2]
            x[0] = R[0, 0] * w0 + R[1, 0] * w1 + R[2, 0] * w2
            x[1] = R[0, 1] * w0 + R[1, 1] * w1 + R[2, 1] * w2
            x[2] = R[0, 2] * w0 + R[1, 2] * w1 + R[2, 2] * w2
            y[0] = R[0, 0] * d0 + R[1, 0] * d1 + R[2, 0] * d2
            y[1] = R[0, 1] * d0 + R[1, 1] * d1 + R[2, 1] * d2
            y[2] = R[0, 2] * d0 + R[1, 2] * d1 + R[2, 2] * d2
            w0, w1, w2 = x[0], x[1], x[2]
            d0, d1, d2 = y[0], y[1], y[2]
            v, dv = qd[t, k], qdd[t, k]
            if prismatic[k] == 1:  # along z: Coriolis 2 w x z v
                a0 += 2.0 * w1 * v
                a1 -= 2.0 * w0 * v
                a2 += dv
            else:
                d0 += w1 * v
                d1 -= w0 * v
                d2 += dv
                w2 += v
            # screws of the earlier joints, now at origin k and in frame k
            for i in range(k):
                x[0], x[1], x[2] = s[i, 0], s[i, 1], s[i, 2]
                y[0] = u[i, 0] + x[1] * p[2] - x[2] * p[1]
                y[1] = u[i, 1] + x[2] * p[0] - x[0] * p[2]
                y[2] = u[i, 2] + x[0] * p[1] - x[1] * p[0]
                for c in range(3):
                    s[i, c] = R[0, c] * x[0] + R[1, c] * x[1] + R[2, c] * x[2]
                    u[i, c] = R[0, c] * y[0] + R[1, c] * y[1] + R[2, c] * y[2]
            for c in range(3):
                s[k, c] = 0.0
                u[k, c] = 0.0
            if prismatic[k] == 1:
                u[k, 2] = 1.0
            else:
                s[k, 2] = 1.0
            # dw x h + w x (w x h) = B h
            B[0, 0], B[0, 1], B[0, 2] = -w1 * w1 - w2 * w2, w0 * w1 - d2, w0 * w2 + d1
            B[1, 0], B[1, 1], B[1, 2] = w0 * w1 + d2, -w0 * w0 - w2 * w2, w1 * w2 - d0
            B[2, 0], B[2, 1], B[2, 2] = w0 * w2 - d1, w1 * w2 + d0, -w0 * w0 - w1 * w1
            o = 10 * k
            for i in range(k + 1):
                s0, s1, s2 = s[i, 0], s[i, 1], s[i, 2]
                u0, u1, u2 = u[i, 0], u[i, 1], u[i, 2]
                # s·(w x I w) = t·(I w) with t = s x w
                t0, t1, t2 = s1 * w2 - s2 * w1, s2 * w0 - s0 * w2, s0 * w1 - s1 * w0
                out[i, t, o] = u0 * a0 + u1 * a1 + u2 * a2
                out[i, t, o + 1] = u0 * B[0, 0] + u1 * B[1, 0] + u2 * B[2, 0] + a1 * s2 - a2 * s1
                out[i, t, o + 2] = u0 * B[0, 1] + u1 * B[1, 1] + u2 * B[2, 1] + a2 * s0 - a0 * s2
                out[i, t, o + 3] = u0 * B[0, 2] + u1 * B[1, 2] + u2 * B[2, 2] + a0 * s1 - a1 * s0
                out[i, t, o + 4] = s0 * d0 + t0 * w0
                out[i, t, o + 5] = s0 * d1 + s1 * d0 + t0 * w1 + t1 * w0
                out[i, t, o + 6] = s0 * d2 + s2 * d0 + t0 * w2 + t2 * w0
                out[i, t, o + 7] = s1 * d1 + t1 * w1
                out[i, t, o + 8] = s1 * d2 + s2 * d1 + t1 * w2 + t2 * w1
                out[i, t, o + 9] = s2 * d2 + t2 * w2
