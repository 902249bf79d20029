"""Motions of one session of a blind trial: two multisines, one of slow reversals, and one that stays unseen.

Each is repeated, so that what returns with the motion can be told from noise. Drawn at random within the limits that
a user would keep to: planned with the nominal robot.
"""

from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, rnea
from protocols.motion import Fourier, Motion, Points, Reference, sample
from protocols.robot import Robot, geometry

PERIODS = 3
APPROACH_S = 2.0
HARMONICS = 10
POSITION_SHARE, SPEED_SHARE, CURRENT_SHARE = 0.8, 0.7, 0.6  # of each limit, at most
STROKE = 0.035  # of the range, either side: slow reversals
STROKE_S, TRAVEL_S = 0.9, 1.6
STROKES, PLACES = 4, 2
CHECK_S = 0.01


class Planned(NamedTuple):
    """A motion and how long one repetition of it takes [s]."""

    motion: Motion
    period_s: float


def session(robot: Robot, rng: np.random.Generator, period_s: float) -> list[Planned]:
    """Three training motions and the unseen one, which comes last."""
    return [
        _multisine(robot, rng, "multisine-1", period_s),
        _multisine(robot, rng, "multisine-2", period_s),
        _slow_reversals(robot, rng),
        _multisine(robot, rng, "unseen", period_s),
    ]


def once(planned: Planned) -> Motion:
    """The motion without its repetitions, for a quick look at what an effect changes."""
    segment = planned.motion.segment[0]
    if isinstance(segment, Fourier):
        short = Fourier(
            base_Hz=segment.base_Hz,
            centre_rad=segment.centre_rad,
            sine_rad=segment.sine_rad,
            cosine_rad=segment.cosine_rad,
        )
        return Motion(name=planned.motion.name, approach_s=APPROACH_S, segment=[short])
    points = segment.point_rad[: (len(segment.point_rad) - 1) // PERIODS + 1]  # type: ignore[union-attr]
    moves = segment.move_s[: len(points) - 1]  # type: ignore[union-attr]
    return Motion(name=planned.motion.name, approach_s=APPROACH_S, segment=[Points(point_rad=points, move_s=moves)])


def _multisine(robot: Robot, rng: np.random.Generator, name: str, period_s: float) -> Planned:
    low = np.array([joint.position_min_rad for joint in robot.joint])
    high = np.array([joint.position_max_rad for joint in robot.joint])
    J, order = robot.joints, np.arange(1, HARMONICS + 1)
    middle, reach = (low + high) / 2, (high - low) / 2
    # White speeds over the lowest harmonics excite friction at all speeds; amplitudes fall as 1/k.
    parts = rng.normal(size=(2, J, HARMONICS)) / order
    centre = middle + 0.1 * reach * rng.uniform(-1, 1, J)

    def motion(scale: Floats) -> Motion:
        sine, cosine = (np.round(scale[:, None] * part, 6).tolist() for part in parts)
        segment = Fourier(
            base_Hz=1 / period_s,
            periods=PERIODS,
            centre_rad=np.round(centre, 6).tolist(),
            sine_rad=sine,
            cosine_rad=cosine,
        )
        return Motion(name=name, approach_s=APPROACH_S, segment=[segment])

    w, t = 2 * np.pi / period_s, np.arange(0, period_s, CHECK_S)
    phase = np.outer(t, w * order)
    position = np.sin(phase) @ parts[0].T + np.cos(phase) @ parts[1].T
    speed = (np.cos(phase) * w * order) @ parts[0].T - (np.sin(phase) * w * order) @ parts[1].T
    fastest = np.array([joint.velocity_max_rad_s for joint in robot.joint])
    scale = np.minimum(
        (POSITION_SHARE * reach - np.abs(centre - middle)) / np.abs(position).max(axis=0),
        SPEED_SHARE * fastest / np.abs(speed).max(axis=0),
    ) * rng.uniform(0.6, 1.0, J)
    for _ in range(20):
        share = _current_share(robot, sample(motion(scale), robot, CHECK_S))
        if share <= CURRENT_SHARE:
            break
        scale *= 0.9
    return Planned(motion(scale), period_s)


def _slow_reversals(robot: Robot, rng: np.random.Generator) -> Planned:
    """Small strokes about some places, all joints at once, each in a rhythm of its own."""
    low = np.array([joint.position_min_rad for joint in robot.joint])
    high = np.array([joint.position_max_rad for joint in robot.joint])
    middle, reach = (low + high) / 2, high - low
    points, moves = [], []
    for _ in range(PLACES):
        place = middle + 0.25 * reach * rng.uniform(-1, 1, robot.joints)
        points.append(place)
        moves.append(TRAVEL_S)
        side = rng.choice([-1.0, 1.0], robot.joints)
        for _ in range(STROKES):
            points.append(place + STROKE * reach * side * rng.uniform(0.4, 1.0, robot.joints))
            moves.append(STROKE_S)
            side = -side
    rows = np.round(np.array(points * PERIODS + points[:1]), 6).tolist()
    segment = Points(point_rad=rows, move_s=(moves[1:] + moves[:1]) * PERIODS)
    return Planned(Motion(name="slow-reversals", approach_s=APPROACH_S, segment=[segment]), sum(moves))


def _current_share(robot: Robot, reference: Reference) -> float:
    """Largest nominal current along a motion, over its limit."""
    chain, C = geometry(robot), robot.coupling_matrix()
    parameters = [joint.parameters for joint in robot.joint]
    link = np.array([p.inertial() for p in parameters])
    rotor = np.array([p.rotor_inertia_kgm2 for p in parameters])
    viscous = np.array([p.viscous_Nms_rad + p.motor_viscous_Nms_rad for p in parameters])
    dry = np.array([p.coulomb_Nm + p.motor_coulomb_Nm for p in parameters])
    rows = zip(reference.q, reference.qd, reference.qdd, strict=True)
    rigid = np.array(
        [rnea(chain.R0, chain.p0, chain.prismatic, chain.gravity, link, q, qd, qdd) for q, qd, qdd in rows]
    )
    tau = rigid + ((reference.qdd @ C.T) * rotor) @ C + reference.qd * viscous + np.sign(reference.qd) * dry
    limit = np.array([joint.drive.max_current_A for joint in robot.joint])
    return float((np.abs(robot.drive_current(tau)) / limit).max())
