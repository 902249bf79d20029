"""Candump text of the emulated rig, read by Wireshark's CANopen dissector and by can-utils."""

import shutil
import subprocess
from pathlib import Path

import pytest

from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols.candump import format_frame
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.motion import Motion, Standstill
from protocols.rig import load_rig

needs_tshark = pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is absent: apt-get install tshark")
needs_canutils = pytest.mark.skipif(shutil.which("log2asc") is None, reason="no can-utils: apt-get install can-utils")
pytestmark = pytest.mark.stranger

SPECIAL = [
    Frame(0x085, bytes.fromhex("1023040001020304")),  # EMCY 0x2310, continuous over-current
    Frame(0x585, bytes.fromhex("8010100000000206")),  # abort 0x06020000 of object 0x1010
    Frame(0x12345678 | EXTENDED, b"\x01"),
    Frame(0x705 | REMOTE, b"", 1),
    Frame(0x040 | ERROR, bytes(8)),
]


@pytest.fixture(scope="module")
def frames() -> list[tuple[int, str, Frame]]:
    """All that passes while the TX40 is configured, enabled, approaches and stands still: (t_ns, bus, frame)."""
    rig, robot = load_rig("tx40-rig")
    names = [b.name for b in rig.bus]
    passed: list[tuple[int, str, Frame]] = []
    lockstep(
        EmulatedRig(rig, load_machine(rig, robot)),
        Host(rig, robot, Motion(name="short", approach_s=0.2, segment=[Standstill(duration_s=0.1)])),
        rig.sync_period_us * 1000,
        lambda t_ns, bus, burst: passed.extend((t_ns, names[bus], frame) for frame in burst),
    )
    end_ns = passed[-1][0]
    return passed + [(end_ns + 1000 * n, "can0", frame) for n, frame in enumerate(SPECIAL, 1)]


@pytest.fixture(scope="module")
def log(frames: list[tuple[int, str, Frame]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("candump") / "run.log"
    path.write_text("".join(format_frame(*row) + "\n" for row in frames))
    return path


def dissect(path: Path, *fields: str) -> list[list[str]]:
    """One row of the named fields per frame, as tshark decodes them."""
    command = ["tshark", "-r", str(path), "-d", "can.subdissector,canopen", "-T", "fields"]
    done = subprocess.run(
        [*command, *(part for field in fields for part in ("-e", field))], capture_output=True, text=True, check=True
    )
    return [line.split("\t") for line in done.stdout.splitlines()]


@needs_tshark
def test_wireshark_finds_every_frame_and_none_malformed(frames: list[tuple[int, str, Frame]], log: Path) -> None:
    rows = dissect(log, "frame.time_epoch", "can.id", "can.flags.xtd", "can.flags.rtr", "can.len", "_ws.malformed")
    assert len(rows) == len(frames) > 2000
    for (t_ns, _, frame), (stamp, can_id, extended, remote, length, malformed) in zip(frames, rows, strict=True):
        assert round(float(stamp) * 1e6) == t_ns // 1000
        if not frame.can_id & ERROR:
            flags = int(extended) * EXTENDED | int(remote) * REMOTE
            assert int(can_id) | flags == frame.can_id
        assert int(length) == (frame.dlc or len(frame.data))
        assert malformed == ""


@needs_tshark
def test_wireshark_reads_the_same_canopen(frames: list[tuple[int, str, Frame]], log: Path) -> None:
    rows = dissect(log, "canopen.sync.counter", "canopen.pdo.data.bytes", "canopen.nmt_ctrl.cd", "canopen.sdo.cmd")
    for (_, _, frame), (counter, pdo, command, sdo) in zip(frames, rows, strict=True):
        function = frame.can_id & ~0x7F if frame.can_id < 0x800 else None
        if frame.can_id == 0x080:
            assert int(counter) == frame.data[0]
        elif frame.can_id == 0x000:
            assert int(command, 0) == frame.data[0]
        elif function in {0x180, 0x200, 0x280, 0x300}:
            assert bytes.fromhex(pdo) == frame.data
        elif function in {0x580, 0x600}:
            assert int(sdo, 0) == frame.data[0]


@needs_tshark
def test_wireshark_reads_emergencies_aborts_and_bus_off(log: Path) -> None:
    rows = dissect(log, "canopen.em.err_code", "canopen.sdo.abort_code", "canopen.sdo.main_idx")[-len(SPECIAL) :]
    assert int(rows[0][0], 0) == 0x2310
    assert (int(rows[1][1], 0), int(rows[1][2], 0)) == (0x0602_0000, 0x1010)
    done = subprocess.run(["tshark", "-r", str(log)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].endswith("ERR: Bus off")


@needs_tshark
def test_wireshark_does_notice_a_malformed_frame(tmp_path: Path) -> None:
    """Negative control of the check above: an SDO request without its object."""
    path = tmp_path / "bad.log"
    path.write_text(format_frame(0, "can0", Frame(0x601, b"\x40")) + "\n")
    assert "Malformed" in dissect(path, "_ws.malformed")[0][0]


@needs_canutils
def test_can_utils_read_the_same_frames(frames: list[tuple[int, str, Frame]], log: Path) -> None:
    """log2asc parses candump text with can-utils' own reader and prints what it understood."""
    buses = ["can0", "can1"]
    done = subprocess.run(["log2asc", "-I", str(log), *buses], capture_output=True, text=True, check=True)
    rows = [line.split() for line in done.stdout.splitlines() if "Rx" in line or "ErrorFrame" in line]
    assert len(rows) == len(frames)
    for (_, bus, frame), row in zip(frames, rows, strict=True):
        assert row[1] == str(buses.index(bus) + 1)
        if frame.can_id & ERROR:
            assert row[2] == "ErrorFrame"
            continue
        ident = row[2].removesuffix("x")
        assert int(ident, 16) | (EXTENDED if row[2].endswith("x") else 0) == frame.can_id & ~REMOTE
        if frame.can_id & REMOTE:
            assert row[4:] == ["r", str(frame.dlc)]
        else:
            assert row[4:6] == ["d", str(len(frame.data))]
            assert bytes.fromhex("".join(row[6:])) == frame.data
