"""Network management: states, commands, heartbeats, and who may use which identifier (CiA 301, 7.2.8 and 7.3)."""

from collections.abc import Mapping
from enum import IntEnum

from protocols.frames import REMOTE, Frame

# Predefined connection set (CiA 301, table 38 and 39).
NMT = 0x000
SYNC = 0x080
TIME = 0x100

MAX_NODE = 127


class State(IntEnum):
    """NMT states as a heartbeat reports them (CiA 301, 7.2.8.3.2.2)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Command(IntEnum):
    """Command specifiers of the NMT master (CiA 301, 7.2.8.3.1)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


TRANSITIONS: Mapping[Command, State] = {  # from every state but INITIALISING; resets pass through that one
    Command.START: State.OPERATIONAL,
    Command.STOP: State.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: State.PRE_OPERATIONAL,
    Command.RESET_NODE: State.PRE_OPERATIONAL,
    Command.RESET_COMMUNICATION: State.PRE_OPERATIONAL,
}


def emcy_id(node: int) -> int:
    return 0x080 + node


def tpdo_id(number: int, node: int) -> int:
    """Default COB-ID of TPDO 1 to 4, seen from the device."""
    return 0x080 + 0x100 * number + node


def rpdo_id(number: int, node: int) -> int:
    """Default COB-ID of RPDO 1 to 4, seen from the device."""
    return 0x100 + 0x100 * number + node


def sdo_response_id(node: int) -> int:
    return 0x580 + node


def sdo_request_id(node: int) -> int:
    return 0x600 + node


def heartbeat_id(node: int) -> int:
    return 0x700 + node


_RESTRICTED = (  # CiA 301, table 41: no PDO, SYNC or EMCY may be moved here
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x77F),
    (0x780, 0x7FF),
)


def is_restricted(can_id: int) -> bool:
    """Whether the standard keeps an 11-bit identifier for itself."""
    return any(low <= can_id <= high for low, high in _RESTRICTED)


def command(what: Command, node: int = 0) -> Frame:
    """Command to one node, or to all (0)."""
    return Frame(NMT, bytes((what, node)))


def decode_command(data: bytes) -> tuple[Command, int] | None:
    """Command and addressed node (0: all); None where `data` is no NMT command."""
    if len(data) != 2 or data[0] not in _COMMANDS:
        return None
    return Command(data[0]), data[1]


_COMMANDS = frozenset(Command)
_STATES = frozenset(State)


def heartbeat(node: int, state: State) -> Frame:
    """Heartbeat; in state INITIALISING the boot-up message."""
    return Frame(heartbeat_id(node), bytes((state,)))


def decode_heartbeat(data: bytes) -> State | None:
    """State in a heartbeat; None where `data` is none."""
    if len(data) != 1 or data[0] & 0x7F not in _STATES:  # bit 7 is the toggle bit of node guarding
        return None
    return State(data[0] & 0x7F)


def sync(counter: int | None = None) -> Frame:
    """SYNC with its counter (CiA 301, 7.2.5.3.1), or the empty one."""
    return Frame(SYNC) if counter is None else Frame(SYNC, bytes((counter,)))


def next_counter(counter: int, overflow: int) -> int:
    """Counter of the SYNC after the one with `counter`; 0 before the first.

    Args:
        overflow: 0x1019, the largest value; 1 follows it.
    """
    return counter % overflow + 1


def guard_request(node: int) -> Frame:
    """Remote frame by which a master asks for a node's state (node guarding, CiA 301, 7.2.8.2.1)."""
    return Frame(heartbeat_id(node) | REMOTE, b"", 1)


def guard_response(node: int, state: State, toggle: int) -> Frame:
    """Answer to `guard_request`; the toggle bit alternates from 0."""
    return Frame(heartbeat_id(node), bytes((state | toggle << 7,)))
