"""SDO client and server against each other, byte by byte where the standard fixes bytes, and every abort code."""

import pytest

from protocols.sdo import Abort, Download, SdoError, Server, Upload


class Memory:
    """Objects without types: what was written can be read; 0x2000 has four bytes, 0x3000 is read-only."""

    def __init__(self) -> None:
        self.values = {
            (0x2000, 0): b"\1\2\3\4",
            (0x2001, 0): b"",
            (0x3000, 0): b"fixed",
            (0x2002, 1): bytes(range(200)),
        }

    def read(self, index: int, sub: int) -> bytes:
        if (index, sub) not in self.values:
            raise SdoError(Abort.NO_OBJECT)
        return self.values[index, sub]

    def sizes(self, index: int, sub: int) -> tuple[int, int]:
        if index == 0x3000:
            raise SdoError(Abort.READ_ONLY)
        self.read(index, sub)
        return (4, 4) if index == 0x2000 else (0, 300)

    def write(self, index: int, sub: int, data: bytes) -> None:
        if data.startswith(b"bad"):
            raise SdoError(Abort.VALUE)
        self.values[index, sub] = data


def run(server: Server, transfer: Upload | Download) -> list[bytes]:
    """All responses of a transfer."""
    responses, request = [], transfer.request()
    while request is not None:
        response = server.receive(request)
        assert response is not None
        responses.append(response)
        request = transfer.receive(response)
    return responses


@pytest.fixture
def server() -> Server:
    return Server(Memory())


def abort_of(response: bytes | None) -> tuple[int, int, int]:
    assert response is not None and response[0] == 0x80
    return (
        int.from_bytes(response[1:3], "little"),
        response[3],
        int.from_bytes(response[4:], "little"),
    )


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 200])
def test_what_was_written_is_read_back(server: Server, size: int) -> None:
    data = bytes(range(size))
    download, upload = Download(0x2001, 0, data), Upload(0x2001, 0)
    run(server, download)
    run(server, upload)
    assert download.done and upload.done and upload.data == data
    assert not server.busy


def test_bytes_of_an_expedited_transfer(server: Server) -> None:
    assert Download(0x2000, 0, b"\x0a\x0b\x0c\x0d").request().hex() == "230020000a0b0c0d"
    assert Download(0x2001, 0, b"\xff\xff").request().hex() == "2b012000ffff0000"
    assert server.receive(bytes.fromhex("230020000a0b0c0d")) == bytes.fromhex("6000200000000000")
    assert server.receive(Upload(0x2000, 0).request()) == bytes.fromhex("430020000a0b0c0d")


def test_bytes_of_a_segmented_upload(server: Server) -> None:
    responses = run(server, Upload(0x3000, 0))
    assert [r.hex() for r in responses] == ["4100300005000000", "0566697865640000"]


def test_expedited_download_without_length_takes_the_objects_own(server: Server) -> None:
    assert server.receive(bytes.fromhex("2200200001020304")) == bytes.fromhex("6000200000000000")


def test_segmented_download_without_announced_length(server: Server) -> None:
    assert server.receive(bytes.fromhex("2001200000000000")) == bytes.fromhex("6001200000000000")
    assert server.receive(bytes.fromhex("0b68690000000000")) == bytes.fromhex("2000000000000000")
    upload = Upload(0x2001, 0)
    run(server, upload)
    assert upload.data == b"hi"


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        ("4000400000000000", Abort.NO_OBJECT),
        ("2300300001020304", Abort.READ_ONLY),
        ("2b00200001020000", Abort.TOO_SHORT),
        ("2100200005000000", Abort.TOO_LONG),
        ("2100200003000000", Abort.TOO_SHORT),
        ("2701200062616400", Abort.VALUE),
        ("0001020304050607", Abort.COMMAND),  # segments without a transfer
        ("6000000000000000", Abort.COMMAND),
        ("a000200000000000", Abort.COMMAND),  # block transfers are not supported
        ("c200200004000000", Abort.COMMAND),
        ("e000000000000000", Abort.COMMAND),
    ],
)
def test_abort_codes(server: Server, request_bytes: str, code: Abort) -> None:
    assert abort_of(server.receive(bytes.fromhex(request_bytes)))[2] == code
    assert not server.busy


def test_abort_names_the_object(server: Server) -> None:
    assert abort_of(server.receive(Upload(0x4000, 7).request())) == (0x4000, 7, Abort.NO_OBJECT)


def test_repeated_toggle_bit_ends_the_transfer(server: Server) -> None:
    upload = Upload(0x2002, 1)
    response = server.receive(upload.request())
    assert response is not None
    segment = upload.receive(response)
    assert segment is not None
    server.receive(segment)
    assert abort_of(server.receive(segment)) == (0x2002, 1, Abort.TOGGLE)
    assert abort_of(server.receive(segment))[2] == Abort.COMMAND


def test_segments_beyond_the_announced_length(server: Server) -> None:
    server.receive(bytes.fromhex("2101200005000000"))
    assert abort_of(server.receive(b"\x001234567")) == (0x2001, 0, Abort.TOO_LONG)


def test_segments_short_of_the_announced_length(server: Server) -> None:
    server.receive(bytes.fromhex("2101200005000000"))
    assert abort_of(server.receive(bytes.fromhex("0b68690000000000"))) == (0x2001, 0, Abort.TOO_SHORT)


@pytest.mark.parametrize("data", [b"", b"\x40", b"\x40\x00\x20\x00", bytes(7)])
def test_requests_that_are_not_eight_bytes_are_not_answered(server: Server, data: bytes) -> None:
    assert server.receive(data) is None


def test_a_client_that_goes_away(server: Server) -> None:
    server.receive(Upload(0x2002, 1).request())
    assert server.busy
    assert abort_of(server.expire()) == (0x2002, 1, Abort.TIMEOUT)
    assert server.expire() is None
    server.receive(Upload(0x2002, 1).request())
    assert server.receive(SdoError(Abort.TIMEOUT, 0x2002, 1).encode()) is None
    assert not server.busy


def test_a_new_request_replaces_a_transfer(server: Server) -> None:
    server.receive(Upload(0x2002, 1).request())
    upload = Upload(0x2000, 0)
    run(server, upload)
    assert upload.data == b"\1\2\3\4" and not server.busy


def test_client_reports_the_servers_abort_in_words(server: Server) -> None:
    with pytest.raises(SdoError) as error:
        run(server, Upload(0x4000, 0))
    assert str(error.value) == "SDO transfer of 4000:00 aborted with 06020000: there is no such object."
    assert error.value.received and error.value.exit_code == 5


def test_client_reports_a_code_it_does_not_know() -> None:
    upload = Upload(0x2000, 0)
    with pytest.raises(SdoError, match="aborted with 0BADC0DE: a code outside CiA 301"):
        upload.receive(bytes.fromhex("80002000dec0ad0b"))


def test_client_ignores_answers_to_earlier_questions() -> None:
    upload = Upload(0x2000, 0)
    assert upload.receive(bytes.fromhex("4301200001020304")) is None  # 0x2001
    assert upload.receive(bytes.fromhex("8001200000000204")) is None
    assert upload.receive(b"\x43\x00\x20") is None
    assert not upload.done
    upload.receive(bytes.fromhex("4300200001020304"))
    assert upload.data == b"\1\2\3\4"


@pytest.mark.parametrize(
    ("transfer", "responses"),
    [
        (Upload(0x2000, 0), ["6000200000000000"]),  # answer to a download
        (Upload(0x2000, 0), ["4100200009000000", "1001020304050607"]),  # wrong toggle bit
        (Upload(0x2000, 0), ["4100200002000000", "0001020304050607"]),  # more than announced
        (Upload(0x2000, 0), ["4100200009000000", "2000000000000000"]),
        (Download(0x2000, 0, b"1"), ["4300200001020304"]),
        (Download(0x2000, 0, b"12345"), ["6000200000000000", "3000000000000000"]),  # wrong toggle bit
        (Download(0x2000, 0, b"12345"), ["6000200000000000", "6000200000000000"]),
    ],
)
def test_client_aborts_what_the_server_gets_wrong(transfer: Upload | Download, responses: list[str]) -> None:
    with pytest.raises(SdoError) as error:
        for response in responses:
            transfer.receive(bytes.fromhex(response))
    assert not error.value.received
    assert error.value.encode()[:4].hex() == "80002000"


def test_timeout_of_a_client() -> None:
    error = Upload(0x1000, 0).expire()
    assert error.encode().hex() == "8000100000000405"
    assert str(error) == "SDO transfer of 1000:00 aborted with 05040000: no answer in time."
