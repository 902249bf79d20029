"""The recordings that are offered: an index from log ids to open files. Requests name ids, never paths."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from daq.describe import describe
from protocols import messages
from protocols.errors import DataError

_NOT_IN_ID = re.compile(r"[^A-Za-z0-9_-]+")
_LONGEST_STEM = 56  # of a log id's 64, so that a number fits behind it
_HASHED_BYTES = 1 << 20


class Shelf:
    """Finished recordings. Their files stay open: renaming or deleting them does not change what is offered."""

    def __init__(self, recordings: Sequence[Path]) -> None:
        """
        Raises:
            DataError: A recording is unreadable or damaged.
        """
        self._logs: dict[str, tuple[messages.LogInfo, int]] = {}
        for path in recordings:
            self._add(path)

    @property
    def ids(self) -> list[str]:
        return list(self._logs)

    def answer(self, log_id: str, parameters: Mapping[str, str]) -> bytes:
        """Payload of the reply to a get.

        Args:
            parameters: Empty for the description, else those of a range.

        Raises:
            DataError: No such log, or it has changed on disk.
            ConfigError: Not a valid range.
        """
        if log_id not in self._logs:
            offered = ", ".join(self._logs) or "none"
            raise DataError(f"There is no log {log_id[:64]!r}; offered are {offered}.")
        info, descriptor = self._logs[log_id]
        if not parameters:
            return messages.encode(info)
        wanted = messages.parse_range(dict(parameters))
        if wanted.offset > info.bytes:
            raise DataError(f"Log {log_id} has {info.bytes} bytes; there are none from {wanted.offset} on.")
        body = os.pread(descriptor, min(wanted.count, info.bytes - wanted.offset), wanted.offset)
        return messages.encode(
            messages.RangeReply(id=log_id, offset=wanted.offset, bytes=len(body), total_bytes=info.bytes), body
        )

    def close(self) -> None:
        for _, descriptor in self._logs.values():
            os.close(descriptor)
        self._logs.clear()

    def _add(self, path: Path) -> None:
        about = describe(path)
        stem = _NOT_IN_ID.sub("-", path.stem).strip("-_")[:_LONGEST_STEM] or "log"
        names = [stem, *(f"{stem}-{n}" for n in range(2, len(self._logs) + 2))]
        log_id = next(name for name in names if name not in self._logs)
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}.") from error
        digest, size = hashlib.sha256(), 0
        while piece := os.pread(descriptor, _HASHED_BYTES, size):
            digest.update(piece)
            size += len(piece)
        info = messages.LogInfo(
            id=log_id, bytes=size, sha256=digest.hexdigest(), verdict=about["verdict"], robot=about["robot"]
        )
        self._logs[log_id] = info, descriptor
