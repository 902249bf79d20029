"""Error frames: the words for what Linux reports, and fault confinement on its own."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.confinement import Confinement
from protocols.errorframes import Class, State, Status, decode, encode
from protocols.frames import ERROR, Frame


@pytest.mark.parametrize(
    ("can_id", "data", "state", "text"),
    [  # as Linux sends them: drivers/net/can/dev, linux/can/error.h
        (0x20000040, "0000000000000000", State.BUS_OFF, "BUS OFF: the controller has left the bus"),
        (0x20000100, "0000000000000000", State.ACTIVE, "controller restarted"),
        (0x20000004, "0008000000006000", State.WARNING, "many transmit errors"),
        (0x20000004, "0010000000000080", State.PASSIVE, "error passive by receive errors"),
        (0x20000204, "0020000000008800", State.PASSIVE, "transmit errors, 136 transmit and 0 receive errors counted"),
        (0x20000204, "0040000000005f00", State.ACTIVE, "error active again, 95 transmit"),
        (0x20000004, "0001000000000000", None, "receive buffer overflow: frames are lost"),
        (0x20000088, "0000021800000000", None, "protocol violation (frame format), bus error"),
        (0x20000020, "0000000000000000", None, "no acknowledgement: nobody else is on the bus"),
        (0x20000002, "", None, "arbitration lost"),
        (0x20000000, "", None, "unknown error"),
    ],
)
def test_meaning(can_id: int, data: str, state: State | None, text: str) -> None:
    report = decode(Frame(can_id, bytes.fromhex(data)))
    assert report.state is state
    assert text in report.text


def test_counters_are_told_apart_from_silence_about_them() -> None:
    assert decode(Frame(0x20000004, bytes.fromhex("0008000000006000"))).tec is None
    report = decode(encode(Class.CONTROLLER, Status.TX_WARNING, tec=104, rec=3, station=5))
    assert (report.tec, report.rec, report.station) == (104, 3, 5)


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_every_error_frame_has_words(can_id: int, data: bytes) -> None:
    assert decode(Frame(can_id | ERROR, data)).text


@given(st.lists(st.sampled_from(["sent", "received", "failed_to_send", "failed_to_receive"]), max_size=300))
def test_counters_and_state_agree_and_each_change_is_told_once(steps: list[str]) -> None:
    controller, told = Confinement(7), State.ACTIVE
    for step in steps:
        report = getattr(controller, step)()
        if report is not None:
            meaning = decode(report)
            assert meaning.state is controller.state
            assert meaning.station == 7
            assert meaning.state is not told
            told = controller.state
        assert told is controller.state
        if controller.state is State.BUS_OFF:
            assert controller.tec >= 256
            assert decode(controller.restart()).classes & Class.RESTARTED
            told = State.ACTIVE
        worst = max(controller.tec, controller.rec)
        assert controller.state is (State.PASSIVE if worst > 127 else State.WARNING if worst > 95 else State.ACTIVE)
