"""Faults of the bus as text: what is understood, what is refused and how, whom it strikes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.disturbance import EXACT, NEVER_NS, Disturbance, Kind, is_disturbance, parse
from protocols.errors import ConfigError
from protocols.rig import Rig, load_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("tx40-rig")[0]


def test_what_the_texts_mean(rig: Rig) -> None:
    drop = parse("drop@can0:count=3", rig)
    assert (drop.kind, drop.bus, drop.node, drop.mask, drop.left) == (Kind.DROP, "can0", None, 0, 3)
    corrupt = parse("corrupt@can1:id=181,p=0.25,seed=4,t=2,for=0.5", rig)
    assert (corrupt.can_id, corrupt.mask, corrupt.probability) == (0x181, EXACT, 0.25)
    assert (corrupt.begin_ns, corrupt.end_ns) == (2_000_000_000, 2_500_000_000)
    delay = parse("delay@joint5:ms=1.5,id=180,mask=780", rig)
    assert (delay.bus, delay.node, delay.delay_ns, delay.mask) == ("can1", 5, 1_500_000, 0x780)
    jitter = parse("jitter@can0:us=50", rig)
    assert (jitter.can_id, jitter.mask, jitter.delay_ns) == (0x80, EXACT, 50_000)
    off = parse("bus-off@joint3:t=5,restart=250", rig)
    assert (off.bus, off.node, off.begin_ns, off.restart_ns) == ("can0", 3, 5_000_000_000, 250_000_000)
    assert parse("bus-off@can0:restart=0", rig).restart_ns == NEVER_NS
    assert parse("duplicate@can0", rig).end_ns == NEVER_NS


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("drip@can0", "drip is none of the bus's: drop, duplicate, corrupt, delay, jitter, bus-off."),
        ("@can0", "nothing is none of the bus's"),
        ("drop@can7", "TX40 rig has no can7; write one of can0, can1, joint1,"),
        ("drop", "TX40 rig has no such place; write one of"),
        ("drop@can0:cuont=3", "'cuont=3' is no setting of drop; write t, for, count, p, seed, id, mask=..."),
        ("drop@can0:count", "'count' is no setting of drop"),
        ("bus-off@can0:count=2", "'count=2' is no setting of bus-off; write t, restart=..."),
        ("drop@can0:count=three", "count=three is no number."),
        ("drop@can0:t=-1", "t=-1 must be a number from 0 on."),
        ("drop@can0:t=nan", "t=nan must be a number from 0 on."),
        ("drop@can0:p=1.5", "p=1.5 is no probability; write one between 0 and 1."),
        ("drop@can0:id=xyz", "id=xyz is no hexadecimal number, such as id=181."),
        ("delay@can0", "by how much? Write ms=..."),
        ("jitter@can0", "by how much? Write us=..."),
    ],
)
def test_what_is_refused_and_how(rig: Rig, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse(text, rig)
    assert str(error.value).startswith(f"fault {text}: ")
    assert said in str(error.value)


@given(st.text(max_size=30))
def test_any_text_is_understood_or_refused(text: str) -> None:
    rig = load_rig("emps-rig")[0]
    for attempt in (text, f"drop@can0:{text}", f"{text}@can0", f"drop@{text}"):
        try:
            assert isinstance(parse(attempt, rig), Disturbance)
        except ConfigError as error:
            assert str(error).startswith("fault ")


def test_faults_of_drives_are_left_to_others() -> None:
    assert is_disturbance("corrupt@can0:id=181")
    assert not is_disturbance("heartbeat-loss@joint3:t=5")


def test_a_joint_means_what_its_drive_sends(rig: Rig) -> None:
    drop = parse("drop@joint2", rig)
    struck = [i for i in range(0x800) if drop.strikes(0, i)]
    assert struck == [0x082, 0x182, 0x282, 0x382, 0x482, 0x582, 0x702]


def test_probability_is_a_share_and_repeats(rig: Rig) -> None:
    def struck(text: str) -> list[bool]:
        drop = parse(text, rig)
        return [drop.strikes(n, 0x181) for n in range(10_000)]

    assert sum(struck("drop@can0:p=0.1")) == pytest.approx(1000, rel=0.1)
    assert struck("drop@can0:p=0.1,seed=3") == struck("drop@can0:p=0.1,seed=3")
    assert struck("drop@can0:p=0.1,seed=3") != struck("drop@can0:p=0.1,seed=4")


def test_count_and_time_end_it(rig: Rig) -> None:
    drop = parse("drop@can0:count=2,t=1,for=1", rig)
    moments = [0, 999_999_999, 1_000_000_000, 1_999_999_999, 1_500_000_000]
    assert [drop.strikes(t, 0x181) for t in moments] == [False, False, True, True, False]
    ended = parse("drop@can0:t=1,for=1", rig)
    assert not ended.strikes(2_000_000_000, 0x181)
