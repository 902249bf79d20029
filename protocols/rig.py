"""`rig.toml`: which drives sit on which bus, how fast they cycle, and where cell, recorder and services are."""

from typing import Annotated

import msgspec
from msgspec import Meta

from protocols import config
from protocols.errors import ConfigError
from protocols.frames import bus_load
from protocols.robot import EffectEntry, Robot, load

Port = Annotated[int, Meta(ge=0, le=65535)]
NodeId = Annotated[int, Meta(ge=1, le=127)]

FULL_BUS = 1.0  # worst-case share above which no hardware can carry the traffic
BUSY_BUS = 0.8  # share above which a warning is due: vendors advise at most 70 to 80 %


class Bus(config.Table, frozen=True, kw_only=True):
    """One CAN bus.

    Attributes:
        name: Shown in recordings (`/can0/frames`).
        interface: A python-can interface (`socketcan`, ...) or `virtualcan`, the hub that comes with armrig.
        channel: `vcan0` for socketcan; `HOST:PORT` or `unix:PATH` for virtualcan.
        bitrate: [bit/s]; also what the load is computed from.
    """

    name: str
    interface: str = "virtualcan"
    channel: str
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000


class DriveNode(config.Table, frozen=True, kw_only=True):
    """Where one axis' drive is."""

    joint: str
    bus: str
    node: NodeId


class Pdo(config.Table, frozen=True, kw_only=True):
    """Objects in the two cyclic PDOs, `index:subindex/bits` in hexadecimal, configured by the host at start.

    Attributes:
        feedback: TPDO1, sent on every SYNC.
        target: RPDO2, active from the next SYNC.
    """

    feedback: tuple[str, ...] = ("6064:0/32", "6078:0/16", "2001:0/16")
    target: tuple[str, ...] = ("6071:0/16", "607A:0/32")


class Cell(config.Table, frozen=True, kw_only=True):
    """The cell's Modbus/TCP device."""

    host: str = "127.0.0.1"
    port: Port = 5020
    unit: Annotated[int, Meta(ge=1, le=247)] = 1
    poll_Hz: Annotated[float, Meta(gt=0, le=100)] = 20.0


class Recorder(config.Table, frozen=True, kw_only=True):
    """How recordings are written. Bounded loss: at most `flush_ms` of data when the power goes."""

    chunk_bytes: Annotated[int, Meta(ge=4096, le=16 * 2**20)] = 256 * 1024
    flush_ms: Annotated[int, Meta(ge=10, le=10_000)] = 250


class Zenoh(config.Table, frozen=True, kw_only=True):
    """Endpoint of the identification service; explicit, no multicast scouting."""

    endpoint: str = "tcp/127.0.0.1:7447"


class Emulated(config.Table, frozen=True, kw_only=True):
    """What only the emulator knows. Never attached to a recording.

    Attributes:
        machine: Robot file with the true parameters; the nominal robot where left out.
        seed: Of everything random.
        current_noise_A: Standard deviation of 0x6078 before rounding, per axis; one value stands for all.
        encoder_noise_rad: Standard deviation of the position on the joint side, before quantisation, per axis.
        effect: Physics beyond the robot file.
    """

    machine: str | None = None
    seed: int = 1
    current_noise_A: tuple[float, ...] = (0.0,)
    encoder_noise_rad: tuple[float, ...] = (0.0,)
    effect: list[EffectEntry] = []


class Rig(config.Table, frozen=True, kw_only=True):
    """One test rig.

    Attributes:
        robot: Robot file, or the name of a shipped robot.
        sync_period_us: Cycle time; SYNC is the rig's clock.
        sync_overflow: 0x1019, largest value of the SYNC counter.
    """

    name: str
    robot: str
    sync_period_us: Annotated[int, Meta(ge=250, le=1_000_000)] = 1000
    sync_overflow: Annotated[int, Meta(ge=2, le=240)] = 240
    bus: list[Bus]
    drive: list[DriveNode]
    pdo: Pdo = msgspec.field(default_factory=Pdo)
    cell: Cell | None = None
    recorder: Recorder = msgspec.field(default_factory=Recorder)
    zenoh: Zenoh = msgspec.field(default_factory=Zenoh)
    emulated: Emulated = msgspec.field(default_factory=Emulated)

    def __post_init__(self) -> None:
        names = [b.name for b in self.bus]
        if len(set(names)) != len(names):
            raise ValueError(f"bus names must differ, not {', '.join(names)}")
        nodes = [(d.bus, d.node) for d in self.drive]
        for drive in self.drive:
            if drive.bus not in names:
                raise ValueError(f"drive of {drive.joint}: bus {drive.bus} is not one of {', '.join(names)}")
            if nodes.count((drive.bus, drive.node)) > 1:
                raise ValueError(f"node {drive.node} appears twice on bus {drive.bus}")

    def loads(self) -> dict[str, float]:
        """Worst-case load of each bus, cyclic traffic both ways and SYNC; 1.0 is a full bus."""
        rate = 1e6 / self.sync_period_us
        sizes = [sum(int(o.rpartition("/")[2]) for o in layout) // 8 for layout in (self.pdo.feedback, self.pdo.target)]
        return {
            bus.name: bus_load(
                [(1, rate)] + [(size, rate) for d in self.drive if d.bus == bus.name for size in sizes],
                bus.bitrate,
            )
            for bus in self.bus
        }

    def for_recording(self) -> "Rig":
        """The rig as an acquisition system may know it: without `emulated`."""
        return msgspec.structs.replace(self, emulated=Emulated())


def load_rig(name: str) -> tuple[Rig, Robot]:
    """Rig of a file path or shipped name, with its robot.

    Raises:
        ConfigError: As `config.read`; a drive without a joint or a joint without a drive; a bus that cannot carry
            its own traffic.
    """
    path = config.locate(name)
    rig = config.read(path, Rig)
    robot = load(rig.robot, path.parent)
    check(rig, robot, str(path))
    return rig, robot


def check(rig: Rig, robot: Robot, source: str) -> None:
    """Refuse a rig that no hardware could be.

    Raises:
        ConfigError: See `load_rig`.
    """
    driven = [d.joint for d in rig.drive]
    if sorted(driven) != sorted(robot.joint_names):
        raise ConfigError(
            f"{source}: drives are given for {', '.join(driven)}, but {robot.name} has"
            f" {', '.join(robot.joint_names)}; every joint needs exactly one drive."
        )
    for bus, load_share in rig.loads().items():
        if load_share > FULL_BUS:
            count = sum(d.bus == bus for d in rig.drive)
            raise ConfigError(
                f"{source}: bus {bus} would be {100 * load_share:.0f} % full ({count} drives every"
                f" {rig.sync_period_us} us, worst case). Spread the drives over more buses or lengthen sync_period_us."
            )
