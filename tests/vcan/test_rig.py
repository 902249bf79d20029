"""Emulator, host, recorder and can-utils as processes of their own on a kernel's vcan: one session, judged in parts.

The carriage moves for three seconds while two recorders and candump listen. One recorder ends with the motion and is
identified from; the other stays, is held while cangen floods the bus, and hears a controller go off the bus.
"""

import os
import re
import signal
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from daq.bus import wait_any
from daq.export import export
from daq.rawcan import RawSocket
from daq.recorder import Recorder
from daq.shell import Quiet, Writer, record
from emulator.child import Child
from ident.identify import identify, truth_values
from ident.recorded import signals
from protocols import config
from protocols.candump import parse_line
from protocols.clock import RealClock
from protocols.errorframes import Class, encode
from protocols.frames import Frame
from protocols.motion import Motion, Points
from protocols.recording import Recording, read_recording
from protocols.rig import Bus, load_rig
from protocols.robot import load

pytestmark = pytest.mark.vcan

FLOOD = 30_000
BUS = "can0=socketcan:vcan0"
SOCKET = Bus(name="can0", interface="socketcan", channel="vcan0")


def write_inputs(folder: Path, *, virtual_time: bool) -> tuple[Path, Path]:
    """Rig and motion. In real time on a virtual machine a kilohertz is too much to ask: 4 ms there."""
    rig = msgspec.structs.replace(load_rig("emps-rig")[0], sync_period_us=1000 if virtual_time else 4000, cell=None)
    (folder / "rig.toml").write_text(config.to_toml(rig))
    segment = Points(point_rad=[[0.05], [0.15], [0.08], [0.12]], move_s=[1.0, 0.7, 0.6], dwell_s=0.1)
    plan = Motion(name="short", approach_s=0.5, segment=[segment])
    (folder / "short.toml").write_text(config.to_toml(plan))
    return folder / "rig.toml", folder / "short.toml"


@dataclass
class Session:
    """What is left of a session.

    Attributes:
        host, recorded, abused, emulator: What each process said.
        dump: Lines of candump.
        passed: Frames that the interface carried while the second recorder was there.
    """

    folder: Path
    host: str
    dump: list[str]
    recorded: str
    abused: str
    emulator: str
    passed: int

    def recording(self, name: str) -> Recording:
        return read_recording(self.folder / name)


def run_session(folder: Path, *, virtual_time: bool, abuse: bool = True) -> Session:
    rig, plan = map(str, write_inputs(folder, virtual_time=virtual_time))
    stop = threading.Event()
    with (
        Child(folder / "emulate.log", ("emulate", rig, "--bus", BUS), stop) as emulator,
        (folder / "dump.log").open("w") as dump_file,
    ):
        emulator.wait_for("is running")
        record = ("record", rig, "--bus", BUS, "-o")
        dump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=dump_file)
        with (
            Child(folder / "record.log", (*record, str(folder / "run.mcap"), "--until-quiet", "0.5"), stop) as recorder,
            Child(folder / "abused.log", (*record, str(folder / "abused.mcap")), stop) as abused,
        ):
            recorder.wait_for("recording")
            abused.wait_for("recording")
            before = carried()
            move = ("move", rig, "--bus", BUS, "--motion", plan, "--mode", "csp")
            with Child(folder / "move.log", move, stop) as host:
                said = host.finish()
            recorded = recorder.finish()
            dump.send_signal(signal.SIGINT)
            dump.wait()
            if abuse:
                mistreat(abused)
            os.kill(emulator.pid, signal.SIGINT)
            emulated = emulator.finish()
            passed = carried() - before  # nobody is left to send
            os.kill(abused.pid, signal.SIGINT)
            last = abused.finish()
    lines = (folder / "dump.log").read_text().splitlines()
    return Session(folder, said, lines, recorded, last, emulated, passed)


def carried() -> int:
    """Frames that the interface has carried since it came up, by the kernel's count."""
    return int(Path("/sys/class/net/vcan0/statistics/rx_packets").read_text())


def mistreat(recorder: Child) -> None:
    """Hold the recorder while the bus is flooded; then a controller goes off the bus and returns."""
    os.kill(recorder.pid, signal.SIGSTOP)
    subprocess.run(["cangen", "vcan0", "-g", "0", "-n", str(FLOOD), "-I", "7C0", "-L", "8", "-D", "i"], check=True)
    os.kill(recorder.pid, signal.SIGCONT)
    time.sleep(1.5)
    with RawSocket(SOCKET, RealClock()) as witness:
        for frame in (encode(Class.BUS_OFF, tec=255, rec=0), encode(Class.RESTARTED, tec=0)):
            subprocess.run(["cansend", "vcan0", f"{frame.can_id:08X}#{frame.data.hex()}"], check=True)
            time.sleep(0.2)
        heard: list[Frame] = []
        while [f.data[:2] for f in heard if f.can_id == 0x81][-1:] != [bytes(2)]:  # the drive has said its last word
            heard += [frame for _, frame in wait_any([witness], 10.0)[0]]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, virtual_time: bool) -> Session:
    return run_session(tmp_path_factory.mktemp("vcan"), virtual_time=virtual_time)


def motion_frames(recording: Path) -> list[Frame]:
    """All frames of a recording, in order."""
    text = recording.with_suffix(".log")
    export(recording, text)
    return [parse_line(line)[2] for line in text.read_text().splitlines()]


def parameters(recording: Recording) -> dict[str, float]:
    """Identified from one recording."""
    [found] = identify([signals(recording)], load("emps"))
    return {row.name: row.value for row in found.result.parameters}


def test_the_run_is_lossless_and_on_time(session: Session, virtual_time: bool) -> None:
    assert "LOSSLESS" in session.recorded
    assert " 0 without an answer from every drive" in session.host
    if virtual_time:
        assert " 0 late by more than a tenth of a period" in session.host


def test_candump_has_heard_the_same_frames_in_the_same_order(session: Session) -> None:
    """Our recorder beside the reference: everything from the first SYNC to the last, frame for frame."""
    theirs = [parse_line(line)[2] for line in session.dump]
    ours = motion_frames(session.folder / "run.mcap")
    begin, end = Frame(0x80, b"\x01"), max(k for k, f in enumerate(ours) if f.can_id == 0x80)
    assert len(ours) > 3 * 500
    mine = ours[ours.index(begin) : end]
    assert theirs[theirs.index(begin) :][: len(mine)] == mine


def test_the_parameters_come_back(session: Session) -> None:
    found, truth = parameters(session.recording("run.mcap")), truth_values(load("emps"), load("emps"))
    assert np.allclose([found[name] for name in truth], list(truth.values()), rtol=0.1)  # three seconds of motion


def test_what_the_kernel_dropped_while_the_recorder_was_held_is_counted_to_the_frame(session: Session) -> None:
    """Frames in the file and frames counted as lost make up all that the interface has carried, by its own count."""
    recording = session.recording("abused.mcap")
    kept = motion_frames(session.folder / "abused.mcap")
    lost = [int(n) for e in recording.events for n in re.findall(r"^(\d+) frames were lost", e.text)]
    assert sum(f.can_id == 0x7C0 for f in kept) + sum(lost) >= FLOOD
    assert 0 < sum(lost) < FLOOD
    assert len(kept) + sum(lost) == session.passed
    assert recording.verdict == f"GAPS({sum(lost)})"


def test_a_controller_off_the_bus_is_in_the_recording(session: Session, virtual_time: bool) -> None:
    """C1: the event, and how long it took."""
    said = [e.text for e in session.recording("abused.mcap").events if e.text.startswith("error frame")]
    assert said[0].startswith("error frame: BUS OFF: the controller has left the bus")
    took = re.findall(r"controller restarted.* after (\d\.\d{3}) s off the bus", said[1])
    assert 0.2 <= float(took[0]) < (0.3 if virtual_time else 60)


def test_emulated_drives_hear_of_it_too(session: Session) -> None:
    """C1: while off the bus a drive is silent; back on it, it says so (EMCY 8140h, then no error)."""
    frames = motion_frames(session.folder / "abused.mcap")
    off = next(k for k, f in enumerate(frames) if f.can_id == encode(Class.BUS_OFF, tec=255).can_id)
    back = next(k for k, f in enumerate(frames) if f.can_id == encode(Class.RESTARTED, tec=0).can_id)
    assert not [f for f in frames[off:back] if 0 < f.can_id < 0x800]
    emergencies = [f.data[:2].hex() for f in frames[back:] if f.can_id == 0x81]
    assert emergencies == ["4081", "0000"]


def test_canplayer_plays_a_recording_that_is_then_recorded_again(session: Session, tmp_path: Path) -> None:
    """Out through `armrig export`, onto the other bus by canplayer, back in through the recorder: the same frames."""
    rig, robot = load_rig(str(session.folder / "rig.toml"))
    sent = motion_frames(session.folder / "run.mcap")
    again, clock = tmp_path / "again.mcap", RealClock()
    writer = Writer(Recorder(again, rig, robot), ["can0"])
    writer.start()
    with RawSocket(Bus(name="can0", interface="socketcan", channel="vcan1"), clock) as listener:
        player = subprocess.Popen(["canplayer", "-I", str(session.folder / "run.log"), "vcan1=can0"])
        record(writer, [listener], clock, threading.Event(), quiet=Quiet(3.0))
        assert player.wait() == 0
    assert writer.finish().verdict == "LOSSLESS"
    assert motion_frames(again) == sent


def test_it_repeats_to_the_byte(session: Session, tmp_path: Path, virtual_time: bool) -> None:
    """In virtual time: another session, the same cycles and the same parameters, to the last bit."""
    if not virtual_time:
        pytest.skip("in real time no two runs are alike; VCAN_MODE=vtime runs this")
    once, again = session, run_session(tmp_path, virtual_time=True, abuse=False)
    one, other = once.recording("run.mcap"), again.recording("run.mcap")
    assert one.drives is not None
    assert other.drives is not None
    for field in ("position_counts", "current_permille", "counter"):
        assert getattr(one.drives, field).tobytes() == getattr(other.drives, field).tobytes()
    assert parameters(one) == parameters(other)
