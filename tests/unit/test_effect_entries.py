"""Effects as text and tables: what is understood, what is filled in, what is refused and how."""

import math

import msgspec
import numpy as np
import pytest

from emulator.machine import EMULATED_EFFECTS
from emulator.plant import Plant
from protocols.effectentries import check_effects, default_of, format_effect, parse_effect
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import EFFECTS
from protocols.errors import ConfigError
from protocols.robot import EffectEntry, Robot, load

TX40, EMPS = load("tx40"), load("emps")


def test_the_vocabulary_is_complete() -> None:
    assert set(EFFECT_KINDS) == set(EFFECTS) - {"unlisted"}
    assert set(EMULATED_EFFECTS) == set(EFFECT_KINDS)
    units = ("_Nm", "_rad", "_rad_s", "_s", "_C", "_per_K", "_K_W", "_A", "_Hz", "_kg", "_m", "_kgm2", "_rad3")
    plain = {"exponent", "coefficient", "driving", "braking", "ratio", "other", "order", "loss", "error", "damping"}
    for kind in EFFECT_KINDS.values():
        assert len(set(kind.names)) == len(kind.names)
        for parameter in kind.parameters:
            assert parameter.name in plain or parameter.name.endswith(units), parameter.name
            assert parameter.low < parameter.high
            assert parameter.meaning


def test_text_is_read_and_written_back() -> None:
    text = "friction.stribeck@joint2:stiction_Nm=3,velocity_rad_s=0.05"
    entry = parse_effect(text)
    assert entry == EffectEntry(
        effect="friction.stribeck", joint="joint2", parameters={"stiction_Nm": 3.0, "velocity_rad_s": 0.05}
    )
    assert format_effect(entry) == text
    assert parse_effect(" base.tilt : x_rad = 1e-2 ,") == EffectEntry(effect="base.tilt", parameters={"x_rad": 0.01})
    assert format_effect(parse_effect("drive.delay")) == "drive.delay"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction.sticky@joint1", r"there is no effect friction.sticky. Known are friction.stribeck, friction.asym"),
        ("@joint1", r"there is no effect \(empty\)"),
        ("spring@joint1:k=3", r"spring has no parameter k. It has stiffness_Nm_rad, centre_rad, cubic"),
        ("spring@joint1:stiffness_Nm_rad", r"stiffness_Nm_rad is not name=number. Write KEY@JOINT:name=value,name"),
        ("spring@joint1:stiffness_Nm_rad=soft", r"stiffness_Nm_rad=soft is not name=number"),
        ("spring@joint1:stiffness_Nm_rad=nan", r"stiffness_Nm_rad=nan is not name=number"),
        ("spring@joint1:centre_rad=1,centre_rad=2", r"centre_rad is given twice"),
        ("unlisted@joint1", r"unlisted is what explain answers where nothing listed fits; it cannot be emulated"),
    ],
)
def test_text_that_says_nothing_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        parse_effect(text)
    assert str(error.value).startswith(f"--effect {text}: ")


@pytest.mark.parametrize(
    ("text", "robot", "message"),
    [
        ("spring@joint9", TX40, r"rig.toml: spring: TX40 has no joint joint9, but joint1, joint2, joint3, .*joint6\."),
        ("spring", TX40, r"spring needs a joint: one of joint1, joint2"),
        ("payload@joint6", TX40, r"payload belongs to the whole arm, not to joint6. Leave the joint out\."),
        (
            "friction.load@joint1:coefficient=1.5",
            TX40,
            r"friction.load@joint1: coefficient = 1.5 is outside 0 to 1 \(friction per transmitted torque",
        ),
        ("drive.delay@joint1:delay_s=-1e-3", TX40, r"delay_s = -0.001 s is outside 0 to 0.05 s \(age beyond"),
        ("transmission.coupling@carriage", EMPS, r"needs at least 2 joints \(parts that turn .*; EMPS has 1\."),
        (
            "transmission.coupling@joint1",
            TX40,
            r"coupling@joint1: other = 0 is not the number of another joint of TX40, 1 to 6; joint1 itself is 1\.",
        ),
        ("transmission.coupling@joint2:other=2", TX40, r"other = 2 is not the number of another joint"),
        ("transmission.coupling@joint2:other=1.5", TX40, r"other = 1.5 is not the number of another joint"),
    ],
)
def test_what_an_arm_cannot_have_is_refused(text: str, robot: Robot, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_effects([parse_effect(text)], robot, "rig.toml")


def test_twice_the_same_is_refused_unless_there_may_be_several() -> None:
    ripple, gain = parse_effect("motor.ripple@joint1"), parse_effect("drive.gain@joint1")
    assert len(check_effects([ripple, ripple], TX40, "rig.toml")) == 2
    with pytest.raises(ConfigError, match=r"rig.toml: drive.gain@joint1 is given 2 times; give it once\."):
        check_effects([gain, gain], TX40, "rig.toml")


def test_defaults_scale_with_the_axis() -> None:
    stiction = EFFECT_KINDS["friction.stribeck"].parameters[0]
    for robot in (TX40, EMPS):
        for joint in robot.joint:
            coulomb = joint.parameters.coulomb_Nm + joint.parameters.motor_coulomb_Nm
            assert default_of(stiction, joint) == pytest.approx(0.6 * coulomb)
    elasticity = EFFECT_KINDS["transmission.elasticity"].parameters[0]
    inertia = TX40.joint[2].control
    assert inertia is not None
    locked_Hz = math.sqrt(default_of(elasticity, TX40.joint[2]) / inertia.inertia_kgm2) / (2 * math.pi)
    assert 10 < locked_Hz < 20


def test_every_effect_with_its_defaults_moves_every_robot() -> None:
    for robot in (EMPS, TX40):
        for key, kind in EFFECT_KINDS.items():
            if kind.least_joints > robot.joints:
                continue
            joint = "" if kind.place == "arm" else robot.joint_names[-1]
            entries = check_effects([EffectEntry(effect=key, joint=joint)], robot, "test")
            arm = msgspec.structs.replace(robot, effect=entries)
            plant = Plant(arm, 1e-3, np.random.default_rng(1), np.zeros(arm.joints), np.zeros(arm.joints))
            for _ in range(20):
                plant.advance(np.full(arm.joints, 10), np.zeros(arm.joints), np.zeros(arm.joints))
            assert np.isfinite(plant.q).all(), key
            assert np.abs(plant.qd).max() < 0.5, key


def test_an_eccentricity_beyond_half_the_disc_is_refused() -> None:
    entry = parse_effect("sensor.eccentricity@joint1:amplitude_rad=0.1")
    arm = msgspec.structs.replace(TX40, effect=[entry])
    with pytest.raises(ConfigError, match=r"joint1: amplitude_rad must be below 0.0156 rad at this order"):
        Plant(arm, 1e-3, np.random.default_rng(1), np.zeros(6), np.zeros(6))
