"""The demonstration: every part of armrig as a process of its own, as a user would start them in four terminals."""

import re
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Self

import msgspec

from emulator.child import RUN_S, Child, free_ports
from emulator.machine import load_machine
from protocols import config
from protocols.effectentries import parse_effect
from protocols.errors import ConfigError
from protocols.rig import Rig, load_rig

MOTIONS = ("train", "test")  # identified from, predicted
QUIET_S = 0.5


class Demo:
    """One run of the whole chain.

    Args:
        robot: `tx40` or `emps`: a rig, two motions of that name are shipped.
        out: Folder for everything.
        stop: Set by Ctrl-C.
        log: Told what happens.
        effects: Physics beyond the shipped machine, as in `--effect`.
    """

    def __init__(
        self, robot: str, out: Path, stop: threading.Event, log: Callable[[str], None], effects: Sequence[str] = ()
    ) -> None:
        self._robot, self._out, self._stop, self._log = robot, out, stop, log
        self._effects = [parse_effect(text) for text in effects]
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

    def _record_live(self, name: str, rig: Path, endpoint: str) -> Child:
        offer = ("--offer", "--connect", endpoint, "--until-quiet", str(QUIET_S))
        path = self._recording(name)
        recorder = self._start(f"record-{name}", "record", str(rig), "-o", str(path), *offer)
        recorder.wait_for("recording")
        motion = f"{self._robot}-{name}"
        host = self._start(f"move-{name}", "move", str(rig), "--motion", motion)
        self._log(f"{motion}: {host.finish().strip()}")
        return recorder

    def _record_simulated(self, name: str, rig: Path, endpoint: str) -> Child:
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

    def _start(self, name: str, *arguments: str, stdin: IO[bytes] | None = None, keep_stdout: bool = False) -> Child:
        child = Child(self._out / f"{name}.log", arguments, self._stop, stdin, keep_stdout=keep_stdout)
        return self._children.enter_context(child)

    def _free_rig(self) -> tuple[Path, Rig]:
        """The shipped rig on ports that are free here, so that several demonstrations may run at once."""
        rig = on_free_ports(load_rig(f"{self._robot}-rig")[0])
        emulated = msgspec.structs.replace(rig.emulated, effect=[*rig.emulated.effect, *self._effects])
        rig = msgspec.structs.replace(rig, emulated=emulated)
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


def on_free_ports(rig: Rig) -> Rig:
    """The rig with every bus on the hub, cell and service on loopback ports that nobody uses at this moment."""
    ports = free_ports(len(rig.bus) + 2)
    buses = [
        msgspec.structs.replace(b, interface="virtualcan", channel=f"127.0.0.1:{port}")
        for b, port in zip(rig.bus, ports, strict=False)
    ]
    cell = rig.cell and msgspec.structs.replace(rig.cell, port=ports[-2])
    zenoh = msgspec.structs.replace(rig.zenoh, endpoint=f"tcp/127.0.0.1:{ports[-1]}")
    return msgspec.structs.replace(rig, bus=buses, cell=cell, zenoh=zenoh)
