"""The tables of CiA 402: controlwords, statuswords, transitions."""

import pytest

from protocols.cia402 import (
    CONTROLWORD,
    SUPPORTED,
    TRANSITIONS,
    Command,
    Event,
    State,
    controlword_to_enable,
    decode_controlword,
    state_of,
    supported_modes,
)


@pytest.mark.parametrize(
    ("controlword", "command"),
    [
        (0x0006, Command.SHUTDOWN),
        (0x000E, Command.SHUTDOWN),
        (0xFF76, Command.SHUTDOWN),
        (0x0007, Command.SWITCH_ON),
        (0x000F, Command.ENABLE_OPERATION),
        (0x001F, Command.ENABLE_OPERATION),
        (0x0000, Command.DISABLE_VOLTAGE),
        (0x000D, Command.DISABLE_VOLTAGE),
        (0x0002, Command.QUICK_STOP),
        (0x000B, Command.QUICK_STOP),
        (0x0080, Command.FAULT_RESET),
        (0x008F, Command.FAULT_RESET),
    ],
)
def test_controlword(controlword: int, command: Command) -> None:
    assert decode_controlword(controlword, 0) is command


@pytest.mark.parametrize("controlword", range(0x80, 0x100))
def test_bit_7_held_high_masks_every_command(controlword: int) -> None:
    assert decode_controlword(controlword, 0x80) is None


def test_every_controlword_without_bit_7_is_one_command() -> None:
    assert all(decode_controlword(word, 0) in set(Command) - {Command.FAULT_RESET} for word in range(0x80))


def test_commands_and_controlwords_agree() -> None:
    assert all(decode_controlword(word, 0) is command for command, word in CONTROLWORD.items())


def test_every_statusword_means_at_most_one_state() -> None:
    for word in range(256):
        assert sum(word & s.mask == s.pattern for s in State) <= 1
    assert state_of(0x0001) is None


@pytest.mark.parametrize("state", State)
def test_statusword_of_a_state(state: State) -> None:
    assert state_of(state.pattern) is state
    assert state_of(state.pattern | 0x3E90) is state  # voltage, warning and the mode's bits say nothing about it


def test_a_master_reaches_operation_enabled_from_everywhere() -> None:
    for start in State:
        state, word = start, 0x80
        for _ in range(6):
            new = controlword_to_enable(state, word)
            command, word = decode_controlword(new, word), new
            for event in (command, Event.INITIALISED, Event.REACTION_DONE):
                state = TRANSITIONS.get((state, event), state) if event is not None else state
        assert state is State.OPERATION_ENABLED, start


def test_fault_reset_needs_two_controlwords_where_bit_7_is_high() -> None:
    assert controlword_to_enable(State.FAULT, 0x80) == 0
    assert controlword_to_enable(State.FAULT, 0x00) == 0x80


def test_supported_modes() -> None:
    assert supported_modes(SUPPORTED) == 0x3ED
