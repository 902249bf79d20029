"""A SocketCAN interface read without python-can, which hides all that proves or explains a loss.

Every frame comes with the kernel's stamp in nanoseconds, the interface's own where it has a clock, and the number of
frames that the socket has dropped so far (SO_RXQ_OVFL); controllers report their errors (linux/can/raw.h).
"""

import contextlib
import fcntl
import socket
import struct
from array import array
from collections.abc import Sequence
from typing import NamedTuple, Self

from protocols.clock import Clock, utc_now_ns
from protocols.frames import REMOTE, Frame
from protocols.pythoncan import cannot_open, lost
from protocols.rig import Bus

RECEIVE_BYTES = 4 * 2**20  # what the kernel accounts for about 5000 frames: a third of a second of two full buses
MAX_BATCH = 4096  # frames taken at once, so that a flooded bus cannot starve the others

# asm-generic/socket.h, linux/net_tstamp.h, ethtool.h, sockios.h, can/raw.h: what Python's socket module leaves out
SO_RCVBUFFORCE = 33
SO_TIMESTAMPING = 37
SO_RXQ_OVFL = 40
SO_MEMINFO = 55
_MEMINFO_DROPS = 8
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
_SIOCETHTOOL = 0x8946
_ETHTOOL_GET_TS_INFO = 0x41
_TS_INFO_WORDS = 11  # struct ethtool_ts_info; the second word is what can be stamped
_CAN_RAW_ERR_FILTER = 2
_ALL_ERRORS = 0x1FFF_FFFF

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_STAMPS = struct.Struct("@6q")  # three timespecs: software, none, hardware
_COUNT = struct.Struct("@I")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_STAMPS.size) + socket.CMSG_SPACE(_COUNT.size)

KERNEL_STAMPS = "arrival stamps are the kernel's: the interface has no clock of its own"
HARDWARE_STAMPS = "arrival stamps are the interface's own, put on this machine's clock"


class Ancillary(NamedTuple):
    """What the kernel says about a frame.

    Attributes:
        software_ns: When it came, by the machine's date [ns since 1970]; 0 without.
        hardware_ns: The same by the interface's clock, which began whenever it liked; 0 without.
        drops: Frames dropped since the socket was opened; None as long as there are none.
    """

    software_ns: int
    hardware_ns: int
    drops: int | None


def parse_frame(data: bytes) -> Frame:
    """Frame of a `struct can_frame`.

    Raises:
        ValueError: Another size: a CAN FD frame.
    """
    if len(data) != _FRAME.size:
        raise ValueError(f"{len(data)} bytes are no classical CAN frame ({_FRAME.size} expected)")
    can_id, length, payload = _FRAME.unpack(data)
    return Frame(can_id, b"", length) if can_id & REMOTE else Frame(can_id, payload[:length])


def parse_ancillary(messages: Sequence[tuple[int, int, bytes]]) -> Ancillary:
    """Stamps and counter of the control messages of one `recvmsg`."""
    software_ns = hardware_ns = 0
    drops = None
    for level, kind, data in messages:
        if level != socket.SOL_SOCKET:
            continue
        if kind == SO_TIMESTAMPING and len(data) == _STAMPS.size:
            s, s_ns, _, _, h, h_ns = _STAMPS.unpack(data)
            software_ns, hardware_ns = s * 1_000_000_000 + s_ns, h * 1_000_000_000 + h_ns
        elif kind == SO_RXQ_OVFL and len(data) == _COUNT.size:
            (drops,) = _COUNT.unpack(data)
    return Ancillary(software_ns, hardware_ns, drops)


class RunTime:
    """Arrival stamps on the run's clock, which no step of the date bends: never later than now, never going back."""

    _LEAK = 10_000  # a clock runs at most 100 ppm fast or slow

    def __init__(self) -> None:
        self._last_ns = 0
        self._offset_ns: int | None = None  # run's clock minus interface's
        self._hardware_ns = 0

    def __call__(self, stamps: Ancillary, utc_ns: int, now_ns: int) -> int:
        """Arrival [ns since the run started].

        Args:
            utc_ns, now_ns: One moment after the arrival, by the machine's date and by the run's clock.
        """
        t_ns = stamps.software_ns - utc_ns + now_ns if stamps.software_ns else now_ns
        if stamps.hardware_ns:
            t_ns = self._of_hardware(stamps.hardware_ns, t_ns)
        self._last_ns = max(self._last_ns, min(t_ns, now_ns))
        return self._last_ns

    def _of_hardware(self, hardware_ns: int, t_ns: int) -> int:
        """The kernel is late by a varying time, never early: the smallest difference is nearest the truth."""
        seen_ns = t_ns - hardware_ns
        if self._offset_ns is None:
            self._offset_ns = seen_ns
        else:
            drift_ns = abs(hardware_ns - self._hardware_ns) // self._LEAK
            self._offset_ns = min(self._offset_ns + drift_ns, seen_ns)
        self._hardware_ns = hardware_ns
        return hardware_ns + self._offset_ns


class RawSocket:
    """Listener on a SocketCAN interface; the same methods as `daq.bus.Listener`. It has no way to send.

    Attributes:
        name: The rig's name of the bus.
        dropped: Frames lost between kernel and us, by the kernel's count.
        stamps: Where the arrival stamps come from, in words.
        blind: There is a descriptor to wait on.
    """

    blind = False

    def __init__(self, bus: Bus, clock: Clock, receive_bytes: int = RECEIVE_BYTES) -> None:
        """Listen.

        Raises:
            PeerError: No such interface, or no SocketCAN in this kernel.
        """
        self.name = bus.name
        self.dropped = 0
        self._config, self._clock = bus, clock
        self._run_time = RunTime()
        self._remarks: list[str] = []
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise cannot_open(bus, error) from error
        try:
            self._configure(receive_bytes)
            self._socket.bind((bus.channel,))
        except OSError as error:
            self._socket.close()
            raise cannot_open(bus, error) from error
        self.stamps = HARDWARE_STAMPS if has_clock(self._socket, bus.channel) else KERNEL_STAMPS

    def _configure(self, receive_bytes: int) -> None:
        sock = self._socket
        sock.setblocking(False)
        try:
            sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_bytes)
        except PermissionError:  # an ordinary user gets at most net.core.rmem_max
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        wanted = _RX_HARDWARE | _RX_SOFTWARE | _SOFTWARE | _RAW_HARDWARE
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, wanted)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)

    def receive(self) -> list[tuple[int, Frame]]:
        """What has arrived, without waiting: pairs (arrival [ns], frame).

        Raises:
            PeerError: The interface has gone.
        """
        received: list[tuple[Frame, Ancillary]] = []
        try:
            while len(received) < MAX_BATCH:
                data, messages, _, _ = self._socket.recvmsg(_FRAME.size, _ANCILLARY_BYTES)
                received.append((parse_frame(data), parse_ancillary(messages)))
        except BlockingIOError:
            pass
        except OSError as error:
            self._failed(error)
        now_ns, utc_ns = self._clock.now_ns(), utc_now_ns()
        if received and received[-1][1].drops is not None:
            self.dropped = received[-1][1].drops
        return [(self._run_time(stamps, utc_ns, now_ns), frame) for frame, stamps in received]

    def take_remarks(self) -> list[str]:
        """What has happened to the interface since the last call, in words."""
        remarks, self._remarks = self._remarks, []
        return remarks

    def count_drops(self) -> int:
        """`dropped`, with what no later frame has told yet."""
        with contextlib.suppress(OSError):  # before Linux 4.12 the last frame's word is all there is
            info = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
            self.dropped = max(self.dropped, _COUNT.unpack_from(info, 4 * _MEMINFO_DROPS)[0])
        return self.dropped

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _failed(self, error: OSError) -> None:
        """An interface that is down may come up again, and the socket hears it then; one that is gone does not.

        Raises:
            PeerError: It is gone.
        """
        try:
            socket.if_nametoindex(self._config.channel)
        except OSError:
            raise lost(self._config, error) from error
        self._remarks.append(f"{self._config.channel}: {error.strerror}; listening on")


def has_clock(sock: socket.socket, interface: str) -> bool:
    """Whether an interface stamps what it receives by itself (ETHTOOL_GET_TS_INFO)."""
    info = array("I", [_ETHTOOL_GET_TS_INFO, *[0] * (_TS_INFO_WORDS - 1)])
    try:
        fcntl.ioctl(sock, _SIOCETHTOOL, struct.pack("16sP", interface.encode(), info.buffer_info()[0]))
    except OSError:
        return False
    wanted = _RX_HARDWARE | _RAW_HARDWARE
    return info[1] & wanted == wanted
