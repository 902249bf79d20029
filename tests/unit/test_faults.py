"""Faults as text: what is understood, and what is said about the rest."""

import pytest

from emulator import faults
from emulator.faults import NEVER_NS, Fault, Kind, is_fault, parse_fault
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols.errors import ConfigError
from protocols.rig import load_rig


def test_a_fault_in_all_its_parts() -> None:
    text = "heartbeat-loss@joint3:t=5,for=0.25"
    assert parse_fault(text) == Fault(text, Kind.HEARTBEAT_LOSS, "joint3", 5_000_000_000, 5_250_000_000)


def test_defaults() -> None:
    assert parse_fault("overtemperature") == Fault("overtemperature", Kind.OVERTEMPERATURE, "", 0, NEVER_NS, 0x4310)
    assert parse_fault("emcy@can0:code=ff01,t=1").code == 0xFF01
    assert parse_fault("sync-jump@joint1:by=7").by == 7
    assert parse_fault("garbage@can1:count=5,seed=9").count == 5


@pytest.mark.parametrize("kind", Kind)
def test_every_kind_is_documented_and_parsed(kind: Kind) -> None:
    text = f"{kind}@joint1" + (":code=1000" if kind is Kind.EMCY else "")
    assert is_fault(text) and parse_fault(text).kind is kind
    assert f" {kind}" in (faults.__doc__ or "").replace(",", " ").replace("\n", " ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "fault : nothing is none of the drives': heartbeat-loss, sdo-silence, "),
        ("fire@joint1", "fault fire@joint1: fire is none of the drives': heartbeat-loss"),
        ("stop@joint1:for=2", "'for=2' is no setting of stop; write t=..."),
        ("sync-loss:t", "'t' is no setting of sync-loss; write t, for=..."),
        ("sync-loss:t=soon", "t=soon must be a number from 0 on."),
        ("sync-loss:t=-1", "t=-1 must be a number from 0 on."),
        ("sync-loss:t=nan", "t=nan must be a number from 0 on."),
        ("emcy@joint1:t=1", "which error? Write emcy@PLACE:code=4310"),
        ("emcy:code=zz", "code=zz is no error code; write four hexadecimal digits such as 4310."),
        ("emcy:code=10000", "code=10000 is no error code"),
        ("emcy:code=0", "code=0 is no error code"),
    ],
)
def test_what_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_fault(text)
    assert message in str(error.value)


def test_places_that_do_not_exist() -> None:
    rig, robot = load_rig("tx40-rig")
    arm = EmulatedRig(rig, load_machine(rig, robot))
    with pytest.raises(ConfigError) as error:
        arm.schedule(parse_fault("sync-loss@joint9:t=1"))
    assert str(error.value) == (
        "fault sync-loss@joint9:t=1: the rig has no joint9; write one of can0, can1, joint1, joint2, joint3, joint4,"
        " joint5, joint6."
    )
