"""A base that gives way: coordinates before the first joint.

An arm rocks about two horizontal axes `height_m` below its base; a machine of prismatic axes alone slides along its
first one. The base's coordinates are joints of the same chain, so all inertial coupling comes from the same kernels.
"""

from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, Ints, bias, composite_inertia, place
from protocols.robot import Geometry, Parameters


class Base(NamedTuple):
    """Constants of the base's coordinates, shape (B,); none where the base is rigid."""

    stiffness: Floats
    damping: Floats


class Chain(NamedTuple):
    """Arrays of `protocols.robot.Geometry` and links, base included."""

    R0: Floats
    p0: Floats
    prismatic: Ints
    gravity: Floats
    link: Floats


def rigid(geometry: Geometry, link: Floats) -> tuple[Chain, Base]:
    """The chain as it is."""
    return Chain(geometry.R0, geometry.p0, geometry.prismatic, geometry.gravity, link), Base(np.empty(0), np.empty(0))


def flexible(
    geometry: Geometry,
    link: Floats,
    q: Floats,
    frequency_Hz: float,
    damping: float,
    inertia: float,
    height_m: float,
) -> tuple[Chain, Base]:
    """The chain on its base.

    Args:
        q: Where the natural frequency holds.
        inertia: Of the base itself [kg·m², or kg].
    """
    slides = bool(geometry.prismatic.all())
    if slides:
        # Frame 0' has its z along the first axis; the arm's first frame then only keeps its own turn.
        axis = geometry.R0[:1].copy()
        R0 = np.concatenate([axis, [np.eye(3)], geometry.R0[1:]])
        p0 = np.concatenate([np.zeros((1, 3)), [geometry.p0[0] @ geometry.R0[0]], geometry.p0[1:]])
        own = [Parameters(mass_kg=inertia).inertial()]
    else:
        to_x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # columns y, z, x: z' along x
        to_y = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # columns z, x, y: z'' along y
        at = np.array([0.0, 0.0, height_m]) + geometry.p0[0]
        R0 = np.concatenate([[to_x], [to_x.T @ to_y], [to_y.T @ geometry.R0[0]], geometry.R0[1:]])
        p0 = np.concatenate([[[0.0, 0.0, -height_m], [0.0, 0.0, 0.0], to_y.T @ at], geometry.p0[1:]])
        solid = Parameters(inertia_kgm2=(inertia, 0.0, 0.0, inertia, 0.0, inertia)).inertial()
        own = [np.zeros(10), solid]
    B = len(own)
    prismatic = np.concatenate([np.full(B, int(slides), dtype=np.int64), geometry.prismatic])
    chain = Chain(
        np.ascontiguousarray(R0), np.ascontiguousarray(p0), prismatic, geometry.gravity, np.concatenate([own, link])
    )
    n = len(chain.p0)
    R, p, M, whole = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, n)), np.empty((n, 10))
    place(chain.R0, chain.p0, chain.prismatic, np.concatenate([np.zeros(B), q]), R, p)
    composite_inertia(R, p, chain.prismatic, chain.link, M, whole)
    moving = M[:B, :B].diagonal()
    w = 2 * np.pi * frequency_Hz
    return chain, Base(w**2 * moving, 2 * damping * w * moving)


def at_rest(chain: Chain, base: Base, q: Floats) -> Floats:
    """Deflection under the arm's own weight, shape (B,): Newton from the undeflected base."""
    B = len(base.stiffness)
    x = np.concatenate([np.zeros(B), q])
    for _ in range(20):
        weight = bias(chain.R0, chain.p0, chain.prismatic, chain.gravity, chain.link, x, np.zeros(len(x)))[:B]
        x[:B] -= (weight + base.stiffness * x[:B]) / base.stiffness
    return x[:B].copy()
