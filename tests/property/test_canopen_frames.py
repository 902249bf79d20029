"""Whatever arrives, a drive stays in a legal state and never raises; what its codecs write they read back."""

import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emulator.axis import Measurement
from emulator.drive import Drive
from protocols import cia402, emcy, lss, nmt, sdo, sdoblock
from protocols.dictionary import drive_dictionary
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.objects import Type
from protocols.robot import Drive as Config

CONFIG = Config(gear_ratio=-32.0, drive_gain_Nm_A=10.0, rated_current_A=2.0, max_current_A=8.0)
DICTIONARY = drive_dictionary(CONFIG)
NODE = 5
MS = 1_000_000

IDENTITY = lss.Identity(0, 0x4152_4D52, 0x0001_0000, NODE)
BLOCKS = [  # both directions of a block transfer, out of order as drawn
    sdoblock.BlockDownload(0x2000, 0, b"x").request(),
    sdoblock.BlockUpload(0x1008).request(),
    sdoblock.BlockUpload(0x2041).request(),
    *(bytes((first, 1, 5)).ljust(8, b"\0") for first in (0xA3, 0xA2, 0xA1, 0x81, 0x01, 0xD9, 0xC1)),
]

addresses = st.sampled_from([(e.index, e.sub) for e in DICTIONARY.entries.values()])
anything = st.binary(max_size=8)
words = st.sampled_from([0x00, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x5F, 0x80, 0x8F, 0x100, 0x10F, 0x11F])


@st.composite
def downloads(draw: st.DrawFn) -> Frame:
    """A write that at least has an object's length."""
    index, sub = draw(addresses)
    size = min(4, max(1, DICTIONARY.find(index, sub).sizes[0]))
    interesting = st.sampled_from([0, 1, 2, 0x8000_0185, 0x185, 0x6064_0020, 0x6041_0010, 0xFFFF_FFFF])
    value = draw(st.one_of(interesting, st.integers(0, 2**32 - 1)))
    data = value.to_bytes(4, "little")[:size]
    return Frame(0x600 + NODE, sdo.Download(index, sub, data).request())


frames = st.one_of(
    downloads(),
    downloads(),
    st.builds(lambda a: Frame(0x600 + NODE, sdo.Upload(*a).request()), addresses),
    st.builds(lambda d: Frame(0x600 + NODE, d), anything),
    st.builds(nmt.command, st.sampled_from(nmt.Command), st.sampled_from([0, NODE, 6])),
    st.builds(lambda w, m: Frame(0x200 + NODE, struct.pack("<Hb", w, m)), words, st.integers(-1, 11)),
    st.builds(lambda d: Frame(0x600 + NODE, d), st.sampled_from(BLOCKS)),
    st.builds(lambda i: Frame(i | REMOTE, b"", 8), st.sampled_from([0x180 + NODE, 0x380 + NODE, 0x700 + NODE])),
    st.builds(lambda d: Frame(nmt.TIME, d), anything),
    st.sampled_from([*lss.select(IDENTITY), *(lss.message(s) for s in lss.Service if s > lss.Service.SWITCHED)]),
    st.builds(lambda d: Frame(0x300 + NODE, d), anything),
    st.builds(lambda n, d: Frame(0x700 + n, d), st.sampled_from([NODE, 127]), anything),
    st.builds(
        lambda i, f, d: Frame(i | f, b"" if f == REMOTE else d),
        st.integers(0, 0x7FF),
        st.sampled_from([0, 0, REMOTE, ERROR, EXTENDED]),
        anything,
    ),
)
counters = st.one_of(st.none(), st.integers(0, 255))
measurements = st.builds(Measurement, st.integers(-(2**40), 2**40), st.integers(-(2**40), 2**40), st.floats(-1e9, 1e9))
steps = st.one_of(
    frames,
    frames,
    st.tuples(st.just("sync"), counters, measurements),
    st.tuples(st.just("wait"), st.integers(1, 2000)),
    st.tuples(st.just("fault"), st.sampled_from(list(emcy.Code)[1:])),
)


def check(drive: Drive, sent: list[Frame]) -> None:
    for frame in sent:
        assert 0 <= frame.can_id <= 0x7FF and len(frame.data) <= 8
    state = cia402.state_of(drive.device.store.values[0x604100])
    assert state is drive.state is not cia402.State.NOT_READY_TO_SWITCH_ON
    assert drive.device.state in nmt.State and drive.device.state is not nmt.State.INITIALISING
    command = drive.command()
    enabled = drive.state is cia402.State.OPERATION_ENABLED
    stopping = drive.state in {cia402.State.QUICK_STOP_ACTIVE, cia402.State.FAULT_REACTION_ACTIVE}
    assert command.mode in ((0, 8, 10) if enabled else (8,) if stopping else (0,))
    assert abs(command.target_current_A) <= CONFIG.max_current_A * 33  # 0x6072 and 0x6073 can be raised to 32767
    for entry in DICTIONARY.entries.values():
        entry.encode(drive.device.store.values[entry.key])  # every value fits its type


@settings(max_examples=150, deadline=None)
@given(st.lists(steps, max_size=60))
def test_any_sequence_leaves_a_legal_state(sequence: list) -> None:
    drive, t_ns = Drive(CONFIG, NODE), 0
    check(drive, drive.start(t_ns))
    check(drive, drive.receive(t_ns, nmt.command(nmt.Command.START)))
    for word in (0x06, 0x07, 0x0F):
        drive.receive(t_ns, Frame(0x200 + NODE, struct.pack("<Hb", word, 10)))
    for step in sequence:
        t_ns += MS
        match step:
            case ("sync", counter, measurement):
                sent = drive.on_sync(t_ns, counter, measurement)
            case ("wait", milliseconds):
                t_ns += milliseconds * MS
                sent = drive.tick(t_ns)
            case ("fault", code):
                sent = drive.fault(t_ns, code)
            case frame:
                sent = drive.receive(t_ns, frame)
        check(drive, sent)
        check(drive, drive.tick(t_ns))
    # ... and from wherever it is, a reset brings it back
    reset = drive.receive(t_ns, nmt.command(nmt.Command.RESET_NODE, NODE))
    assert reset == [Frame(0x700 + NODE, b"\0")]
    assert drive.device.store.values == Drive(CONFIG, NODE).device.store.values


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), st.booleans())
@example(b"", True)
def test_sdo_transfers_keep_every_byte(data: bytes, by_download: bool) -> None:
    class Memory:
        value = b"" if by_download else data

        def read(self, index: int, sub: int) -> bytes:
            return self.value

        def sizes(self, index: int, sub: int) -> tuple[int, int]:
            return 0, 300

        def write(self, index: int, sub: int, data: bytes) -> None:
            self.value = data

    memory = Memory()
    server = sdo.Server(memory)
    transfers = [sdo.Download(1, 2, data), sdo.Upload(1, 2)] if by_download else [sdo.Upload(1, 2)]
    for transfer in transfers:
        request: bytes | None = transfer.request()
        while request is not None:
            response = server.receive(request)
            assert response is not None and len(response) == len(request) == 8
            request = transfer.receive(response)
        assert transfer.done
    assert memory.value == data == transfers[-1].data


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(min_size=8, max_size=8), max_size=30))
def test_an_sdo_client_survives_any_server(responses: list[bytes]) -> None:
    for transfer in (sdo.Upload(0x1000, 0), sdo.Download(0x1000, 0, bytes(20))):
        try:
            for response in responses:
                request = transfer.receive(response)
                assert request is None or len(request) == 8
        except sdo.SdoError as error:
            assert len(error.encode()) == 8


@pytest.mark.parametrize("entry", DICTIONARY.entries.values(), ids=lambda e: f"{e.index:04X}:{e.sub}")
def test_every_default_fits_its_object(entry) -> None:
    default = DICTIONARY.defaults(127)[entry.key]
    entry.check(default)
    decoded = entry.decode(entry.encode(default))
    assert decoded == (pytest.approx(default) if entry.type is Type.REAL32 else default)


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=5, max_size=5))
def test_emergencies_round_trip(code: int, register: int, detail: bytes) -> None:
    message = emcy.Emergency(code, register, detail)
    assert emcy.decode(emcy.encode(0x85, message).data) == message


@given(st.binary(max_size=8))
def test_decoders_accept_anything(data: bytes) -> None:
    assert (emcy.decode(data) is None) is (len(data) != 8)
    assert nmt.decode_heartbeat(data) in {None, *nmt.State}
    assert nmt.decode_command(data) is None or len(data) == 2
