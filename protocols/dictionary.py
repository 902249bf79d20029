"""The object dictionary of armrig's drives: CiA 301 communication objects, CiA 402 drive objects, ours at 0x2000.

One table; every default that depends on the axis comes from its `robot.Drive`.
"""

import math
from fractions import Fraction

from protocols import nmt
from protocols.cia402 import SUPPORTED, Homing, supported_modes
from protocols.objects import Dictionary, Entry, Object, Type, array, record, sub, var
from protocols.robot import Drive

I8, I16, I32 = Type.INTEGER8, Type.INTEGER16, Type.INTEGER32
U8, U16, U32 = Type.UNSIGNED8, Type.UNSIGNED16, Type.UNSIGNED32
REAL32, STRING, DOMAIN = Type.REAL32, Type.VISIBLE_STRING, Type.DOMAIN

PDOS = 4  # of each direction, those with an identifier in the predefined connection set
ENTRIES = 8  # mapped objects per PDO: 64 bits of bytes
ERRORS = 8  # remembered in 0x1003
CONSUMERS = 4  # nodes that can be watched in 0x1016

SIGNATURE_SAVE = int.from_bytes(b"save", "little")  # what 0x1010 wants to be written
SIGNATURE_LOAD = int.from_bytes(b"load", "little")  # and 0x1011

INVALID = 0x8000_0000  # bit 31 of a COB-ID: not in use
PRODUCES = 0x4000_0000  # bit 30 of 0x1005: the device generates SYNC
CONSUMES = 0x8000_0000  # bit 31 of 0x1012: the device listens to TIME
NO_RTR = 0x4000_0000  # bit 30 of a TPDO's COB-ID: answers no remote frame

MOST_SAMPLES = 100_000  # of a drive's recorder: 20 s at 5 kHz

DEVICE_TYPE = 0x0002_0192  # servo drive, CiA 402
VENDOR = 0  # no vendor-id: none is assigned to an emulator
PRODUCT = 0x4152_4D52  # "ARMR"
REVISION = 0x0001_0000

PER_MILLE = 1000


def current_loop_gains(drive: Drive) -> tuple[float, float]:
    """Gain [V/A] and integral time [s] that cancel the winding's pole and close the loop at the axis' bandwidth."""
    gain = 2 * math.pi * drive.current_bandwidth_Hz * drive.inductance_H
    return gain, drive.inductance_H / drive.resistance_Ohm


def communication_objects() -> list[Object]:
    """CiA 301, without the PDOs."""
    return [
        var(0x1000, "Device type", U32, "const", DEVICE_TYPE),
        var(0x1001, "Error register", U8, "ro", 0, mappable=True),
        array(
            0x1003,
            "Pre-defined error field",
            sub(0, "Number of errors", U8, "rw", 0, high=ERRORS, volatile=True),
            *(sub(i, f"Standard error field {i}", U32, "ro", 0) for i in range(1, ERRORS + 1)),
        ),
        var(0x1005, "COB-ID SYNC", U32, "rw", nmt.SYNC),
        var(0x1006, "Communication cycle period", U32, "rw", 0, unit="us"),
        var(0x1007, "Synchronous window length", U32, "rw", 0, unit="us"),
        var(0x1008, "Manufacturer device name", STRING, "const", "armrig servo drive"),
        var(0x1009, "Manufacturer hardware version", STRING, "const", "emulated"),
        var(0x100A, "Manufacturer software version", STRING, "const", "0.1"),
        var(0x100C, "Guard time", U16, "rw", 0, unit="ms"),
        var(0x100D, "Life time factor", U8, "rw", 0),
        array(0x1010, "Store parameters", *_areas("Save", 1)),
        array(0x1011, "Restore default parameters", *_areas("Restore", 1)),
        var(0x1012, "COB-ID TIME", U32, "rw", nmt.TIME | CONSUMES),
        var(0x1014, "COB-ID EMCY", U32, "rw", nmt.emcy_id(0), node_relative=True),
        var(0x1015, "Inhibit time EMCY", U16, "rw", 0, unit="100 us"),
        array(
            0x1016,
            "Consumer heartbeat time",
            *(sub(i, f"Consumer heartbeat time {i}", U32, "rw", 0, unit="ms") for i in range(1, CONSUMERS + 1)),
        ),
        var(0x1017, "Producer heartbeat time", U16, "rw", 0, unit="ms"),
        record(
            0x1018,
            "Identity object",
            sub(1, "Vendor-ID", U32, "const", VENDOR),
            sub(2, "Product code", U32, "const", PRODUCT),
            sub(3, "Revision number", U32, "const", REVISION),
            sub(4, "Serial number", U32, "const", 0),
        ),
        var(0x1019, "Synchronous counter overflow value", U8, "rw", 0, high=240),
        array(0x1029, "Error behaviour", sub(1, "Communication error", U8, "rw", 0, high=2)),
        record(
            0x1200,
            "SDO server parameter",
            sub(1, "COB-ID client to server", U32, "const", nmt.sdo_request_id(0), node_relative=True),
            sub(2, "COB-ID server to client", U32, "const", nmt.sdo_response_id(0), node_relative=True),
        ),
    ]


def _areas(verb: str, default: int) -> list[Entry]:
    """What 0x1010 and 0x1011 can be asked for; reading tells that it happens on command (CiA 301, 7.5.2.13)."""
    areas = ("all", "communication", "application", "manufacturer")
    return [sub(i, f"{verb} {area} parameters", U32, "rw", default, volatile=True) for i, area in enumerate(areas, 1)]


def _mapping(index: int, name: str, objects: tuple[int, ...]) -> Object:
    words = objects + (0,) * (ENTRIES - len(objects))
    return record(
        index,
        name,
        sub(0, "Number of mapped objects", U8, "rw", len(objects)),
        *(sub(i, f"Mapped object {i}", U32, "rw", word) for i, word in enumerate(words, 1)),
    )


# Mapping words `index << 16 | sub << 8 | bits`, with the transmission type, of the PDOs in use after power on.
RPDO: dict[int, tuple[int, tuple[int, ...]]] = {
    1: (255, (0x6040_0010, 0x6060_0008)),
    2: (1, (0x6071_0010, 0x607A_0020)),
}
TPDO: dict[int, tuple[int, tuple[int, ...]]] = {
    1: (1, (0x6064_0020, 0x6078_0010, 0x2001_0010)),
    2: (255, (0x6041_0010, 0x6061_0008, 0x603F_0010)),
}
TPDO_INHIBIT = 10  # [100 us] of the event-driven ones: no fault may flood the bus


def pdo_objects() -> list[Object]:
    """PDO parameters; numbers without an entry above exist, but are not in use."""
    objects = []
    for n in range(1, PDOS + 1):
        kind, words = RPDO.get(n, (255, ()))
        cob_id = nmt.rpdo_id(n, 0) | (0 if words else INVALID)
        objects += [
            record(
                0x1400 + n - 1,
                f"RPDO {n} communication parameter",
                sub(1, "COB-ID used by RPDO", U32, "rw", cob_id, node_relative=True),
                sub(2, "Transmission type", U8, "rw", kind),
                sub(5, "Event timer", U16, "rw", 0, unit="ms"),
            ),
            _mapping(0x1600 + n - 1, f"RPDO {n} mapping parameter", words),
        ]
    for n in range(1, PDOS + 1):
        kind, words = TPDO.get(n, (255, ()))
        cob_id = nmt.tpdo_id(n, 0) | NO_RTR | (0 if words else INVALID)
        objects += [
            record(
                0x1800 + n - 1,
                f"TPDO {n} communication parameter",
                sub(1, "COB-ID used by TPDO", U32, "rw", cob_id, node_relative=True),
                sub(2, "Transmission type", U8, "rw", kind),
                sub(3, "Inhibit time", U16, "rw", TPDO_INHIBIT if kind >= 254 else 0, unit="100 us"),
                sub(5, "Event timer", U16, "rw", 0, unit="ms"),
                sub(6, "SYNC start value", U8, "rw", 0, high=240),
            ),
            _mapping(0x1A00 + n - 1, f"TPDO {n} mapping parameter", words),
        ]
    return objects


def manufacturer_objects(drive: Drive) -> list[Object]:
    """Ours. The current loop's gains have the names and types they have in the Pilz PRBT arm's drives."""
    gain, integral_s = current_loop_gains(drive)
    return [
        var(0x2000, "Axis name", STRING, "rw", ""),
        var(0x2001, "SYNC cycle counter", U16, "ro", 0, mappable=True),
        var(0x2002, "Drive gain", REAL32, "const", drive.drive_gain_Nm_A, unit="N·m/A"),
        var(0x2003, "SYNC timeout", U16, "rw", 100, unit="ms"),
        record(
            0x2004,
            "Time of day",
            sub(1, "Milliseconds after midnight", U32, "ro", 0, unit="ms"),
            sub(2, "Days since 1 January 1984", U16, "ro", 0),
        ),
        var(0x2010, "KR_Current", REAL32, "rw", gain, low=0.001, high=10_000, unit="V/A"),
        var(0x2011, "TN_Current", REAL32, "rw", PER_MILLE * integral_s, low=0.001, high=10_000, unit="ms"),
        record(
            0x2040,
            "Recorder",
            sub(1, "Control", U8, "rw", 0, high=1, volatile=True),
            sub(2, "State", U8, "ro", 0),
            sub(3, "Sample period", U16, "rw", 200, low=200, unit="us"),
            sub(4, "Samples", U32, "rw", 5000, low=1, high=MOST_SAMPLES),
            sub(5, "Trigger", U8, "rw", 0, high=4),
            sub(6, "Trigger level", I32, "rw", 0),
            sub(7, "Samples before the trigger", U32, "rw", 0, high=MOST_SAMPLES),
            sub(8, "Samples recorded", U32, "ro", 0),
            sub(9, "SYNC cycle counter at the trigger", U16, "ro", 0),
        ),
        var(0x2041, "Recorder data", DOMAIN, "ro", ""),
        var(0x2078, "Current actual value in mA", I32, "ro", 0, mappable=True, unit="mA"),
    ]


def drive_objects(drive: Drive) -> list[Object]:
    """CiA 402. Positions in encoder counts of the motor, velocities in counts/s, currents and torques in per mille of
    the rated ones: rated current makes rated torque."""
    torque = drive.torque_constant_Nm_A
    most = min(0xFFFF, round(PER_MILLE * drive.max_current_A / drive.rated_current_A))
    gear = Fraction(abs(drive.gear_ratio)).limit_denominator(10_000)
    turn = drive.encoder_counts_per_rev
    no_load_rev_s = drive.bus_voltage_V / torque / (2 * math.pi)
    fastest = min(0x7FFF_FFFF, round(no_load_rev_s * turn))
    return [
        var(0x6007, "Abort connection option code", I16, "rw", 1, low=0, high=3),
        var(0x603F, "Error code", U16, "ro", 0, mappable=True),
        var(0x6040, "Controlword", U16, "rw", 0, mappable=True, volatile=True),
        var(0x6041, "Statusword", U16, "ro", 0, mappable=True),
        var(0x605A, "Quick stop option code", I16, "rw", 2),
        var(0x605B, "Shutdown option code", I16, "rw", 0),
        var(0x605C, "Disable operation option code", I16, "rw", 1),
        var(0x605D, "Halt option code", I16, "rw", 1),
        var(0x605E, "Fault reaction option code", I16, "rw", 2),
        var(0x6060, "Modes of operation", I8, "rw", 0, mappable=True),
        var(0x6061, "Modes of operation display", I8, "ro", 0, mappable=True),
        var(0x6062, "Position demand value", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x6063, "Position actual internal value", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x6064, "Position actual value", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x6065, "Following error window", U32, "rw", turn, unit="counts"),
        var(0x6066, "Following error time out", U16, "rw", 50, unit="ms"),
        var(0x6067, "Position window", U32, "rw", turn // 100, unit="counts"),
        var(0x6068, "Position window time", U16, "rw", 10, unit="ms"),
        var(0x606B, "Velocity demand value", I32, "ro", 0, mappable=True, unit="counts/s"),
        var(0x606C, "Velocity actual value", I32, "ro", 0, mappable=True, unit="counts/s"),
        var(0x606D, "Velocity window", U16, "rw", min(0xFFFF, turn // 4), unit="counts/s"),
        var(0x606E, "Velocity window time", U16, "rw", 10, unit="ms"),
        var(0x606F, "Velocity threshold", U16, "rw", min(0xFFFF, turn // 4), unit="counts/s"),
        var(0x6070, "Velocity threshold time", U16, "rw", 10, unit="ms"),
        var(0x6071, "Target torque", I16, "rw", 0, mappable=True, unit="per mille", volatile=True),
        var(0x6072, "Max torque", U16, "rw", most, mappable=True, unit="per mille"),
        var(0x6073, "Max current", U16, "rw", most, unit="per mille"),
        var(0x6074, "Torque demand", I16, "ro", 0, mappable=True, unit="per mille"),
        var(0x6075, "Motor rated current", U32, "const", round(1000 * drive.rated_current_A), unit="mA"),
        var(0x6076, "Motor rated torque", U32, "const", round(1000 * torque * drive.rated_current_A), unit="mN·m"),
        var(0x6077, "Torque actual value", I16, "ro", 0, mappable=True, unit="per mille"),
        var(0x6078, "Current actual value", I16, "ro", 0, mappable=True, unit="per mille"),
        var(0x6079, "DC link circuit voltage", U32, "ro", round(1000 * drive.bus_voltage_V), mappable=True, unit="mV"),
        var(0x607A, "Target position", I32, "rw", 0, mappable=True, unit="counts", volatile=True),
        var(0x607C, "Home offset", I32, "rw", 0, unit="counts"),
        array(
            0x607D,
            "Software position limit",
            sub(1, "Min position limit", I32, "rw", -0x8000_0000, unit="counts"),
            sub(2, "Max position limit", I32, "rw", 0x7FFF_FFFF, unit="counts"),
        ),
        var(0x607F, "Max profile velocity", U32, "rw", fastest, unit="counts/s"),
        var(0x6080, "Max motor speed", U32, "rw", round(60 * no_load_rev_s), low=1, mappable=True, unit="1/min"),
        var(0x6081, "Profile velocity", U32, "rw", 10 * turn, mappable=True, unit="counts/s"),
        var(0x6083, "Profile acceleration", U32, "rw", 100 * turn, low=1, mappable=True, unit="counts/s²"),
        var(0x6084, "Profile deceleration", U32, "rw", 100 * turn, low=1, mappable=True, unit="counts/s²"),
        var(0x6085, "Quick stop deceleration", U32, "rw", 250 * turn, low=1, mappable=True, unit="counts/s²"),
        var(0x6087, "Torque slope", U32, "rw", 10_000, low=1, mappable=True, unit="per mille/s"),
        record(
            0x608F,
            "Position encoder resolution",
            sub(1, "Encoder increments", U32, "const", turn),
            sub(2, "Motor revolutions", U32, "const", 1),
        ),
        record(
            0x6091,
            "Gear ratio",
            sub(1, "Motor revolutions", U32, "const", gear.numerator),
            sub(2, "Shaft revolutions", U32, "const", gear.denominator),
        ),
        var(0x6098, "Homing method", I8, "rw", Homing.CURRENT_POSITION),
        array(
            0x6099,
            "Homing speeds",
            sub(1, "Speed during search for switch", U32, "rw", turn, low=1, unit="counts/s"),
            sub(2, "Speed during search for zero", U32, "rw", turn // 4, low=1, unit="counts/s"),
        ),
        var(0x609A, "Homing acceleration", U32, "rw", 10 * turn, low=1, unit="counts/s²"),
        var(0x60B0, "Position offset", I32, "rw", 0, mappable=True, unit="counts"),
        var(0x60B1, "Velocity offset", I32, "rw", 0, mappable=True, unit="counts/s"),
        var(0x60B2, "Torque offset", I16, "rw", 0, mappable=True, unit="per mille"),
        var(0x60B8, "Touch probe function", U16, "rw", 0, mappable=True, volatile=True),
        var(0x60B9, "Touch probe status", U16, "ro", 0, mappable=True),
        var(0x60BA, "Touch probe 1 positive edge", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x60BB, "Touch probe 1 negative edge", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x60C0, "Interpolation sub mode select", I16, "rw", 0, low=0, high=0),
        record(
            0x60C1,
            "Interpolation data record",
            sub(1, "Set-point", I32, "rw", 0, mappable=True, unit="counts", volatile=True),
        ),
        record(
            0x60C2,
            "Interpolation time period",
            sub(1, "Interpolation time period value", U8, "rw", 1),
            sub(2, "Interpolation time index", I8, "rw", -3, low=-6, high=0),
        ),
        var(0x60E0, "Positive torque limit value", U16, "rw", most, mappable=True, unit="per mille"),
        var(0x60E1, "Negative torque limit value", U16, "rw", most, mappable=True, unit="per mille"),
        array(
            0x60E3,
            "Supported homing methods",
            *(sub(i, f"Supported homing method {i}", I8, "const", m) for i, m in enumerate(list(Homing)[1:], 1)),
        ),
        var(0x60F4, "Following error actual value", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x60FC, "Position demand internal value", I32, "ro", 0, mappable=True, unit="counts"),
        var(0x60FD, "Digital inputs", U32, "ro", 0, mappable=True),
        var(0x60FF, "Target velocity", I32, "rw", 0, mappable=True, unit="counts/s", volatile=True),
        var(0x6502, "Supported drive modes", U32, "const", supported_modes(SUPPORTED)),
    ]


def drive_dictionary(drive: Drive) -> Dictionary:
    """Everything the CiA 402 device of one axis offers."""
    return Dictionary(communication_objects() + pdo_objects() + manufacturer_objects(drive) + drive_objects(drive))
