"""The commands as a user types them: real processes on loopback, exit codes, and the words of every refusal."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from socket import socket

import msgspec
import pytest

from protocols import config
from protocols.rig import load_rig

pytestmark = pytest.mark.system

PATIENCE_S = 120.0  # a first start compiles kernels; nothing here is about speed


def armrig(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "armrig", *arguments],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=cwd,
    )  # fmt: skip


class Background:
    """A command that runs until told otherwise."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "armrig", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        self.said: list[str] = []

    def wait_for(self, words: str) -> str:
        watchdog = threading.Timer(PATIENCE_S, self.process.kill)
        watchdog.start()
        try:
            assert self.process.stdout is not None
            for line in self.process.stdout:
                self.said.append(line)
                if words in line:
                    return line
        finally:
            watchdog.cancel()
        raise AssertionError(f"never said {words!r}: {''.join(self.said)}")

    def interrupt(self) -> int:
        self.process.send_signal(signal.SIGINT)
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        self.said.append(out)
        return self.process.returncode


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The EMPS rig on free ports."""
    ports = []
    for _ in range(3):
        with socket() as probe:
            probe.bind(("127.0.0.1", 0))
            ports.append(probe.getsockname()[1])
    cell, _ = load_rig("emps-rig")
    assert cell.cell is not None
    cell = msgspec.structs.replace(
        cell,
        bus=[msgspec.structs.replace(b, channel=f"127.0.0.1:{ports[0]}") for b in cell.bus],
        cell=msgspec.structs.replace(cell.cell, port=ports[1]),
        zenoh=msgspec.structs.replace(cell.zenoh, endpoint=f"tcp/127.0.0.1:{ports[2]}"),
    )
    path = tmp_path / "rig.toml"
    path.write_text(config.to_toml(cell))
    return path


@pytest.fixture
def running(rig: Path) -> Iterator[Path]:
    """The rig, being emulated."""
    emulator = Background("emulate", str(rig))
    emulator.wait_for("is running")
    yield rig
    assert emulator.interrupt() == 0, "".join(emulator.said)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the EMPS made in simulated time by two commands and a pipe."""
    path = tmp_path_factory.mktemp("recording") / "emps.mcap"
    emulate = [sys.executable, "-m", "armrig", "emulate", "emps-rig", "--clock", "sim", "--motion", "emps-test"]
    record = [sys.executable, "-m", "armrig", "record", "emps-rig", "--bus", "-", "-o", str(path)]
    with subprocess.Popen(emulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as source:
        done = subprocess.run(record, stdin=source.stdout, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "LOSSLESS" in done.stdout
    return path


def test_help_does_not_load_the_heavy_libraries() -> None:
    heavy = "numpy scipy numba pinocchio matplotlib zenoh pymodbus can"
    code = f"import sys, armrig; print([m for m in {heavy.split()!r} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["move", "nowhere.toml", "--motion", "x"], 2, "nowhere.toml: no such file, and not one of the shipped"),
        (["emulate", "emps-rig", "--clock", "sim"], 2, "--clock sim needs --motion"),
        (["emulate", "emps-rig", "--clock", "sideways"], 2, "--clock sideways: choose real or sim"),
        (["emulate", "emps-rig", "--bus", "can7=socketcan:vcan0"], 2, "write NAME=INTERFACE:CHANNEL with a bus of"),
        (["move", "emps-rig", "--motion", "emps-test", "--mode", "warp"], 2, "--mode warp: choose cst or csp"),
        (["identify", "absent.mcap"], 3, "absent.mcap"),
        (["info", "absent.mcap"], 3, "absent.mcap"),
        (["request", "identify", "some-log", "--connect", "tcp/127.0.0.1:9"], 5, "No Zenoh router answers"),
        (["request", "identify", "no/such/file.mcap"], 2, "no such file, and no log key either"),
        (["demo", "--clock", "fast"], 2, "--clock fast: choose real or sim"),
        (["frobnicate"], 2, "No such command"),
    ],
)
def test_refusals_say_what_to_do(arguments: list[str], code: int, words: str, tmp_path: Path) -> None:
    done = armrig(*arguments, cwd=tmp_path)
    assert words in done.stderr
    assert done.returncode == code
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


def test_an_unknown_key_is_named_with_its_path(rig: Path) -> None:
    rig.write_text(rig.read_text() + "\n[recorder2]\nflush = 1\n")
    done = armrig("emulate", str(rig))
    assert done.returncode == 2
    assert "unknown key `recorder2`" in done.stderr


def test_a_bus_that_does_not_exist(rig: Path) -> None:
    done = armrig("move", str(rig), "--motion", "emps-test")
    assert done.returncode == 5
    assert "no CAN hub answers at 127.0.0.1:" in done.stderr
    assert "Start the emulator" in done.stderr
    done = armrig("record", str(rig), "-o", str(rig.parent / "x.mcap"), "--bus", "can0=socketcan:can99")
    assert done.returncode == 5
    assert "can0 (socketcan can99) does not exist" in done.stderr


def test_two_rigs_on_one_port(running: Path) -> None:
    done = armrig("emulate", str(running))
    assert done.returncode == 5
    assert "is in use by another process" in done.stderr


def test_a_recording_interrupted_at_any_moment_is_complete(running: Path) -> None:
    path = running.parent / "run.mcap"
    recorder = Background("record", str(running), "-o", str(path))
    recorder.wait_for("recording")
    host = Background("move", str(running), "--motion", "emps-test")
    host.wait_for("moving")
    threading.Event().wait(1.0)
    assert host.interrupt() == 0, "".join(host.said)
    assert "cycles" in "".join(host.said)
    assert recorder.interrupt() == 0, "".join(recorder.said)
    assert "LOSSLESS" in "".join(recorder.said)
    about = json.loads(armrig("info", str(path), "--json", "-").stdout)
    assert about["verdict"] == "LOSSLESS"
    assert not path.with_name("run.mcap.part").exists()


def test_a_killed_recorder_loses_only_its_tail(running: Path) -> None:
    path = running.parent / "run.mcap"
    recorder = Background("record", str(running), "-o", str(path))
    recorder.wait_for("recording")
    host = Background("move", str(running), "--motion", "emps-test")
    host.wait_for("moving")
    threading.Event().wait(1.5)
    recorder.process.kill()
    recorder.process.communicate()
    assert host.interrupt() == 0
    part = path.with_name("run.mcap.part")
    refused = armrig("identify", str(part))
    assert refused.returncode == 3
    assert "armrig recover" in refused.stderr
    mended = armrig("recover", str(part), "-o", str(path))
    assert mended.returncode == 0, mended.stderr
    assert armrig("info", str(path)).returncode == 0


def test_recordings_that_cannot_be_used(recording: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    done = armrig("identify", str(broken))
    assert done.returncode == 3
    assert "armrig recover" in done.stderr
    other = armrig("identify", str(recording), "--robot", "tx40")
    assert other.returncode == 3
    assert "TX40" in other.stderr
    unknown = armrig("identify", str(recording), "--method", "magic")
    assert unknown.returncode == 2
    assert "--method magic: choose from" in unknown.stderr


def test_identify_writes_what_was_asked_for(recording: Path, tmp_path: Path) -> None:
    result, report, model = (tmp_path / name for name in ("r.json", "r.html", "m.toml"))
    done = armrig(
        "identify", str(recording), "--json", str(result), "--html", str(report), "--model-out", str(model)
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "torque error" in done.stdout
    keys = {"method", "robot", "runs", "parameters", "fit", "validation", "simulation", "statistics", "iterations",
            "converged", "condition_number", "physically_consistent", "seconds", "notes"}  # fmt: skip
    assert keys <= set(json.loads(result.read_text()))
    assert "<svg" in report.read_text()
    assert not re.search(r"""(src|href|url\()=?["']?https?:""", report.read_text()), (
        "the report needs nothing from outside"
    )
    again = armrig("identify", str(recording), "--robot", str(model), "--json", "-")
    assert json.loads(again.stdout)["robot"] == "EMPS"


@pytest.mark.parametrize("name", ["run.csv", "run.npz", "run.parquet", "run.log"])
def test_exports(recording: Path, tmp_path: Path, name: str) -> None:
    done = armrig("export", str(recording), "--to", str(tmp_path / name))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / name).stat().st_size > 10_000


def test_the_demonstration_in_simulated_time(tmp_path: Path) -> None:
    done = armrig("demo", "--robot", "emps", "--clock", "sim", "--out", str(tmp_path / "demo"))
    assert done.returncode == 0, done.stderr
    assert "report.html" in done.stdout
    assert (tmp_path / "demo" / "report.html").exists()
    result = json.loads((tmp_path / "demo" / "result.json").read_text())
    far = [p["name"] for p in result["parameters"] if p["essential"] and abs(p["value"] - p["truth"]) > 4 * p["std"]]
    assert not far
    assert not _armrig_processes(tmp_path), "every process of the demonstration has ended"


def _armrig_processes(folder: Path) -> list[str]:
    """Command lines of living processes that mention a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                line = (entry / "cmdline").read_text().replace("\0", " ")
            except OSError:  # gone meanwhile
                continue
            if str(folder) in line and "armrig" in line:
                found.append(line)
    return found
