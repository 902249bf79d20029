"""Random and mutated frames into a drive, the motion host and the recorder's decoder: no exception, no illegal state,
no memory that grows. Run: python tests/studies/fuzz.py [--frames N] [--seed S]; `make fuzz` takes 10 million.

Every third frame is random, the others are mutations of what is said on a real bus: a bit flipped, a byte changed, cut
short, moved to another identifier, flagged as remote or 29-bit.
"""

import argparse
import random
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from daq.decode import Decoder
from daq.integrity import Integrity
from emulator.axis import Measurement
from emulator.drive import Drive
from emulator.host import Host
from protocols import cia402, config, emcy, lss, nmt, pdo, sdo, sdoblock
from protocols.errors import PeerError
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.motion import Motion
from protocols.rig import load_rig

NODE = 1
LEGAL = {
    cia402.State.OPERATION_ENABLED: {0, 8, 10},
    cia402.State.QUICK_STOP_ACTIVE: {8},
    cia402.State.FAULT_REACTION_ACTIVE: {8},
}
CHUNK = 5000  # frames between two looks at everything
GROWTH_KB = 8192  # what Python may keep for itself between the first quarter and the end


def conversation(drive: Drive) -> list[Frame]:
    """Sound frames of every service."""
    request, response = nmt.sdo_request_id(NODE), nmt.sdo_response_id(NODE)
    identity = lss.Identity(0, 0x4152_4D52, 0x0001_0000, NODE)
    frames = [nmt.command(c, n) for c in nmt.Command for n in (0, NODE)]
    frames += [
        Frame(request, sdo.Upload(e.index, e.sub).request()) for e in drive.device.store.dictionary.entries.values()
    ]
    for entry in drive.device.store.dictionary.entries.values():
        if entry.writable and entry.bits:
            for value in (0, 1, 2, 0xFF):
                frames.append(
                    Frame(
                        request,
                        sdo.Download(entry.index, entry.sub, bytes((value,)).ljust(entry.bits // 8, b"\0")).request(),
                    )
                )
    for number in (1, 3):
        mapped = [pdo.Mapped.parse(t) for t in ("6064:0/32", "6041:0/16")]
        frames += [
            Frame(request, sdo.Download(*w).request())
            for w in pdo.configuration(pdo.TRANSMIT, number, nmt.tpdo_id(number, NODE), mapped, 1)
        ]
    frames += [Frame(request, sdo.Download(i, 1, text).request()) for i, text in ((0x1010, b"save"), (0x1011, b"load"))]
    frames += [Frame(request, sdoblock.BlockUpload(i).request()) for i in (0x1008, 0x2041)]
    frames += [Frame(request, sdoblock.BlockDownload(0x2000, 0, b"name").request())]
    frames += [
        Frame(request, bytes((b, 1, 5)).ljust(8, b"\0"))
        for b in (0xA3, 0xA2, 0xA1, 0x81, 0x01, 0xD9, 0x60, 0x70, 0x00, 0x80)
    ]
    frames += [Frame(response, f.data) for f in frames if f.can_id == request]
    words = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x5F, 0x80, 0x10F)
    frames += [Frame(nmt.rpdo_id(1, NODE), struct.pack("<Hb", w, m)) for w in words for m in cia402.Mode]
    frames += [Frame(nmt.rpdo_id(2, NODE), struct.pack("<hi", t, 1000 * t)) for t in (-500, 0, 300)]
    frames += [Frame(nmt.tpdo_id(1, NODE), struct.pack("<ihH", p, p, p & 0xFFFF)) for p in (-5, 0, 9)]
    frames += [Frame(nmt.tpdo_id(2, NODE), struct.pack("<HbH", s.pattern, 10, 0)) for s in cia402.State]
    frames += [emcy.encode(nmt.emcy_id(NODE), emcy.Emergency(c, 1)) for c in emcy.Code]
    frames += [nmt.heartbeat(n, s) for n in (NODE, 127) for s in nmt.State]
    frames += [nmt.guard_request(NODE), Frame(nmt.tpdo_id(1, NODE) | REMOTE, b"", 8), Frame(nmt.TIME, bytes(6))]
    frames += lss.select(identity) + [lss.message(s, 1, 2) for s in lss.Service]
    frames += [Frame(ERROR | bits, bytes(8)) for bits in (0x004, 0x040, 0x100)]
    return frames


def mutations(sound: list[Frame], rng: random.Random) -> Iterator[Frame]:
    """Endless."""
    while True:
        if rng.random() < 1 / 3:
            yield Frame(rng.randrange(0x800), rng.randbytes(rng.randrange(9)))
            continue
        frame = rng.choice(sound)
        can_id, data = frame.can_id, bytearray(frame.data)
        match rng.randrange(7):
            case 0 if data:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
            case 2:
                data = data[: rng.randrange(len(data) + 1)]
            case 3:
                can_id = rng.randrange(0x800)
            case 4:
                can_id |= rng.choice((REMOTE, EXTENDED, ERROR))
            case 5 if data:
                data = bytearray(rng.randbytes(len(data)))
        yield Frame(can_id, b"" if can_id & REMOTE else bytes(data), frame.dlc if can_id & REMOTE else 0)


class FuzzedDrive:
    """A drive with a clock of its own; power off and on where LSS has sent it away."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._t_ns = 0
        _, robot = load_rig("emps-rig")
        self.drive = Drive(robot.joint[0].drive, NODE, travel=(-(10**6), 10**6))
        self.drive.start(0)
        self.sent = 0
        self.seen: set[tuple[cia402.State, int]] = set()  # states, with the mode displayed

    def feed(self, frames: list[Frame]) -> None:
        drive, rng = self.drive, self._rng
        measurement = Measurement(rng.randrange(-(2**33), 2**33), rng.randrange(-(2**33), 2**33), rng.uniform(-50, 50))
        for n, frame in enumerate(frames):
            if n % 50 == 0:
                self.feed_sound()
            answers = drive.receive(self._t_ns, frame)
            if n % 4 == 0:
                self._t_ns += rng.choice((100_000, 1_000_000, 60_000_000))
                answers += drive.on_sync(self._t_ns, n % 241, measurement) + drive.tick(self._t_ns)
                drive.record([n] * 10, [0.1] * 10)
            self.sent += len(answers)
            if any(not 0 <= f.can_id <= 0x7FF or len(f.data) > 8 for f in answers):
                raise SystemExit(f"the drive sent {answers} after {frame}")
            self.check(frame)
        for entry in drive.device.store.dictionary.entries.values():
            entry.encode(drive.device.store.values[entry.key])  # every value fits its type
        drive.device.store.saved.clear()
        lss_server = drive.device._lss  # somebody brings it back with a service tool
        lss_server.stored_node_id, lss_server.stored_bit_rate = NODE, 1_000_000
        drive.start(self._t_ns)

    def feed_sound(self) -> None:
        """A good part of the time it is to work, not to be off."""
        mode = self._rng.choice(list(cia402.Mode))
        self.drive.receive(self._t_ns, nmt.command(nmt.Command.START))
        for word in (0x80, 0x06, 0x07, 0x0F):
            self.drive.receive(self._t_ns, Frame(nmt.rpdo_id(1, NODE), struct.pack("<Hb", word, mode)))

    def check(self, after: Frame) -> None:
        drive = self.drive
        reported = cia402.state_of(drive.device.store.values[0x6041_00])
        self.seen.add((drive.state, drive.device.store.values[0x6061_00]))
        if reported is not drive.state or drive.command().mode not in LEGAL.get(drive.state, {0}):
            raise SystemExit(
                f"{drive.state} is reported as {reported}, power stage in {drive.command()}, after {after}"
            )


class FuzzedHost:
    """The motion host between mad drives; begins anew whenever it gives up, which it may."""

    def __init__(self) -> None:
        self._rig, self._robot = load_rig("emps-rig")
        self._plan = config.read(config.locate("emps-test"), Motion)
        self.given_up = 0
        self._begin()

    def _begin(self) -> None:
        self._script = Host(self._rig, self._robot, self._plan).script()
        next(self._script)

    def feed(self, frames: list[Frame]) -> None:
        for n in range(0, len(frames), 20):
            try:
                self._script.send([frames[n : n + 20]])
            except (PeerError, StopIteration):
                self.given_up += 1
                self._begin()


class FuzzedDecoder:
    """The recorder's decoder; its cycles and events are taken as the recorder takes them."""

    def __init__(self) -> None:
        rig, robot = load_rig("emps-rig")
        self._decoder = Decoder(rig, robot, Integrity.of([b.name for b in rig.bus], robot.joint_names))
        self._t_ns = 0
        self.cycles = self.events = 0

    def feed(self, frames: list[Frame]) -> None:
        batch = []
        for n, frame in enumerate(frames):
            self._t_ns += 50_000
            batch.append((self._t_ns, frame))
            if n % 20 == 0:
                batch.append((self._t_ns, nmt.sync(n // 20 % 240 + 1)))
        self._decoder.feed("can0", batch)
        self.cycles += len(self._decoder.take_cycles())
        self.events += len(self._decoder.take_events())


def resident_kB() -> int:
    """Memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


def fuzz(frames: int, seed: int, say: Callable[[str], None] = print) -> None:
    """Feed everything; SystemExit with a sentence when something is wrong."""
    rng = random.Random(seed)
    drive, host, decoder = FuzzedDrive(rng), FuzzedHost(), FuzzedDecoder()
    source = mutations(conversation(drive.drive), rng)
    begin, early_kB = time.monotonic(), 0
    for done in range(0, frames, CHUNK):
        batch = [next(source) for _ in range(min(CHUNK, frames - done))]
        sent = drive.sent
        for victim in (drive, host, decoder):
            victim.feed(batch)
        if not drive.sent > sent:
            raise SystemExit(f"the drive has sent nothing in {CHUNK} frames: it was not on the bus")
        if not early_kB and 4 * done >= frames:
            early_kB = resident_kB()
    growth_kB = resident_kB() - early_kB
    seconds = time.monotonic() - begin
    say(
        f"{frames} frames in {seconds:.0f} s ({frames / seconds:.0f} 1/s): drive sent {drive.sent} and was in"
        f" {len(drive.seen)} of {7 * len(cia402.Mode)} pairs of state and mode, host gave up"
        f" {host.given_up} times, decoder made {decoder.cycles} cycles and {decoder.events} events; memory grew by"
        f" {growth_kB} kB in the last three quarters"
    )
    missing = {s for s in cia402.State if s is not cia402.State.NOT_READY_TO_SWITCH_ON} - {s for s, _ in drive.seen}
    if missing:
        raise SystemExit(f"the drive never was in {', '.join(s.name for s in missing)}: more frames are needed")
    if growth_kB > GROWTH_KB:
        raise SystemExit(f"memory grew by {growth_kB} kB, more than {GROWTH_KB} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    fuzz(options.frames, options.seed)
