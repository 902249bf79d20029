"""Another `armrig` command as a process, for whoever runs several of them."""

import subprocess
import sys
import threading
from pathlib import Path
from socket import socket
from typing import IO, Self

from protocols.errors import PeerError

READY_S = 120.0  # the first start on a machine compiles the kernels
RUN_S = 600.0
END_S = 10.0


def free_ports(count: int) -> list[int]:
    """TCP ports that nobody listens on at this moment, all different."""
    probes = [socket() for _ in range(count)]
    try:
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]
    finally:
        for probe in probes:
            probe.close()


class Child:
    """Another `armrig` process; what it says is kept in a log file.

    Args:
        log_file: Where its words go.
        arguments: Of `armrig`.
        stop: Ends every wait.
        stdin: Output of another process.
        keep_stdout: Leave its stdout for another process.
    """

    def __init__(
        self,
        log_file: Path,
        arguments: tuple[str, ...],
        stop: threading.Event,
        stdin: IO[bytes] | None = None,
        *,
        keep_stdout: bool = False,
    ) -> None:
        self._command = f"armrig {arguments[0]}"
        self._log_file, self._stop = log_file, stop
        self._process = subprocess.Popen(
            [sys.executable, "-m", "armrig", *arguments],
            stdin=stdin or subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE if keep_stdout else subprocess.STDOUT,
        )
        self.stdout = self._process.stdout
        self.pid = self._process.pid
        if stdin is not None:
            stdin.close()  # the child has it now; ours would keep the pipe open when it ends
        self._said: list[str] = []
        self._ended = False
        self._news = threading.Condition()
        words = self._process.stderr if keep_stdout else self._process.stdout
        self._reader = threading.Thread(target=self._listen, args=(words,), daemon=True)
        self._reader.start()

    def wait_for(self, words: str, within_s: float = READY_S) -> str:
        """The first line that contains `words`.

        Raises:
            PeerError: The process ended, or did not say them in time.
        """
        with self._news:
            self._news.wait_for(lambda: self.line(words) or self._ended or self._stop.is_set(), within_s)
        found = self.line(words)
        if not found:
            raise self._failure(f"did not say {words!r} within {within_s:.0f} s")
        return found

    def line(self, words: str) -> str:
        """What it has said with these words; empty if nothing."""
        return next((line for line in self._said if words in line), "")

    def finish(self, within_s: float = RUN_S) -> str:
        """Wait for its end; returns all it has said.

        Raises:
            PeerError: It failed, or took too long.
        """
        with self._news:
            self._news.wait_for(lambda: self._ended or self._stop.is_set(), within_s)
        if not self._ended or self._process.wait(END_S) != 0:
            raise self._failure(f"did not finish within {within_s:.0f} s")
        return "\n".join(self._said)

    def close(self) -> None:
        """End it as Ctrl-C would; by force if it does not listen."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _listen(self, words: IO[bytes]) -> None:
        with words, self._log_file.open("wb") as log:
            for line in words:
                log.write(line)
                log.flush()
                with self._news:
                    self._said.append(line.decode(errors="replace").rstrip())
                    self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _failure(self, otherwise: str) -> PeerError:
        if self._stop.is_set():
            return PeerError("stopped.")
        code = self._process.poll()
        what = otherwise if code is None else f"ended with exit code {code}"
        last = f": {self._said[-1]}" if self._said else ""
        return PeerError(f"{self._command} {what}{last} (all it said is in {self._log_file}).")
