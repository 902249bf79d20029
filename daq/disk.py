"""A file that is being made: under another name until it is complete, and never with half a record at its end."""

import fcntl
import os
from pathlib import Path

from protocols.errors import DataError


class Disk:
    """Unbuffered output that knows how far the file is whole.

    Attributes:
        part: Name while it is being written.
        sound: Bytes up to the end of the last whole write.
    """

    def __init__(self, part: Path) -> None:
        """Create and lock the file.

        Raises:
            DataError: It cannot be created, or is there already.
        """
        self.part = part
        self.sound = 0
        try:
            self._descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise DataError(f"{part}: cannot be created: {error.strerror}.") from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            raise DataError(f"{part}: another process is writing this file. Choose another name with -o.") from error
        if os.fstat(self._descriptor).st_size:
            self.close()
            raise DataError(
                f"{part}: an unfinished recording is in the way. Run armrig recover {part} -o FILE.mcap, or delete it."
            )

    def write(self, data: bytes) -> None:
        """All of `data`, or OSError."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self.sound += len(data)

    def sync(self) -> None:
        """Wait until the device has it; seen to take more than a second."""
        os.fdatasync(self._descriptor)

    def publish(self, path: Path) -> None:
        """Give the complete file its name; the name too survives the end of power."""
        self.part.replace(path)
        folder = os.open(path.absolute().parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def cut(self) -> None:
        """Back to the last whole write."""
        os.ftruncate(self._descriptor, self.sound)

    def close(self) -> None:
        os.close(self._descriptor)
