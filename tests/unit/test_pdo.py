"""PDO layouts: what may be mapped, how it is packed, what the rig file's errors say."""

import pytest

from protocols.dictionary import drive_dictionary
from protocols.errors import ConfigError
from protocols.objects import key
from protocols.pdo import RECEIVE, TRANSMIT, Mapped, compile_mapping, configuration, parse_layout
from protocols.robot import Drive
from protocols.sdo import Abort, SdoError

DICTIONARY = drive_dictionary(Drive(gear_ratio=50.0, drive_gain_Nm_A=10.0, rated_current_A=2.0, max_current_A=8.0))
FEEDBACK = ("6064:0/32", "6078:0/16", "2001:0/16")


def test_feedback_layout_packs_and_unpacks() -> None:
    layout = parse_layout(FEEDBACK, DICTIONARY, transmit=True)
    values = {key(0x6064): -2, key(0x6078): -300, key(0x2001): 65535}
    assert layout.size == 8
    assert layout.pack(values).hex() == "feffffff" + "d4fe" + "ffff"
    assert layout.unpack(layout.pack(values)) == (-2, -300, 65535)


def test_layout_of_one_object() -> None:
    layout = parse_layout(["6041:0/16"], DICTIONARY, transmit=True)
    assert layout.pack({key(0x6041): 0x0237}) == b"\x37\x02"


def test_unpacking_takes_the_first_bytes_of_a_longer_frame() -> None:
    assert parse_layout(["6060:0/8"], DICTIONARY, transmit=False).unpack(b"\x0a\xff\xff") == (10,)


@pytest.mark.parametrize(
    ("word", "transmit", "code"),
    [
        (0x1234_0010, True, Abort.NOT_MAPPABLE),  # no such object
        (0x6064_0110, True, Abort.NOT_MAPPABLE),  # no such sub-index
        (0x6064_0010, True, Abort.NOT_MAPPABLE),  # half of it
        (0x2010_0020, True, Abort.NOT_MAPPABLE),  # a parameter
        (0x1008_0040, True, Abort.NOT_MAPPABLE),  # a string
        (0x0005_0008, False, Abort.NOT_MAPPABLE),  # dummies are not offered
        (0x6064_0020, False, Abort.NOT_MAPPABLE),  # a measurement cannot be received
        (0, True, Abort.NOT_MAPPABLE),
    ],
)
def test_objects_that_cannot_be_mapped(word: int, transmit: bool, code: Abort) -> None:
    with pytest.raises(SdoError) as error:
        compile_mapping([word], DICTIONARY, transmit=transmit)
    assert error.value.code == code


def test_more_than_eight_bytes() -> None:
    with pytest.raises(SdoError) as error:
        compile_mapping([0x6064_0020, 0x606C_0020, 0x6061_0008], DICTIONARY, transmit=True)
    assert error.value.code == Abort.PDO_LENGTH


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["6064/32"], "PDO layout: '6064/32' is not an object; write INDEX:SUB/BITS such as 6064:0/32."),
        (["6064:0/thirty"], "PDO layout: '6064:0/thirty' is not an object; write INDEX:SUB/BITS such as 6064:0/32."),
        (["6064:0/128"], "PDO layout: '6064:0/128' is not an object; write INDEX:SUB/BITS such as 6064:0/32."),
        (
            ["6064:0/16"],
            "PDO layout: 6064:0/16 cannot be part of a TPDO; the drive has no such object, of another length, or does"
            " not allow it.",
        ),
        (
            ["6064:0/32", "606C:0/32", "6077:0/16"],
            "PDO layout: 6064:0/32, 606C:0/32, 6077:0/16 take 80 bits; a CAN frame carries 64.",
        ),
    ],
)
def test_messages_about_rig_files(texts: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_layout(texts, DICTIONARY, transmit=True)
    assert str(error.value) == message


def test_standard_procedure() -> None:
    writes = configuration(TRANSMIT, 1, 0x185, [Mapped.parse(t) for t in FEEDBACK], 1, inhibit_100us=0, event_ms=20)
    assert [(f"{i:04X}:{s}", d.hex()) for i, s, d in writes] == [
        ("1800:1", "850100c0"),
        ("1800:2", "01"),
        ("1800:3", "0000"),
        ("1800:5", "1400"),
        ("1A00:0", "00"),
        ("1A00:1", "20006460"),
        ("1A00:2", "10007860"),
        ("1A00:3", "10000120"),
        ("1A00:0", "03"),
        ("1800:1", "85010040"),
    ]
    assert configuration(RECEIVE, 2, 0x305, [], 1)[-1] == (0x1401, 1, b"\x05\x03\0\0")


def test_mapping_words_round_trip() -> None:
    mapped = parse_layout(FEEDBACK, DICTIONARY, transmit=True).mapped
    assert [Mapped.from_word(m.word) for m in mapped] == list(mapped) == [Mapped.parse(t) for t in FEEDBACK]
