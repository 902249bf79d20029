"""Recorded positions against the robot file: degrees and motor angles are found before they spoil an estimate."""

import numpy as np

from ident.dataset import Dataset
from protocols.errors import DataError
from protocols.robot import Robot

FAR = 3.0  # times half the range of positions from its middle that no recording of this robot can be
FAST = 5.0  # times the largest speed that none can have; noise on unfiltered positions stays below
USUAL = 99.0  # percentile of speeds: single spikes are not a unit
WITHIN = 1.2  # of the limits, that a conversion must reach to be named
SATURATED = 0.99  # share of the largest torque


def check_units(dataset: Dataset, robot: Robot) -> list[str]:
    """Notes on torques at their limit.

    Raises:
        DataError: Positions or speeds are so far beyond the robot's limits that their unit must be another.
    """
    low = np.array([j.position_min_rad for j in robot.joint])
    high = np.array([j.position_max_rad for j in robot.joint])
    fastest = np.array([j.velocity_max_rad_s for j in robot.joint])
    q = np.concatenate([s.q for s in dataset.segments])
    speed = np.percentile(np.concatenate([np.abs(s.qd) for s in dataset.segments]), USUAL, axis=0)
    middle, half = (low + high) / 2, (high - low) / 2

    def beyond(factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.abs(q / factor - middle).max(axis=0) / half, speed / factor / fastest

    far, fast = beyond(np.ones(robot.joints))
    if (far > FAR).any() or (fast > FAST).any():
        worst = int(np.argmax(np.maximum(far / FAR, fast / FAST)))
        joint = robot.joint[worst]
        gears = np.abs([j.drive.gear_ratio for j in robot.joint])
        guesses = {
            "degrees: divide them by 57.3": np.full(robot.joints, np.degrees(1.0)),
            "motor angles: divide them by gear_ratio": gears,
        }
        fitting = [text for text, factor in guesses.items() if max(v.max() for v in beyond(factor)) < WITHIN]
        limit = max(-joint.position_min_rad, joint.position_max_rad)
        advice = f"They look like {', or '.join(fitting)}." if fitting else "Check the robot file and the units."
        raise DataError(
            f"{dataset.source}: positions of {joint.name} reach {np.abs(q[:, worst]).max():.4g} and speeds"
            f" {speed[worst]:.4g}, where the robot has at most {limit:.3g} rad and"
            f" {joint.velocity_max_rad_s:.3g} rad/s. {advice}"
        )
    return _saturation(dataset, robot)


def _saturation(dataset: Dataset, robot: Robot) -> list[str]:
    tau = np.concatenate([np.abs(s.tau_Nm) for s in dataset.segments])
    notes = []
    for j, joint in enumerate(robot.joint):
        share = float(np.mean(tau[:, j] >= SATURATED * joint.torque_max_Nm))
        if share > 0:
            notes.append(
                f"{dataset.source}: {joint.name} was at its largest torque, {joint.torque_max_Nm:g} N·m, in"
                f" {100 * share:.1f} % of the samples. Measured torque stays right, but the motion did not follow its"
                " reference there: slow it down, or use wls rather than methods that simulate."
            )
    return notes
