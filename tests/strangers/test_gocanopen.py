"""The emulated rig on its hub, driven by gocanopen (Go): scan, SDO, PDO configuration, NMT, CiA 402."""

import contextlib
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from emulator.bus import open_bus
from emulator.hub import Hub
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from emulator.shell import emulate
from protocols.clock import RealClock
from protocols.dictionary import drive_dictionary
from protocols.eds import eds
from protocols.objects import key
from protocols.rig import load_rig

SOURCE = Path(__file__).parent / "gocanopen"
NODE = 2

pytestmark = [
    pytest.mark.stranger,
    pytest.mark.system,
    pytest.mark.skipif(shutil.which("go") is None, reason="go is absent: https://go.dev/dl"),
]


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled program."""
    fetched = subprocess.run(["go", "mod", "download"], cwd=SOURCE, check=False, capture_output=True, text=True)
    if fetched.returncode:
        pytest.skip(f"gocanopen cannot be fetched: {fetched.stderr.strip()[-200:]}")
    program = tmp_path_factory.mktemp("gocanopen") / "master"
    subprocess.run(["go", "build", "-o", str(program), "."], cwd=SOURCE, check=True)
    return program


@pytest.fixture
def channel() -> Iterator[str]:
    """The TX40 rig in real time on hub buses of its own; the channel of `can0`, where nodes 1 to 3 are."""
    rig, robot = load_rig("tx40-rig")
    machine = load_machine(rig, robot)
    rehearsal = EmulatedRig(rig, machine)  # compiles the kernels, which takes longer than a scan waits
    rehearsal.start(0)
    rehearsal.step(1_000_000_000, [[] for _ in rig.bus])
    arm = EmulatedRig(rig, machine)
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        hub = stack.enter_context(Hub([(b.name, "127.0.0.1:0") for b in rig.bus]))
        forwarding = threading.Thread(target=hub.run)
        forwarding.start()
        stack.callback(forwarding.join)
        stack.callback(hub.stop)
        opened = [msgspec.structs.replace(b, channel=hub.channels[b.name]) for b in rig.bus]
        buses = [stack.enter_context(open_bus(b)) for b in opened]
        running = threading.Thread(target=emulate, args=(arm, buses, RealClock(), stop))
        running.start()
        stack.callback(running.join)
        stack.callback(stop.set)
        yield opened[0].channel


def test_a_foreign_master_finds_configures_and_enables_a_drive(master: Path, channel: str, tmp_path: Path) -> None:
    _, robot = load_rig("tx40-rig")
    sheet = tmp_path / "drive.eds"
    dictionary = drive_dictionary(robot.joint[NODE - 1].drive)
    sheet.write_text(eds(dictionary, sheet.name))
    done = subprocess.run(
        [str(master), channel, str(NODE), str(sheet)], check=False, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    seen = dict(line.removeprefix("ok ").split(": ", 1) for line in done.stdout.splitlines())
    assert seen["scan"] == "[1 2 3]"
    assert seen["identity"] == 'product 41524D52 "armrig servo drive"'
    assert seen["aborts"] == "no object, no sub-index, read only, too long"
    assert seen["heartbeat"] == "every 20 ms"
    assert seen["read PDO"] == "182 type 1 6064:0/32 6078:0/16 2001:0/16"
    assert seen["configure PDO"] == "382 type 2, 2 objects"
    assert seen["PDOs on SYNC"] == "20 SYNCs: TPDO1 20, TPDO3 5 then 0"
    assert seen["data sheet"].endswith(f"supported modes {dictionary.defaults(NODE)[key(0x6502)]:08X}")
    assert seen["CiA 402"] == "0240 0231 0233 0237 0233 0231 0240"
    assert seen["reset"] == "one boot-up, defaults restored"
    assert seen["stopped"].startswith("silence, then statusword 02")
