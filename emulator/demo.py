"""The demonstration: every part of armrig as a process of its own, as a user would start them in four terminals."""

import re
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from socket import socket
from typing import IO, Self

import msgspec

from emulator.machine import load_machine
from protocols import config
from protocols.errors import ConfigError, PeerError
from protocols.rig import Rig, load_rig

MOTIONS = ("train", "test")  # identified from, predicted
READY_S = 120.0  # the first start on a machine compiles the kernels
RUN_S = 600.0
END_S = 10.0
QUIET_S = 0.5


class Demo:
    """One run of the whole chain.

    Args:
        robot: `tx40` or `emps`: a rig, two motions of that name are shipped.
        out: Folder for everything.
        stop: Set by Ctrl-C.
        log: Told what happens.
    """

    def __init__(self, robot: str, out: Path, stop: threading.Event, log: Callable[[str], None]) -> None:
        self._robot, self._out, self._stop, self._log = robot, out, stop, log
        self._children = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._children.close()

    def run(self, clock: str) -> str:
        """Everything; returns the table of the identification.

        Raises:
            ConfigError: No such robot, or the folder cannot be written.
            PeerError: One of the processes failed; says which and its last words.
        """
        try:
            self._out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self._out}: cannot be created: {error.strerror}. Choose another --out.") from error
        rig_file, rig = self._free_rig()
        endpoint = rig.zenoh.endpoint
        self._start("serve", "serve", "--listen", endpoint).wait_for("is running")
        if clock == "real":
            self._start("emulate", "emulate", str(rig_file)).wait_for("is running")
        record = self._record_live if clock == "real" else self._record_simulated
        keys = []
        for name in MOTIONS:
            recorder = record(name, rig_file, endpoint)
            offered = recorder.wait_for("offered as", RUN_S)
            self._log(recorder.line(f"{self._recording(name)}: "))
            keys.append(re.findall(r"offered as (\S+)", offered)[0])
        self._log(f"identifying {MOTIONS[0]}, predicting {MOTIONS[1]}")
        files = [str(self._out / f) for f in ("result.json", "report.html", "identified.toml")]
        outputs = [x for pair in zip(("--json", "--html", "--model-out"), files, strict=True) for x in pair]
        truth = ("--truth", str(self._truth(rig)))
        request = ("request", "identify", keys[0], "--validate", keys[1], "--connect", endpoint, *truth, *outputs)
        return self._start("request", *request).finish()

    def _record_live(self, name: str, rig: Path, endpoint: str) -> "Child":
        offer = ("--offer", "--connect", endpoint, "--until-quiet", str(QUIET_S))
        path = self._recording(name)
        recorder = self._start(f"record-{name}", "record", str(rig), "-o", str(path), *offer)
        recorder.wait_for("recording")
        motion = f"{self._robot}-{name}"
        host = self._start(f"move-{name}", "move", str(rig), "--motion", motion)
        self._log(f"{motion}: {host.finish().strip()}")
        return recorder

    def _record_simulated(self, name: str, rig: Path, endpoint: str) -> "Child":
        motion = f"{self._robot}-{name}"
        emulator = self._start(
            f"emulate-{name}", "emulate", str(rig), "--clock", "sim", "--motion", motion, keep_stdout=True
        )
        path = self._recording(name)
        offer = ("--bus", "-", "--offer", "--connect", endpoint)
        recorder = self._start(f"record-{name}", "record", str(rig), "-o", str(path), *offer, stdin=emulator.stdout)
        self._log(f"{motion}: {emulator.wait_for('simulated in', RUN_S)}")
        return recorder

    def _recording(self, name: str) -> Path:
        return self._out / f"{name}.mcap"

    def _start(self, name: str, *arguments: str, stdin: IO[bytes] | None = None, keep_stdout: bool = False) -> "Child":
        child = Child(self._out / f"{name}.log", arguments, self._stop, stdin, keep_stdout=keep_stdout)
        return self._children.enter_context(child)

    def _free_rig(self) -> tuple[Path, Rig]:
        """The shipped rig on ports that are free here, so that several demonstrations may run at once."""
        rig, _ = load_rig(f"{self._robot}-rig")
        ports = _free_ports(len(rig.bus) + 2)
        cell = rig.cell and msgspec.structs.replace(rig.cell, port=ports[-2])
        buses = [
            msgspec.structs.replace(b, interface="virtualcan", channel=f"127.0.0.1:{port}")
            for b, port in zip(rig.bus, ports, strict=False)
        ]
        zenoh = msgspec.structs.replace(rig.zenoh, endpoint=f"tcp/127.0.0.1:{ports[-1]}")
        rig = msgspec.structs.replace(rig, bus=buses, cell=cell, zenoh=zenoh)
        path = self._out / "rig.toml"
        path.write_text(config.to_toml(rig))
        for name in MOTIONS:
            self._recording(name).unlink(missing_ok=True)
        return path, rig

    def _truth(self, rig: Rig) -> Path:
        """Robot file of the emulated machine, for the report alone."""
        _, robot = load_rig(f"{self._robot}-rig")
        path = self._out / "truth.toml"
        path.write_text(config.to_toml(load_machine(rig, robot, self._out)))
        return path


def _free_ports(count: int) -> list[int]:
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
