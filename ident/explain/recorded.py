"""Recordings of one session as runs: signals, start in the session, motor temperatures of the cell."""

from collections.abc import Sequence
from datetime import datetime

import numpy as np

from ident.explain.motion import Run, Temperature
from ident.recorded import signals
from protocols.errors import DataError
from protocols.recording import Recording

LATEST_S = 24 * 3600.0  # recordings further apart are not one session


def runs(recordings: Sequence[Recording]) -> list[Run]:
    """Runs in the order given; session time starts with the first of them by the clock.

    Raises:
        DataError: As `ident.recorded.signals`; recordings of different robots.
    """
    names = {recording.robot.name for recording in recordings}
    if len(names) > 1:
        raise DataError(
            f"The recordings are of {len(names)} robots ({', '.join(sorted(names))}); explain one robot at a time, or"
            " give the one robot file that holds for all with --robot."
        )
    created = [_created(recording) for recording in recordings]
    known = [c for c in created if c is not None]
    first = min(known) if known else 0.0
    out = []
    for recording, at in zip(recordings, created, strict=True):
        start = 0.0 if at is None or at - first > LATEST_S else at - first
        out.append(Run(signals(recording), start, _temperature(recording)))
    return out


def _created(recording: Recording) -> float | None:
    """Seconds since 1970 at which a recording was started, where its file says."""
    for values in recording.metadata.values():
        text = values.get("created_utc", "")
        if text:
            try:
                return datetime.fromisoformat(text).timestamp()
            except ValueError:
                return None
    return None


def _temperature(recording: Recording) -> Temperature | None:
    cell = recording.cell
    if cell is None or cell.motor_temperature_C.shape[1] < recording.robot.joints:
        return None
    good = ~cell.stale & np.isfinite(cell.motor_temperature_C).all(axis=1)
    if good.sum() < 2:
        return None
    return Temperature(cell.t_s[good], cell.motor_temperature_C[good, : recording.robot.joints])
