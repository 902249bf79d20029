"""A recording as identification wants it: joint positions and torques of the cycles in which every drive was heard."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ident.dataset import Command, Signals
from protocols.errors import DataError
from protocols.recording import Recording
from protocols.targets import read_targets

SATURATED = 0.99  # share of the largest current from which on the current loop may not follow


def signals(recording: Recording) -> Signals:
    """Signals of a recording; cycles with a missing drive are left out, which makes a gap.

    Raises:
        DataError: No cycle has all drives.
    """
    robot = recording.robot
    whole = ~np.asarray(recording.missing.any(axis=1))
    if not whole.any():
        raise DataError(f"{recording.source}: not one of {whole.size} cycles has the values of all drives.")
    # A foreign file's effort has the time it says; a drive's current is the mean over the cycle before.
    delay = [joint.drive.current_delay_s if recording.drives is not None else 0.0 for joint in robot.joint]
    return Signals(
        source=recording.source,
        joints=robot.joint_names,
        t_s=recording.t_s[whole],
        q=recording.position_rad[whole],
        tau_Nm=recording.effort_Nm[whole],
        delay_s=np.array(delay),
        notes=_saturation(recording),
        verdict=recording.verdict,
        sha256=recording.sha256,
        command=cache(lambda: command(recording, whole)),
    )


def command(recording: Recording, rows: NDArray[np.bool_]) -> Command:
    """What the host asked for, on some rows.

    Raises:
        DataError: As `read_targets`.
    """
    targets = read_targets(recording)
    return Command(recording.robot.joint_position(targets.position_counts[rows]), targets.by_position)


def _saturation(recording: Recording) -> list[str]:
    """One note per drive that reached its largest current: the torque is right, the excitation was limited."""
    if recording.drives is None:
        return []
    notes = []
    for j, joint in enumerate(recording.robot.joint):
        drive = joint.drive
        limit = 1000 * drive.max_current_A / drive.rated_current_A
        share = float(np.mean(np.abs(recording.drives.current_permille[:, j]) >= SATURATED * limit))
        if share > 0:
            notes.append(
                f"{recording.source}: {joint.name} was at its largest current, {drive.max_current_A:g} A, in"
                f" {100 * share:.1f} % of the cycles."
            )
    return notes
