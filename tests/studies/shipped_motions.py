"""Writes the motions in protocols/library by a seeded random search.

    python tests/studies/shipped_motions.py [NAME ...]

Each candidate is drawn at random, stretched until a joint's range, speed, torque or current is nearly used up, and
judged by the condition number of the base regressor with columns scaled to equal length (Gautier & Khalil 1992),
times one plus the share of time in which a joint hardly moves: there stiction hides what Coulomb friction is.
Training motions are periodic Fourier series, test motions fifth-order polynomials between random points: a model
that fits the one and predicts the other has not learnt the trajectory. Planned with the nominal robot, as a user
would.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
from layout import one_line_arrays
from numpy.typing import NDArray
from scipy.linalg import qr

from emulator.kernels import place, rnea
from protocols import config
from protocols.errors import ConfigError
from protocols.motion import Fourier, Motion, Points, Reference, sample
from protocols.robot import Robot, geometry, load

Floats = NDArray[np.float64]

LIBRARY = Path(__file__).parents[2] / "protocols" / "library"
CHECK_S = 0.01  # grid on which limits are checked
REGRESSOR_S = 0.05  # grid of the regressor: 20 rows per second are beyond what rigid motion varies
POSITION_SHARE, SPEED_SHARE, TORQUE_SHARE, CURRENT_SHARE = 0.9, 0.9, 0.7, 0.75  # of each limit
SLOW_SHARE, SLOW_WEIGHT = 0.04, 5.0
FLOOR_M, COLUMN_M = -0.2, 0.2  # the TX40's wrist stays above the one and, below the shoulder, outside the other


def torques(robot: Robot, reference: Reference) -> Floats:
    """Nominal joint torques with friction along a motion, shape (T, J) [N·m]."""
    chain, C = geometry(robot), robot.coupling_matrix()
    parameters = [joint.parameters for joint in robot.joint]
    link = np.array([p.inertial() for p in parameters])
    rigid = [
        rnea(chain.R0, chain.p0, chain.prismatic, chain.gravity, link, q, qd, qdd)
        for q, qd, qdd in zip(reference.q, reference.qd, reference.qdd, strict=True)
    ]
    per_axis = np.array(
        [
            (p.rotor_inertia_kgm2, p.motor_viscous_Nms_rad, p.motor_coulomb_Nm, p.viscous_Nms_rad, p.coulomb_Nm)
            for p in parameters
        ]
    ).T
    Ia, fvm, fcm, fv, fc = per_axis
    turning = reference.qd @ C.T
    motor = (reference.qdd @ C.T) * Ia + turning * fvm + np.sign(turning) * fcm
    return np.array(rigid) + motor @ C + reference.qd * fv + np.sign(reference.qd) * fc


def regressor(robot: Robot, reference: Reference) -> Floats:
    """Columns of all standard parameters, rotors, frictions and offsets, rows sample-major, shape (T J, 16 J)."""
    chain, C, J = geometry(robot), robot.coupling_matrix(), robot.joints
    W = np.zeros((len(reference.t_s), J, 16 * J))
    for k, (q, qd, qdd) in enumerate(zip(reference.q, reference.qd, reference.qdd, strict=True)):
        for column in range(10 * J):
            link = np.zeros((J, 10))
            link[column // 10, column % 10] = 1.0
            W[k, :, column] = rnea(chain.R0, chain.p0, chain.prismatic, chain.gravity, link, q, qd, qdd)
        turning = C @ qd
        axes = [C.T * (C @ qdd), np.diag(qd), np.diag(np.sign(qd)), C.T * turning, C.T * np.sign(turning), np.eye(J)]
        W[k, :, 10 * J :] = np.hstack(axes)
    return W.reshape(-1, 16 * J)


def independent_columns(robot: Robot, rng: np.random.Generator) -> NDArray[np.int64]:
    """Columns of a base, by pivoted QR of the regressor at random states."""
    J = robot.joints
    states = rng.normal(size=(3, 20 * J, J)) * np.array([1.0, 1.0, 5.0])[:, None, None]
    W = regressor(robot, Reference(np.zeros(20 * J), *states))
    _, R, pivot = qr(W, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    return np.sort(pivot[: len(size)][size > 1e-9 * size[0]])


def slow_share(robot: Robot, motion: Motion) -> float:
    """Share of the time in which a joint that is on its way is below SLOW_SHARE of its speed limit, mean of all."""
    speed = np.abs(sample(motion, robot, CHECK_S).qd) / [joint.velocity_max_rad_s for joint in robot.joint]
    moving = speed.max(axis=1) > SLOW_SHARE
    return float(np.mean(speed[moving] < SLOW_SHARE))


def condition(robot: Robot, motion: Motion, columns: NDArray[np.int64]) -> float:
    """Condition number of the base regressor, columns of unit length, rows in shares of the axis' torque."""
    W = regressor(robot, sample(motion, robot, REGRESSOR_S))[:, columns]
    W /= np.tile([joint.torque_max_Nm for joint in robot.joint], len(W) // robot.joints)[:, None]
    return float(np.linalg.cond(W / np.linalg.norm(W, axis=0)))


def worst_share(robot: Robot, reference: Reference) -> float:
    """Largest used share of what is allowed, over all joints and kinds of limit; above 1 is forbidden."""
    middle = np.array([(j.position_max_rad + j.position_min_rad) / 2 for j in robot.joint])
    reach = np.array([(j.position_max_rad - j.position_min_rad) / 2 for j in robot.joint])
    tau = torques(robot, reference)
    shares = [
        np.abs(reference.q - middle) / reach / POSITION_SHARE,
        np.abs(reference.qd) / [j.velocity_max_rad_s for j in robot.joint] / SPEED_SHARE,
        np.abs(tau) / [j.torque_max_Nm for j in robot.joint] / TORQUE_SHARE,
        np.abs(robot.drive_current(tau)) / [j.drive.max_current_A for j in robot.joint] / CURRENT_SHARE,
    ]
    return float(max(share.max() for share in shares))


def clear(robot: Robot, reference: Reference) -> bool:
    """Wrist of a six-axis arm above the floor and outside its own column; no model of the arm's surface."""
    if robot.joints != 6:
        return True
    chain, R, p = geometry(robot), np.empty((6, 3, 3)), np.empty((6, 3))
    for q in reference.q[::5]:
        place(chain.R0, chain.p0, chain.prismatic, q, R, p)
        point = np.array([0.0, 0.0, 0.1])  # flange, seen from the wrist
        for j in range(5, -1, -1):
            point = p[j] + R[j] @ point
        if point[2] < FLOOR_M or (point[2] < 0 and np.hypot(point[0], point[1]) < COLUMN_M):
            return False
    return True


# --- candidates ---


def random_fourier(robot: Robot, rng: np.random.Generator, base_Hz: float, harmonics: int, periods: int) -> Motion:
    """Amplitudes of random size and phase, each joint scaled to a random part of its range or speed."""
    J = robot.joints
    k = np.arange(1, harmonics + 1)
    sine, cosine = rng.normal(size=(2, J, harmonics)) / k ** rng.uniform(0.3, 1.2, (J, 1))
    t = np.linspace(0, 1, 200)[:, None] * 2 * np.pi * k
    wave = np.sin(t) @ sine.T + np.cos(t) @ cosine.T
    speed = 2 * np.pi * base_Hz * ((k * np.cos(t)) @ sine.T - (k * np.sin(t)) @ cosine.T)
    low = np.array([joint.position_min_rad for joint in robot.joint])
    high = np.array([joint.position_max_rad for joint in robot.joint])
    fastest = np.array([joint.velocity_max_rad_s for joint in robot.joint])
    scale = np.minimum(
        0.85 * (high - low) / np.ptp(wave, axis=0), SPEED_SHARE * fastest / np.abs(speed).max(axis=0)
    ) * rng.uniform(0.7, 1.0, J)
    centre = (high + low) / 2 - scale * (wave.max(axis=0) + wave.min(axis=0)) / 2
    segment = Fourier(
        base_Hz=base_Hz,
        periods=periods,
        centre_rad=_digits(centre),
        sine_rad=[_digits(row) for row in sine * scale[:, None]],
        cosine_rad=[_digits(row) for row in cosine * scale[:, None]],
    )
    return Motion(name="", segment=[segment])


def random_points(robot: Robot, rng: np.random.Generator, moves: int, dwell_s: float) -> Motion:
    """Uniform points within the range; each move as fast as its slowest joint permits."""
    low = np.array([joint.position_min_rad for joint in robot.joint])
    high = np.array([joint.position_max_rad for joint in robot.joint])
    fastest = np.array([joint.velocity_max_rad_s for joint in robot.joint])
    points = (high + low) / 2 + (high - low) / 2 * rng.uniform(-0.85, 0.85, (moves + 1, robot.joints))
    span = np.abs(np.diff(points, axis=0))
    seconds = (15 / 8 * span / (SPEED_SHARE * fastest)).max(axis=1)  # peak speed of a fifth-order move: 15/8 D/T
    segment = Points(
        point_rad=[_digits(point) for point in points],
        move_s=[float(np.ceil(T / 0.05) * 0.05) for T in seconds],
        dwell_s=dwell_s,
    )
    return Motion(name="", segment=[segment])


def _digits(row: Floats) -> list[float]:
    return [round(float(value), 4) for value in row]


def slower(motion: Motion) -> Motion:
    """The same with smaller amplitudes (series) or longer moves (points)."""
    segment = motion.segment[0]
    if isinstance(segment, Fourier):
        shrink = {
            key: [_digits(0.93 * np.array(row)) for row in getattr(segment, key)] for key in ("sine_rad", "cosine_rad")
        }
        segment = msgspec.structs.replace(segment, **shrink)
    elif isinstance(segment, Points):
        segment = msgspec.structs.replace(segment, move_s=[round(T + 0.05, 3) for T in segment.move_s])
    return msgspec.structs.replace(motion, segment=[segment])


def feasible(robot: Robot, motion: Motion, longest_s: float) -> Motion | None:
    """The candidate, slowed until it keeps all limits."""
    for _ in range(8):
        try:
            reference = sample(motion, robot, CHECK_S)
        except ConfigError:
            motion = slower(motion)
            continue
        if worst_share(robot, reference) <= 1.0:
            return motion if reference.t_s[-1] <= longest_s and clear(robot, reference) else None
        motion = slower(motion)
    return None


def search(
    robot: Robot,
    draw: Callable[[np.random.Generator], Motion],
    longest_s: float,
    candidates: int,
    seed: int,
) -> tuple[Motion, float]:
    """Best of so many feasible candidates, and its condition number."""
    rng = np.random.default_rng(seed)
    columns = independent_columns(robot, rng)
    best, lowest, kept = None, np.inf, 0
    while kept < candidates:
        motion = feasible(robot, draw(rng), longest_s)
        if motion is None:
            continue
        kept += 1
        value = condition(robot, motion, columns) * (1 + SLOW_WEIGHT * slow_share(robot, motion))
        if value < lowest:
            best, lowest = motion, value
    if best is None:
        raise ValueError("at least one candidate is needed")
    return best, condition(robot, best, columns)


SEARCHES: dict[str, tuple[str, Callable[[Robot, np.random.Generator], Motion], float, int, int]] = {
    "tx40-train": ("tx40", lambda robot, rng: random_fourier(robot, rng, 0.125, 10, 2), 21.0, 300, 1),
    "tx40-test": ("tx40", lambda robot, rng: random_points(robot, rng, 7, 0.1), 10.0, 300, 2),
    "emps-train": ("emps", lambda robot, rng: random_fourier(robot, rng, 0.125, 8, 2), 21.0, 100, 3),
    "emps-test": ("emps", lambda robot, rng: random_points(robot, rng, 8, 0.1), 10.0, 100, 4),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes the motions in protocols/library.")
    parser.add_argument("name", nargs="*", help=f"some of {', '.join(SEARCHES)}; all where left out")
    for name in parser.parse_args().name or SEARCHES:
        robot_name, draw, longest_s, candidates, seed = SEARCHES[name]
        robot = load(robot_name)
        motion, lowest = search(robot, lambda rng: draw(robot, rng), longest_s, candidates, seed)  # noqa: B023
        reference = sample(motion, robot, CHECK_S)
        speed = np.abs(reference.qd).max(axis=0) / [joint.velocity_max_rad_s for joint in robot.joint]
        torque = np.abs(torques(robot, reference)).max(axis=0) / [joint.torque_max_Nm for joint in robot.joint]
        print(f"{name}: {reference.t_s[-1]:.2f} s, condition number {lowest:.1f}, slow {slow_share(robot, motion):.3f}")
        print(f"  share of the speed limits {np.round(speed, 2)}, of the torque limits {np.round(torque, 2)}")
        header = (
            f"# Written by tests/studies/shipped_motions.py: best of {candidates} random motions, condition number"
            f" {lowest:.0f} with scaled columns.\n"
            "# Keeps the robot's limits; check the clearance of a real cell before you run it there.\n\n"
        )
        named = msgspec.structs.replace(motion, name=name)
        (LIBRARY / f"{name}.toml").write_text(header + one_line_arrays(config.to_toml(named)), encoding="utf-8")


if __name__ == "__main__":
    main()
