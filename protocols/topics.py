"""What is in a recording: one table of all topics, types and rates, and the metadata around them.

Stamps are nanoseconds since the run started. Everything decoded carries grid time (SYNC index times period);
arrival times stay beside the raw frames, as evidence of jitter.

MCAP `log_time` is arrival time, `publish_time` is grid time where there is one, `sequence` counts per channel.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import msgspec

from protocols.cdr import MessageType

_HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

FRAME = MessageType.parse(
    "can_msgs/msg/Frame",
    f"""std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
{_HEADER}""",
)

JOINT_STATE = MessageType.parse(
    "sensor_msgs/msg/JointState",
    f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
)

DRIVE_CYCLE = MessageType.parse(
    "armrig_msgs/msg/DriveCycle",
    f"""# Raw integers of one SYNC, drives in the order of the robot file's joints
std_msgs/Header header  # stamp: cycle times period; frame_id: names of the joints, separated by spaces
uint64 cycle  # SYNC index
int32[] position_counts  # 0x6064
int32[] current_permille  # 0x6078, of the rated current
uint16[] counter  # 0x2001, SYNCs the drive consumed
bool[] missing  # the drive's TPDO1 was not received: its three values are 0
{_HEADER}""",
)

CELL_IO = MessageType.parse(
    "armrig_msgs/msg/CellIo",
    f"""# ROS 2 wants lower case: temperatures in degrees Celsius, supply in volts
std_msgs/Header header
float32[] motor_temperature_c
float32 ambient_temperature_c
float32 supply_v
bool emergency_stop
bool brake_released
uint16 heartbeat
uint16 sequence
bool stale  # the cell did not answer: the values are those of the last answer
{_HEADER}""",
)

EVENT = MessageType.parse(
    "rcl_interfaces/msg/Log",
    """byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line

================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
)

INTEGRITY = MessageType.parse(
    "armrig_msgs/msg/Integrity",
    f"""# Totals since the run started
std_msgs/Header header
string verdict
string[] bus
uint64[] frames
uint64[] syncs
uint64[] syncs_lost
uint64[] syncs_duplicated
string[] joint
uint64[] feedback
uint64[] feedback_lost
uint64[] feedback_duplicated
uint64 malformed  # frames of a known COB-ID with a wrong length
uint64 dropped  # by the socket or by our own queue
uint64 queue_high_water  # frames that waited for the writer at the worst moment
{_HEADER}""",
)


class Topic(NamedTuple):
    """A row of the table.

    Attributes:
        name: `{bus}` stands for the rig's name of each bus.
        rate: In words.
    """

    name: str
    type: MessageType
    rate: str

    def names(self, buses: Iterable[str]) -> list[str]:
        """Topics of a rig with these buses."""
        return [self.name.format(bus=bus) for bus in buses] if "{bus}" in self.name else [self.name]


FRAMES = "/{bus}/frames"
CYCLE = "/drives/cycle"
JOINTS = "/joint_states"
CELL = "/cell/io"
EVENTS = "/rig/events"
COUNTERS = "/rig/integrity"

TOPICS = (
    Topic(FRAMES, FRAME, "every frame, as received"),
    Topic(CYCLE, DRIVE_CYCLE, "every SYNC: raw integers"),
    Topic(JOINTS, JOINT_STATE, "every SYNC: SI units, joint side; effort from the nominal drive gains"),
    Topic(CELL, CELL_IO, "cell.poll_Hz"),
    Topic(EVENTS, EVENT, "when something happens"),
    Topic(COUNTERS, INTEGRITY, "1 Hz and at the end"),
)

PROFILE = "ros2"
ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"

ROBOT_FILE = "robot.toml"  # names of attachments
RIG_FILE = "rig.toml"
TOML_TYPE = "application/toml"
EDS_TYPE = "text/plain"

RUN_START = "RunStart"  # names of metadata records
RUN_STOP = "RunStop"
RECOVERED = "Recovered"

LEVELS = {10: "debug", 20: "info", 30: "warning", 40: "error", 50: "fatal"}
INFO, WARNING, ERROR_LEVEL = 20, 30, 40


class Event(NamedTuple):
    """Something that happened, in the rig's words.

    Attributes:
        t_ns: Arrival, since the run started.
        level: A key of `LEVELS`.
        source: Who: the name of a joint, bus or part.
    """

    t_ns: int
    level: int
    source: str
    text: str


class CellSample(NamedTuple):
    """One poll of the cell."""

    t_ns: int
    motor_temperature_C: tuple[float, ...]
    ambient_temperature_C: float
    supply_V: float
    emergency_stop: bool
    brake_released: bool
    heartbeat: int
    sequence: int
    stale: bool


class RunStart(msgspec.Struct, frozen=True, kw_only=True):
    """All that is known before the first frame.

    Attributes:
        created_utc: ISO 8601, the one wall-clock date of a recording.
        seed: Of everything random, where the rig is emulated.
        armrig, python: Versions.
        joints: In the order of all arrays, separated by spaces.
        sync_period_us: Of the time grid.
        sha256: Of each attachment by name.
    """

    created_utc: str
    seed: str
    armrig: str
    python: str
    robot: str
    rig: str
    joints: str
    sync_period_us: str
    sha256: dict[str, str]

    def to_metadata(self) -> dict[str, str]:
        """Flat strings, as MCAP wants them."""
        flat: dict[str, str] = msgspec.to_builtins(self)
        del flat["sha256"]
        return flat | {f"sha256:{name}": digest for name, digest in self.sha256.items()}

    @classmethod
    def of_metadata(cls, flat: Mapping[str, str]) -> "RunStart":
        """Value of a metadata record; what is missing is empty."""
        digests = {k.removeprefix("sha256:"): v for k, v in flat.items() if k.startswith("sha256:")}
        return cls(sha256=digests, **{n: flat.get(n, "") for n in cls.__struct_fields__ if n != "sha256"})


def stamp(t_ns: int) -> dict[str, int]:
    """Fields of a header's stamp."""
    return {"header.stamp.sec": t_ns // 1_000_000_000, "header.stamp.nanosec": t_ns % 1_000_000_000}
