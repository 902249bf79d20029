"""`armrig recover`: a readable recording from a damaged or unfinished one, and what was lost."""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema

from daq.decode import Decoder
from daq.disk import Disk
from daq.integrity import Integrity
from daq.mcapfile import McapFile
from daq.replay import Merge, bus_of, to_frames
from daq.salvage import Batch, Lost, Message, Salvage
from daq.store import LIBRARY
from protocols import config, topics
from protocols.container import MAGIC
from protocols.errors import ArmrigError, ConfigError, DataError
from protocols.recording import map_file
from protocols.rig import Rig
from protocols.robot import Robot

_WORKING = ".recovering"
_CHUNK_BYTES = 1 << 30  # chunks stay as they were: each is closed by a flush


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of a recording.

    Attributes:
        path: The new file.
        messages: That are in it.
        lost: Stretches of the old file that could not be read.
        finished: The old file had reached the end of its run.
        verdict, because: Of what was recovered; see `daq.integrity.Verdict`.
    """

    path: Path
    messages: int
    lost: tuple[Lost, ...]
    finished: bool
    verdict: str
    because: tuple[str, ...]

    def __str__(self) -> str:
        """Report of the command line."""
        end = "" if self.finished else ", without the end of the run"
        lines = [f"{self.path}: {self.messages} messages recovered{end}, {self.verdict}"]
        lines += [f"  {reason}" for reason in self.because]
        for lost in self.lost:
            when = "" if lost.first_s is None else f", {lost.first_s:.3f} to {lost.last_s:.3f} s"
            lines.append(f"  lost: bytes {lost.begin} to {lost.end}{when}: the file {lost.reason}")
        return "\n".join(lines)


def recover(source: Path, target: Path) -> Recovery:
    """Write all that is sound in `source` to `target`. Recovering a recovered file gives the same file.

    Raises:
        DataError: `source` is unreadable or has nothing to recover, or `target` cannot be written.
    """
    buffer = map_file(source, str(source))
    if bytes(buffer[: len(MAGIC)]) != MAGIC:
        raise DataError(f"{source}: is not an MCAP file; there is nothing to recover.")
    if target.exists() and target.samefile(source):
        raise DataError(f"{target}: cannot replace the file it is recovered from. Choose another name with -o.")
    disk = Disk(target.with_name(target.name + _WORKING))
    try:
        copy = _Copy(disk, target)
        salvage = Salvage(buffer)
        for found in salvage:
            copy.take(found)
        if not copy.messages:
            raise DataError(f"{source}: no message could be recovered from {len(buffer)} bytes.")
        recovery = copy.finish(finished=salvage.complete)
        disk.sync()
        disk.publish(target)
    except OSError as error:
        disk.part.unlink(missing_ok=True)
        raise DataError(f"{target}: cannot be written: {error.strerror}.") from error
    except ArmrigError:
        disk.part.unlink(missing_ok=True)
        raise
    finally:
        disk.close()
    return recovery


class _Copy:
    """The new file, and the old one's frames decoded once more for the verdict."""

    def __init__(self, disk: Disk, target: Path) -> None:
        self.messages = 0
        self._target = target
        self._file = McapFile(disk, topics.PROFILE, LIBRARY, _CHUNK_BYTES)
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, int] = {}
        self._topics: dict[int, str] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, str] = {}
        self._lost: list[Lost] = []
        self._decoder: Decoder | None = None
        self._merge = Merge()

    def take(self, found: object) -> None:
        """The next thing that was salvaged."""
        match found:
            case Lost():
                self._lost.append(found)
            case Schema() if found.id not in self._schemas:
                self._schemas[found.id] = self._file.schema(found.name, found.encoding, found.data)
            case Channel() if found.id not in self._channels:
                schema = self._schemas.get(found.schema_id, 0)
                self._topics[found.id] = found.topic
                self._channels[found.id] = self._file.channel(
                    found.topic, found.message_encoding, schema, found.metadata
                )
            case Metadata():
                self._metadata[found.name] = found.metadata
                self._file.metadata(found.name, found.metadata)
            case Attachment():
                self._attachments[found.name] = found.data.decode(errors="replace")
                self._file.attachment(found.name, found.media_type, found.data)
            case Batch():
                self._copy(found.messages)

    def finish(self, *, finished: bool) -> Recovery:
        """Close the new file with the verdict of what is in it."""
        known = self._metadata.get(topics.RECOVERED)
        stop = self._metadata.get(topics.RUN_STOP)
        if not self._lost and finished and (known or stop):
            verdict = (known or stop or {}).get("verdict", "")
            because: tuple[str, ...] = ()
        else:
            verdict, because = self._judge(finished=finished)
            self._file.metadata(
                topics.RECOVERED,
                {
                    "verdict": verdict,
                    "because": "; ".join(because),
                    "lost_bytes": str(sum(lost.end - lost.begin for lost in self._lost)),
                    "lost_stretches": str(len(self._lost)),
                },
            )
        self._file.finish()
        return Recovery(self._target, self.messages, tuple(self._lost), finished, verdict, because)

    def _copy(self, batch: list[Message]) -> None:
        batch = [m for m in batch if m.channel in self._channels]
        for (channel, size), run in itertools.groupby(batch, key=lambda m: (m.channel, len(m.data))):
            part = list(run)
            head = np.array([(m.sequence, m.log_time, m.publish_time) for m in part], dtype=np.uint64)
            rows = np.frombuffer(b"".join([m.data for m in part]), dtype=f"V{size}")
            self._file.write("all", self._channels[channel], head[:, 1], head[:, 2], rows, head[:, 0].astype(np.uint32))
            self._decode(self._topics[channel], part)
            self.messages += len(part)
        self._file.flush()

    def _decode(self, topic: str, batch: list[Message]) -> None:
        bus = bus_of(topic)
        if self._decoder is None:
            self._decoder = _decoder(self._attachments)
        if self._decoder is None or bus not in self._decoder.integrity.bus:
            return
        data = np.frombuffer(b"".join([m.data for m in batch]), dtype=np.uint8).reshape(len(batch), -1)
        log_time = np.array([m.log_time for m in batch], dtype=np.uint64)
        for name, frames in self._merge.add(bus, to_frames(data, log_time)):
            self._decoder.feed(name, frames)

    def _judge(self, *, finished: bool) -> tuple[str, tuple[str, ...]]:
        """Verdict over the frames that were salvaged."""
        if self._decoder is None:
            return "UNVERIFIABLE", ("the robot and rig files attached to the recording are lost",)
        for name, frames in self._merge.rest():
            self._decoder.feed(name, frames)
        self._decoder.finish(cut_off=not finished)
        found = self._decoder.integrity.verdict()
        return found.text, found.because if finished else (*found.because, "the end of the run was not recorded")


def _decoder(attachments: dict[str, str]) -> Decoder | None:
    """Decoder for the attached rig, if it can still be read."""
    if not {topics.ROBOT_FILE, topics.RIG_FILE} <= attachments.keys():
        return None
    try:
        robot = config.parse(attachments[topics.ROBOT_FILE], Robot, topics.ROBOT_FILE)
        rig = config.parse(attachments[topics.RIG_FILE], Rig, topics.RIG_FILE)
    except ConfigError:
        return None
    return Decoder(rig, robot, Integrity.of([b.name for b in rig.bus], robot.joint_names))
