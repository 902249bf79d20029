"""python-can in this product's words: frames to and from `can.Message`, its errors as sentences."""

import can

from protocols.errors import PeerError
from protocols.frames import ERROR, EXTENDED, ID_MASK, REMOTE, Frame
from protocols.rig import Bus


def to_message(frame: Frame, t_s: float = 0.0) -> can.Message:
    """Message of a frame.

    Args:
        t_s: Arrival time, seconds since 1970 by python-can's convention.
    """
    return can.Message(
        timestamp=t_s,
        arbitration_id=frame.can_id & ID_MASK,
        is_extended_id=bool(frame.can_id & EXTENDED),
        is_remote_frame=bool(frame.can_id & REMOTE),
        is_error_frame=bool(frame.can_id & ERROR),
        dlc=frame.dlc or len(frame.data),
        data=frame.data,
    )


def from_message(message: can.Message) -> Frame:
    """Frame of a message; python-can keeps the flag bits apart."""
    can_id = message.arbitration_id
    if message.is_error_frame:  # its identifier is a class of errors, neither 11 nor 29 bits
        can_id |= ERROR
    elif message.is_extended_id:
        can_id |= EXTENDED
    if message.is_remote_frame:
        return Frame(can_id | REMOTE, b"", message.dlc)
    return Frame(can_id, bytes(message.data))


def cannot_open(bus: Bus, error: Exception) -> PeerError:
    """Error for a bus that could not be joined, with what to do about it."""
    where = f"bus {bus.name} ({bus.interface} {bus.channel})"
    reason = str(error).rstrip(".")
    if isinstance(error, NotImplementedError):
        return PeerError(f"{where}: python-can offers no such interface: {reason}. Correct it in the rig file.")
    if bus.interface == "socketcan":
        return PeerError(
            f"{where} does not exist: {reason}. Create it with `ip link add dev {bus.channel} type vcan &&"
            f" ip link set {bus.channel} up`, or give the rig the interface virtualcan, which needs no kernel support."
        )
    return PeerError(f"{where} cannot be joined: {reason}.")


def lost(bus: Bus, error: Exception) -> PeerError:
    """Error for a bus that went away."""
    return PeerError(f"bus {bus.name} ({bus.interface} {bus.channel}) is lost: {str(error).rstrip('.')}.")
