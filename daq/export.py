"""`armrig export`: signals as a table with units in the column names, or raw frames as candump text."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.replay import Batch, Merge, bus_of, to_frames
from protocols.candump import format_frame
from protocols.container import BrokenFileError, scan
from protocols.errors import ConfigError, DataError
from protocols.gather import messages_by_chunk
from protocols.recording import Recording, damage, map_file, read_recording
from protocols.robot import Robot

TABLES = (".csv", ".npz", ".parquet")
FRAMES = (".log", ".candump")
_CSV_DIGITS = "%.12g"  # a count of a 17-bit encoder behind a gear is 1e-7 rad: nothing is lost


def export(source: Path, target: Path) -> str:
    """Write a recording to another format, chosen by the name of `target`; returns what was done.

    Raises:
        ConfigError: No such format.
        DataError: The recording is unusable, or `target` cannot be written.
    """
    suffix = target.suffix.lower()
    if suffix not in TABLES + FRAMES:
        raise ConfigError(f"{target}: the name must end in {', '.join(TABLES)} or {FRAMES[0]} (candump text).")
    try:
        if suffix in FRAMES:
            return f"{target}: {_candump(frames(source), target)} frames"
        columns = table(read_recording(source))
        rows = len(columns["t_s"])
        if suffix == ".csv":
            np.savetxt(
                target,
                np.column_stack(list(columns.values())),
                fmt=_CSV_DIGITS,
                delimiter=",",
                header=",".join(columns),
                comments="",
            )
        elif suffix == ".npz":
            with target.open("wb") as file:
                np.savez_compressed(file, **columns)  # type: ignore[arg-type]
        else:
            import pyarrow
            import pyarrow.parquet

            pyarrow.parquet.write_table(pyarrow.table(columns), target)
    except OSError as error:
        raise DataError(f"{target}: cannot be written: {error.strerror}.") from error
    return f"{target}: {rows} rows of {len(columns)} columns: {', '.join(columns)}"


def table(recording: Recording) -> dict[str, NDArray[np.generic]]:
    """Columns by name, each of shape (T,): time, cycle, and per joint what is known, with units."""
    columns: dict[str, NDArray[np.generic]] = {"t_s": recording.t_s, "cycle": recording.cycle}
    current = None if recording.drives is None else recording.current_A()
    for j, (name, length, force) in enumerate(_units(recording.robot)):
        columns[f"{name}_position_{length}"] = recording.position_rad[:, j]
        columns[f"{name}_effort_{force}"] = recording.effort_Nm[:, j]
        if current is not None and recording.drives is not None:
            columns[f"{name}_current_A"] = current[:, j]
            columns[f"{name}_position_counts"] = recording.drives.position_counts[:, j]
            columns[f"{name}_missing"] = recording.missing[:, j].astype(np.int8)
    return columns


def _units(robot: Robot) -> Iterator[tuple[str, str, str]]:
    for joint in robot.joint:
        yield (joint.name, "m", "N") if joint.kind == "prismatic" else (joint.name, "rad", "Nm")


def frames(source: Path) -> Iterator[Batch]:
    """Raw frames in the order of arrival, in short batches of one bus.

    Raises:
        DataError: Unreadable, or no raw frames in it.
    """
    label = str(source)
    merge, seen = Merge(), False
    try:
        contents = scan(map_file(source, label))
        buses = {c.topic: bus for c in contents.channels.values() if (bus := bus_of(c.topic)) is not None}
        for found in messages_by_chunk(contents, buses):
            for topic, some in found.items():
                at = 0
                for block in some.blocks:
                    seen = True
                    times = np.array(some.log_time[at : at + len(block)], dtype=np.uint64)
                    at += len(block)
                    yield from merge.add(buses[topic], to_frames(block, times))
    except BrokenFileError as error:
        raise damage(label, error) from error
    except ValueError as error:
        raise DataError(f"{label} does not follow its own message types: {error}.") from error
    if not seen:
        raise DataError(f"{label}: has no raw CAN frames; only recordings of a rig have them.")
    yield from merge.rest()


def _candump(batches: Iterator[Batch], target: Path) -> int:
    """Lines of frames; no file is left behind where the recording turns out to be damaged."""
    count = 0
    try:
        with target.open("w", encoding="ascii", newline="\n") as out:
            for bus, batch in batches:
                out.write("".join([format_frame(t_ns, bus, frame) + "\n" for t_ns, frame in batch]))
                count += len(batch)
    except DataError:
        target.unlink()
        raise
    return count
