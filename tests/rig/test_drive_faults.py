"""What goes wrong in a drive, and what drive, host and recorder make of it (rows C3 to C10 of the fault table)."""

import re

import pytest

from daq.decode import Decoder
from daq.integrity import Integrity
from emulator.faults import parse_fault
from emulator.host import Host
from emulator.impaired import garbage
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols import config, nmt
from protocols.cia402 import Mode, State
from protocols.errors import PeerError
from protocols.frames import Frame
from protocols.motion import Motion
from protocols.rig import load_rig

PERIOD = 1_000_000
T0 = 0.6  # the arm moves by then


class Run:
    """One motion of the one-axis rig with faults.

    Attributes:
        error: What the host said in the end; empty if it was content.
        events: What the recorder noticed, as text.
    """

    def __init__(self, *faults: str, mode: Mode = Mode.CST, motion: str = "emps-test", seconds: float = 1.6) -> None:
        files, robot = load_rig("emps-rig")
        self.rig = EmulatedRig(files, load_machine(files, robot))
        for text in faults:
            self.rig.schedule(parse_fault(text))
        decoder = Decoder(files, robot, Integrity.of([b.name for b in files.bus], robot.joint_names))
        self.frames: list[tuple[int, Frame]] = []
        plan = config.read(config.locate(motion), Motion)
        host = Host(files, robot, plan, mode)

        def tap(t_ns: int, bus: int, frames: list[Frame]) -> None:
            self.frames += [(t_ns, f) for f in frames]
            decoder.feed(files.bus[bus].name, [(t_ns, f) for f in frames])

        count = iter(range(10**9))
        self.error = ""
        try:
            lockstep(self.rig, host, PERIOD, tap, lambda: next(count) > 1000 * seconds)
        except PeerError as error:
            self.error = str(error)
        decoder.finish()
        self.cycles = decoder.take_cycles()
        self.events = [event.text for event in decoder.take_events()]
        self.drive = self.rig.drives[0]

    def saw(self, pattern: str) -> bool:
        """Whether the recorder has an event like that."""
        return any(re.search(pattern, text) for text in self.events)


@pytest.fixture(scope="module")
def undisturbed() -> Run:
    return Run()


def test_without_faults_nothing_is_reported(undisturbed: Run) -> None:
    """Negative control of all that follows."""
    assert undisturbed.error == ""
    assert not undisturbed.saw("emergency|boot-up .* on|error") or sum("boot-up" in e for e in undisturbed.events) == 1
    assert undisturbed.drive.state is State.SWITCH_ON_DISABLED


def test_c3_lost_heartbeat_of_a_drive() -> None:
    run = Run(f"heartbeat-loss:t={T0}")
    assert re.search(r"no heartbeat for 0\.35 s after [\d.]+ s of motion; all drives are being switched off", run.error)
    assert run.drive.state is State.SWITCH_ON_DISABLED
    assert max(c.sync for c in run.cycles) > 700  # recording went on


def test_a_short_silence_is_forgiven() -> None:
    assert Run(f"heartbeat-loss:t={T0},for=0.15").error == ""


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("overcurrent", 0x2310),
        ("overtemperature", 0x4310),
        ("overvoltage", 0x3210),
        ("undervoltage", 0x3220),
        ("encoder", 0x7305),
        ("emcy", 0xFF07),
    ],
)
def test_c4_fault_of_a_drive(fault: str, code: int) -> None:
    run = Run(f"{fault}:t={T0}" + (f",code={code:X}" if fault == "emcy" else ""))
    assert f"the drive reports error {code:04X}h" in run.error
    assert run.saw(f"emergency 0x{code:04X}")
    assert run.drive.state is State.FAULT
    values = run.drive.device.store.values
    assert values[0x603F_00] == code and values[0x1003_01] == code and values[0x1001_00] & 1
    speeds = [abs(b.position[0] - a.position[0]) for a, b in zip(run.cycles, run.cycles[1:], strict=False)]
    assert max(speeds[-50:]) <= 8 < max(speeds) / 10  # at rest, but for the encoder's noise of one count


def test_c5_reset_in_motion() -> None:
    run = Run(f"reset-node:t={T0}")
    assert "the drive has been reset after" in run.error
    boot_ups = [t for t, f in run.frames if f == Frame(nmt.heartbeat_id(1), b"\0")]
    assert len(boot_ups) == 2  # power on, and this one
    assert sum("boot-up of node 1" in text for text in run.events) == 2
    assert run.drive.device.state is nmt.State.PRE_OPERATIONAL


def test_c5_power_loss_is_a_reset_seen_from_outside() -> None:
    run = Run(f"power-loss:t={T0},for=0.1")
    assert "the drive has been reset after" in run.error
    silent = [t for t, f in run.frames if f.can_id in range(0x180, 0x200) and 0 <= t - T0 * 1e9 < 0.1e9]
    assert silent == []


def test_c5_reset_of_communication_and_leaving_operational() -> None:
    assert "the drive has been reset" in Run(f"reset-communication:t={T0}").error
    for kind in ("stop", "pre-operational"):
        run = Run(f"{kind}:t={T0}")
        assert "no heartbeat" not in run.error and run.drive.state is State.SWITCH_ON_DISABLED
        assert run.saw("is stopped|is pre-operational") or run.error


def test_c6_no_answer_to_sdo() -> None:
    run = Run("sdo-silence:for=2")
    assert re.search(r"did not answer SDO 1800:01 within 1\.0 s", run.error)


def test_c9_lost_sync_stops_the_drive() -> None:
    run = Run(f"sync-loss:t={T0}")
    assert "the drive reports error 8700h" in run.error
    assert run.saw("emergency 0x8700, synchronisation")
    assert run.drive.state is State.FAULT


def test_c9_jump_of_the_counter_is_a_warning() -> None:
    run = Run(f"sync-jump:t={T0},by=3")
    assert run.error == ""
    assert run.saw("emergency 0x8701, synchronisation")
    indices = [c.sync for c in run.cycles]
    assert indices == sorted(set(indices))  # the grid keeps its index, and no sample is there twice


def test_offline_drive() -> None:
    run = Run(f"offline:t={T0},for=1")
    assert "no heartbeat" in run.error or "left OPERATION ENABLED" in run.error
    assert run.saw("emergency 0x8140")


def test_c8_garbage_and_a_second_device() -> None:
    """Neither is an exception, nor moves the arm where it should not be."""
    run = Run(f"garbage:t={T0},count=500,seed=4", f"duplicate-node:t={T0 + 0.3}")
    assert run.drive.state is not State.OPERATION_ENABLED
    assert run.saw("boot-up of node 1")


def test_c8_the_host_goes_on_through_foreign_frames(undisturbed: Run) -> None:
    files, robot = load_rig("emps-rig")
    foreign = garbage(2000, 7)
    rig = EmulatedRig(files, load_machine(files, robot))
    rig.start(0)
    for n, frame in enumerate(foreign):
        rig.step(n * PERIOD, [[frame]])
    assert rig.drives[0].state in State and rig.drives[0].device.ignored > 0
