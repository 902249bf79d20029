"""SDO block transfers back to back, byte by byte where the standard fixes bytes, with losses and lies."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.sdo import Abort, Download, SdoError, Upload
from protocols.sdoblock import BlockDownload, BlockServer, BlockUpload, crc


class Memory:
    """0x2000 takes anything up to 5000 bytes, 0x2001 four bytes, 0x3000 is read-only."""

    def __init__(self) -> None:
        self.values = {0x2000: b"", 0x2001: b"\1\2\3\4", 0x3000: bytes(range(256)) * 10}

    def read(self, index: int, sub: int) -> bytes:
        if index not in self.values:
            raise SdoError(Abort.NO_OBJECT)
        return self.values[index]

    def sizes(self, index: int, sub: int) -> tuple[int, int]:
        if index == 0x3000:
            raise SdoError(Abort.READ_ONLY)
        self.read(index, sub)
        return (4, 4) if index == 0x2001 else (0, 5000)

    def write(self, index: int, sub: int, data: bytes) -> None:
        self.values[index] = data


def run(server: BlockServer, transfer: BlockUpload | BlockDownload, lose: frozenset[int] = frozenset()) -> int:
    """Carry a transfer to its end; returns how many messages passed.

    Args:
        lose: Numbers of the segments of a block that get lost on the way, once each.
    """
    lost = set(lose)

    def pass_on(frame: bytes, segment: bool) -> bool:
        if segment and frame[0] & 0x7F in lost and not frame[0] & 0x80:
            lost.discard(frame[0] & 0x7F)
            return False
        return True

    upload, messages, requests = isinstance(transfer, BlockUpload), 0, [transfer.request()]
    while requests:
        burst = not upload and len(requests) > 1
        answers = [a for r in requests if pass_on(r, burst) for a in server.receive(r)]
        messages += len(requests) + len(answers)
        burst = upload and len(answers) > 1
        requests = [r for a in answers if pass_on(a, burst) for r in transfer.receive(a)]
    assert transfer.done
    assert not server.busy
    return messages


@pytest.fixture
def memory() -> Memory:
    return Memory()


@pytest.fixture
def server(memory: Memory) -> BlockServer:
    return BlockServer(memory)


def abort_of(answers: list[bytes]) -> tuple[int, int]:
    """Index and code of an abort."""
    assert len(answers) == 1 and answers[0][0] == 0x80, answers
    return int.from_bytes(answers[0][1:3], "little"), int.from_bytes(answers[0][4:], "little")


def test_checksum_of_the_standard() -> None:
    assert crc(b"123456789") == 0x31C3  # CRC-16/XMODEM of the catalogue of parametrised CRC algorithms
    assert crc(b"") == 0


@pytest.mark.parametrize("size", [0, 1, 6, 7, 8, 127 * 7 - 1, 127 * 7, 127 * 7 + 1, 2540, 5000])
def test_what_was_written_is_read_back(server: BlockServer, memory: Memory, size: int) -> None:
    data = bytes(i * 7 & 0xFF for i in range(size))
    run(server, BlockDownload(0x2000, 0, data))
    assert memory.values[0x2000] == data
    upload = BlockUpload(0x2000, 0)
    run(server, upload)
    assert upload.data == data


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=2000), st.frozensets(st.integers(1, 126), max_size=6))
def test_lost_segments_are_sent_again(data: bytes, lose: frozenset[int]) -> None:
    memory = Memory()
    server = BlockServer(memory)
    run(server, BlockDownload(0x2000, 0, data), lose)
    assert memory.values[0x2000] == data
    upload = BlockUpload(0x2000, 0)
    run(server, upload, lose)
    assert upload.data == data


def test_bytes_of_a_download(server: BlockServer) -> None:
    transfer = BlockDownload(0x2000, 3, b"abcdefghij")
    assert transfer.request().hex() == "c60020030a000000"
    assert server.receive(transfer.request()) == [bytes.fromhex("a40020037f000000")]
    segments = transfer.receive(bytes.fromhex("a40020037f000000"))
    assert [s.hex() for s in segments] == ["0161626364656667", "8268696a00000000"]
    assert server.receive(segments[0]) == []
    assert server.receive(segments[1]) == [bytes.fromhex("a2027f0000000000")]
    (end,) = transfer.receive(bytes.fromhex("a2027f0000000000"))
    assert end[0] == 0xC1 | 4 << 2 and int.from_bytes(end[1:3], "little") == crc(b"abcdefghij")
    assert server.receive(end) == [b"\xa1" + bytes(7)]


def test_bytes_of_an_upload(server: BlockServer, memory: Memory) -> None:
    memory.values[0x2000] = b"abcdefgh"
    assert server.receive(bytes.fromhex("a400200002000000")) == [bytes.fromhex("c600200008000000")]
    assert [a.hex() for a in server.receive(b"\xa3" + bytes(7))] == ["0161626364656667", "8268000000000000"]
    (end,) = server.receive(bytes.fromhex("a202020000000000"))
    assert end[0] == 0xC1 | 6 << 2
    assert server.receive(b"\xa1" + bytes(7)) == []
    assert not server.busy


def test_without_checksum(server: BlockServer, memory: Memory) -> None:
    memory.values[0x2000] = b"abc"
    assert server.receive(bytes.fromhex("a000200002000000"))[0][0] == 0xC2
    server.receive(b"\xa3" + bytes(7))
    assert server.receive(bytes.fromhex("a201020000000000"))[0][1:] == bytes(7)
    assert server.receive(bytes.fromhex("c200200003000000"))[0][0] == 0xA0
    server.receive(b"\x81xyz\0\0\0\0")
    assert server.receive(b"\xd1" + bytes(7)) == [b"\xa1" + bytes(7)]  # 4 bytes unused, no checksum
    assert memory.values[0x2000] == b"xyz"


def test_small_values_come_in_the_ordinary_way(server: BlockServer) -> None:
    assert server.receive(bytes.fromhex("a40120007f040000")) == [bytes.fromhex("4301200001020304")]
    upload = BlockUpload(0x2001)
    assert upload.receive(bytes.fromhex("4301200001020304")) == []
    assert upload.done and upload.data == b"\1\2\3\4"


def test_blocks_as_small_as_the_client_wants(server: BlockServer) -> None:
    server.receive(bytes.fromhex("a400300001000000"))
    assert len(server.receive(b"\xa3" + bytes(7))) == 1
    assert len(server.receive(bytes.fromhex("a201050000000000"))) == 5


@pytest.mark.parametrize(
    ("requests", "index", "code"),
    [
        (["a400400001000000"], 0x4000, Abort.NO_OBJECT),
        (["a400300000000000"], 0x3000, Abort.BLOCK_SIZE),
        (["a400300080000000"], 0x3000, Abort.BLOCK_SIZE),
        (["c600300001000000"], 0x3000, Abort.READ_ONLY),
        (["c600200089130000"], 0x2000, Abort.TOO_LONG),  # 5001 bytes
        (["c601200003000000"], 0x2001, Abort.TOO_SHORT),
        (["c100000000000000"], 0, Abort.COMMAND),  # the end of what never began
        (["a300000000000000"], 0, Abort.COMMAND),
        (["a201010000000000"], 0, Abort.COMMAND),
        (["a400300002000000", "a100000000000000"], 0x3000, Abort.COMMAND),  # not yet
        (["a400300002000000", "a300000000000000", "a203020000000000"], 0x3000, Abort.SEQUENCE),  # two were sent
        (["a400300002000000", "a300000000000000", "a202800000000000"], 0x3000, Abort.BLOCK_SIZE),
        (["c600200003000000", "0000000000000000"], 0x2000, Abort.SEQUENCE),
        (["c400200000000000", "8178797a00000000", "d1ffff0000000000"], 0x2000, Abort.CRC),
        (["c200200004000000", "8178797a00000000", "d100000000000000"], 0x2000, Abort.TOO_SHORT),
        (["c200200002000000", "8178797a00000000", "d100000000000000"], 0x2000, Abort.TOO_LONG),
        (["c601200004000000", "0178797a00000000", "0278797a00000000"], 0x2001, Abort.TOO_LONG),
    ],
)
def test_abort_codes(server: BlockServer, requests: list[str], index: int, code: Abort) -> None:
    *first, last = requests
    for request in first:
        for answer in server.receive(bytes.fromhex(request)):
            assert answer[0] != 0x80 or answer[1] != 0, answer
    assert abort_of(server.receive(bytes.fromhex(last))) == (index, code)
    assert not server.busy


def test_client_reports_a_wrong_checksum() -> None:
    upload = BlockUpload(0x2000)
    upload.receive(bytes.fromhex("c600200003000000"))
    upload.receive(b"\x81abc\0\0\0\0")
    with pytest.raises(SdoError, match="2000:00 aborted with 05040004: the checksum of the block transfer is wrong"):
        upload.receive(b"\xd1" + bytes(7))


def test_client_reports_a_wrong_length() -> None:
    upload = BlockUpload(0x2000)
    upload.receive(bytes.fromhex("c200200005000000"))
    upload.receive(b"\x81abc\0\0\0\0")
    with pytest.raises(SdoError, match="length of data and of object differ"):
        upload.receive(b"\xd1" + bytes(7))


def test_client_passes_on_the_servers_abort(server: BlockServer) -> None:
    for transfer in (BlockUpload(0x4000), BlockDownload(0x4000, 0, b"x")):
        with pytest.raises(SdoError, match="there is no such object") as error:
            run(server, transfer)
        assert error.value.received


def test_a_client_that_goes_away(server: BlockServer) -> None:
    server.receive(BlockUpload(0x3000).request())
    assert server.busy
    assert abort_of([server.expire() or b""]) == (0x3000, Abort.TIMEOUT)
    assert server.expire() is None
    server.receive(BlockDownload(0x2000, 0, bytes(20)).request())
    assert server.receive(SdoError(Abort.TIMEOUT, 0x2000).encode()) == []
    assert not server.busy


def test_ordinary_transfers_still_work(server: BlockServer, memory: Memory) -> None:
    server.receive(BlockUpload(0x3000).request())  # a new request replaces a transfer
    upload = Upload(0x2001)
    (answer,) = server.receive(upload.request())
    upload.receive(answer)
    assert upload.data == b"\1\2\3\4"
    server.receive(Download(0x2001, 0, b"abcd").request())
    assert memory.values[0x2001] == b"abcd"


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(min_size=8, max_size=8), max_size=40))
def test_a_server_survives_any_client(requests: list[bytes]) -> None:
    server = BlockServer(Memory())
    for request in requests:
        assert all(len(answer) == 8 for answer in server.receive(request))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(min_size=8, max_size=8), max_size=40))
def test_a_client_survives_any_server(answers: list[bytes]) -> None:
    for transfer in (BlockUpload(0x2000), BlockDownload(0x2000, 0, bytes(2000))):
        try:
            for answer in answers:
                assert all(len(request) == 8 for request in transfer.receive(answer))
        except SdoError as error:
            assert len(error.encode()) == 8
