"""One recording on disk: `RUN.mcap.part` while it is being written, `RUN.mcap` when it is complete.

What has been flushed survives the end of this process, what has been synced survives the end of power.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from daq.disk import Disk
from daq.mcapfile import McapFile
from daq.rows import Rows, Times
from protocols import topics
from protocols.errors import DataError

PART = ".part"
LIBRARY = f"armrig {version('armrig')}"
_RARE = "rare"  # group of the topics that share chunks
_RARE_TOPICS = {t.name: t.type for t in topics.TOPICS if t.name in (topics.CELL, topics.EVENTS, topics.COUNTERS)}


class Store:
    """A recording being written; not thread safe.

    A disk that refuses ends the file, not the run: the file is closed at its last whole record, keeps its `.part`
    name, and whatever comes later is let go.

    Attributes:
        path, part: Name of the complete file, and of this one.
        failure: What the disk said and what to do, or None.
    """

    def __init__(self, path: Path, start: topics.RunStart, buses: Sequence[str], chunk_bytes: int) -> None:
        """Create the file, with all topics registered.

        Raises:
            DataError: It cannot be created or written, or another recording of that name is unfinished.
        """
        self.path = path
        self.part = path.with_name(path.name + PART)
        self.failure: str | None = None
        self._channels: dict[str, int] = {}
        self._disk = Disk(self.part)
        try:
            self._mcap = McapFile(self._disk, topics.PROFILE, LIBRARY, chunk_bytes)
            self._mcap.metadata(topics.RUN_START, start.to_metadata())
            schemas: dict[str, int] = {}
            for topic in topics.TOPICS:
                kind = topic.type
                if kind.name not in schemas:
                    schemas[kind.name] = self._mcap.schema(kind.name, topics.SCHEMA_ENCODING, kind.text.encode())
                about = {"rate": topic.rate, "joints": start.joints, "offered_qos_profiles": ""}
                for name in topic.names(buses):
                    self._channels[name] = self._mcap.channel(name, topics.ENCODING, schemas[kind.name], about)
        except OSError as error:
            self._disk.close()
            raise DataError(f"{self.part}: cannot be written: {error.strerror}.") from error

    @property
    def counts(self) -> dict[str, int]:
        """Messages so far, by topic."""
        return self._mcap.counts

    def attach(self, name: str, media_type: str, text: str) -> None:
        """Attach a file."""
        self._do(self._mcap.attachment, name, media_type, text.encode())

    def write(self, topic: str, log_time: Times, publish_time: Times, rows: Rows) -> None:
        """Messages of one topic. Cyclic topics fill chunks of their own, in order: readers skip what they can."""
        group = _RARE if topic in _RARE_TOPICS else topic
        self._do(self._mcap.write, group, self._channels[topic], log_time, publish_time, rows)

    def write_one(self, topic: str, t_ns: int, values: Mapping[str, Any]) -> None:
        """One message of a topic that is not cyclic."""
        data = _RARE_TOPICS[topic].encode(values)
        time = np.array([t_ns], dtype=np.uint64)
        self.write(topic, time, time, np.frombuffer(data, dtype=f"V{len(data)}"))

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._do(self._mcap.flush)

    def sync(self) -> None:
        """Wait until the disk has it all; seen to take more than a second."""
        self._do(self._disk.sync)

    def finish(self, stop: dict[str, str]) -> None:
        """Complete the file and give it its name."""
        self._do(self._mcap.flush)
        self._do(self._mcap.metadata, topics.RUN_STOP, stop)
        self._do(self._mcap.finish)
        self._do(self._disk.sync)
        self._do(self._disk.publish, self.path)
        self._disk.close()

    def _do(self, action: Callable[..., object], *arguments: object) -> None:
        if self.failure is not None:
            return
        try:
            action(*arguments)
        except OSError as error:
            self._disk.cut()
            self.failure = (
                f"{self.path}: recording stopped, the disk refuses: {error.strerror}. {self._disk.sound} bytes are kept"
                f" in {self.part}: make room, then run armrig recover {self.part} -o {self.path}."
            )
