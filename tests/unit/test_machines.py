"""The shipped robots, their emulated truth and their motions."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.machine import load_machine
from emulator.plant import Plant
from protocols import config
from protocols.errors import ConfigError
from protocols.motion import Motion, sample
from protocols.rig import Emulated, Rig, load_rig
from protocols.robot import EffectEntry, Robot, load

Floats = NDArray[np.float64]

# Janot et al. 2014, Table 3, with XX3R and ZZ3R as far from it as a body must be: XX3R - ZZ3R = XX3 - YY3 - ZZ3 < 0.
TABLE_3 = {
    "ZZ1R": 1.25, "Fv1": 8.20, "Fc1": 6.55,
    "XX2R": -0.48, "XZ2R": -0.16, "ZZ2R": 1.09, "MX2R": 2.21, "Fv2": 5.68, "Fc2": 7.77,
    "XX3R": 0.124, "ZZ3R": 0.126, "MY3R": -0.60, "Ia3": 0.10, "Fv3": 2.03, "Fc3": 6.0,
    "MX4R": -0.02, "Ia4": 0.03, "Fv4": 1.15, "Fc4": 2.27,
    "MY5R": -0.03, "Ia5": 0.04, "Fv5": 1.90, "Fc5": 2.80,
    "Ia6": 0.01, "Fv6": 0.69, "Fc6": 2.00, "fv_m6": 0.63, "fc_m6": 1.81,
}  # fmt: skip


def tx40_machine() -> Robot:
    rig, robot = load_rig("tx40-rig")
    return load_machine(rig, robot)


def base_parameters(robot: Robot) -> dict[str, float]:
    """Closed-form regrouping of Gautier & Khalil 1990 for revolute joints, in the names of the paper's Table 3.

    Independent of the projection that tests/studies/tx40_machine.py uses.
    """
    link = [
        dict(zip(("M", "MX", "MY", "MZ", "XX", "XY", "XZ", "YY", "YZ", "ZZ"), j.parameters.inertial(), strict=True))
        for j in robot.joint
    ]
    for j in range(5, 0, -1):
        joint, of, to = robot.joint[j], link[j], link[j - 1]
        c, s, d, r = np.cos(joint.alpha_rad), np.sin(joint.alpha_rad), joint.d_m, joint.r_m
        moment = of["MZ"] + r * of["M"]
        steiner = of["YY"] + 2 * r * of["MZ"] + r**2 * of["M"]
        to["XX"] += steiner
        to["XY"] += d * s * moment
        to["XZ"] -= d * c * moment
        to["YY"] += c**2 * steiner + d**2 * of["M"]
        to["YZ"] += c * s * steiner
        to["ZZ"] += s**2 * steiner + d**2 * of["M"]
        to["MX"] += d * of["M"]
        to["MY"] -= s * moment
        to["MZ"] += c * moment
        to["M"] += of["M"]
        of["XX"] -= of["YY"]
    base = {f"{key}{j + 1}R": link[j][key] for j in range(1, 6) for key in ("XX", "XY", "XZ", "YZ", "ZZ", "MX", "MY")}
    base["ZZ1R"] = link[0]["ZZ"]
    p = [joint.parameters for joint in robot.joint]
    base["ZZ1R"] += p[0].rotor_inertia_kgm2
    base["ZZ2R"] += p[1].rotor_inertia_kgm2
    for j in range(2, 6):
        base[f"Ia{j + 1}"] = p[j].rotor_inertia_kgm2
    base["Ia5"] += p[5].rotor_inertia_kgm2  # motor 6 turns with joint 5 as well
    for j in range(6):
        shared = p[5].motor_viscous_Nms_rad if j >= 4 else 0.0
        base[f"Fv{j + 1}"] = p[j].viscous_Nms_rad + shared
        base[f"Fc{j + 1}"] = p[j].coulomb_Nm + (p[5].motor_coulomb_Nm if j == 5 else 0.0)
    base["fv_m6"], base["fc_m6"] = p[5].motor_viscous_Nms_rad, p[5].motor_coulomb_Nm
    return base


def test_tx40_machine_has_the_essential_base_parameters_of_the_paper() -> None:
    base = base_parameters(tx40_machine())
    assert {name: base[name] for name in TABLE_3} == pytest.approx(TABLE_3, abs=1e-9)
    others = {name: value for name, value in base.items() if name not in TABLE_3}
    assert len(others) == 26
    assert max(abs(value) for value in others.values()) < 1e-3  # kg·m², kg·m: the wrist's own bodies, little else
    assert all(joint.parameters.offset_Nm == 0 for joint in tx40_machine().joint)


def test_the_regrouping_test_sees_a_moved_mass() -> None:
    machine = tx40_machine()
    heavier = msgspec.structs.replace(machine.joint[3].parameters, mass_kg=3.0)
    joints = [*machine.joint]
    joints[3] = msgspec.structs.replace(joints[3], parameters=heavier)
    base = base_parameters(msgspec.structs.replace(machine, joint=joints))
    assert base["MX2R"] != pytest.approx(TABLE_3["MX2R"], abs=1e-3)


@pytest.mark.parametrize("robot", [load("tx40"), tx40_machine()], ids=lambda robot: robot.name)
def test_every_link_is_a_body_that_could_be_built(robot: Robot) -> None:
    for joint in robot.joint:
        p = joint.parameters
        m, mc = p.mass_kg, np.array(p.first_moment_kgm)
        xx, xy, xz, yy, yz, zz = p.inertia_kgm2
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = np.trace(inertia) / 2 * np.eye(3) - inertia  # density-weighted second moments (Wensing et al. 2018)
        central = np.linalg.eigvalsh(second - np.outer(mc, mc) / m)
        assert m > 0
        assert central.min() > 1e-6  # kg·m²: every link extends in every direction
        assert p.rotor_inertia_kgm2 > 0
        assert min(p.viscous_Nms_rad, p.coulomb_Nm, p.motor_viscous_Nms_rad, p.motor_coulomb_Nm) >= 0


def test_the_nominal_tx40_is_not_the_truth_but_within_three_sigma_of_it() -> None:
    nominal, truth = load("tx40"), tx40_machine()
    for prior, true in zip(nominal.joint, truth.joint, strict=True):
        assert prior.sigma is not None
        assert true.parameters != prior.parameters
        assert true.drive == prior.drive
        for field in ("mass_kg", "first_moment_kgm", "inertia_kgm2", "rotor_inertia_kgm2", "viscous_Nms_rad"):
            away = np.abs(np.array(getattr(true.parameters, field)) - np.array(getattr(prior.parameters, field)))
            assert np.all(away <= 3 * np.array(getattr(prior.sigma, field))), (prior.name, field)


def test_emps_moves_the_mass_its_authors_found_with_their_control_law() -> None:
    joint = load("emps").joint[0]
    assert joint.parameters.mass_kg == 95.11
    assert joint.drive.counts_per_rad == pytest.approx(1e7)  # per metre: 1e-7 m per count
    assert joint.control is not None
    w, z = joint.control.natural_frequency_rad_s, joint.control.damping
    assert w / (2 * z) == pytest.approx(160.18, rel=1e-3)
    assert 2 * z * w * joint.control.inertia_kgm2 / joint.drive.drive_gain_Nm_A == pytest.approx(243.45, rel=1e-3)


# --- closed loop ---


def track(rig: Rig, robot: Robot, machine: Robot, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """PD law of eq. (19) with one cycle of delay, as a host streams it; reference, position, current, (T, J)."""
    period_s = rig.sync_period_us * 1e-6
    J = robot.joints
    reference = sample(motion, robot, period_s, start=np.zeros(J))
    plant = Plant(
        machine,
        period_s,
        np.random.default_rng(rig.emulated.seed),
        np.array(rig.emulated.current_noise_A),
        np.array(rig.emulated.encoder_noise_rad),
    )
    law = [joint.control for joint in robot.joint if joint.control is not None]
    w = np.array([c.natural_frequency_rad_s for c in law])
    z, inertia = np.array([c.damping for c in law]), np.array([c.inertia_kgm2 for c in law])
    mode, target = np.full(J, 10), np.zeros(J)
    positions, currents = np.empty_like(reference.q), np.empty_like(reference.q)
    q = last = robot.joint_position(plant.measure()[0])
    for n, wanted in enumerate(reference.q):
        plant.advance(mode, np.zeros(J), target)  # target of what was measured one period earlier
        target = robot.drive_current((w**2 * (wanted - q) - 2 * z * w * (q - last) / period_s) * inertia)
        positions[n], currents[n] = plant.q, plant.measure()[2]
        q, last = robot.joint_position(plant.measure()[0]), q
    return reference.q, positions, currents


@pytest.mark.parametrize(
    ("rig_name", "motion_name"),
    [("tx40-rig", "tx40-train"), ("tx40-rig", "tx40-test"), ("emps-rig", "emps-train"), ("emps-rig", "emps-test")],
)
def test_shipped_motions_are_tracked_within_the_drives_limits(rig_name: str, motion_name: str) -> None:
    rig, robot = load_rig(rig_name)
    motion = config.read(config.locate(motion_name), Motion)
    wanted, found, current = track(rig, robot, load_machine(rig, robot), motion)
    error = wanted - found
    relative = np.linalg.norm(error, axis=0) / np.linalg.norm(wanted - wanted.mean(axis=0), axis=0)
    assert relative.max() < 0.06  # a PD law without velocity reference lags by 1/kp, 15 to 25 ms
    assert np.abs(error[-1]).max() < 0.04  # at rest: Coulomb friction over stiffness
    limit = np.array([joint.drive.max_current_A for joint in robot.joint])
    assert np.all(np.abs(current) < 0.8 * limit)
    ringing = np.diff(current, n=2, axis=0).std(axis=0) / np.sqrt(6)  # white noise alone gives its own deviation
    assert np.all(ringing < 1.2 * np.array(rig.emulated.current_noise_A) + 0.01)


@pytest.mark.parametrize("motion_name", ["tx40-train", "tx40-test"])
def test_tx40_motions_use_the_range_and_the_speed_of_every_joint(motion_name: str) -> None:
    robot = load("tx40")
    reference = sample(config.read(config.locate(motion_name), Motion), robot, 1e-3)
    fastest = np.abs(reference.qd).max(axis=0) / [joint.velocity_max_rad_s for joint in robot.joint]
    assert fastest.min() > 0.4
    reversals = (np.diff(np.sign(reference.qd), axis=0) != 0).sum(axis=0)
    assert reversals.min() >= 4
    assert 8.0 <= reference.t_s[-1] <= 21.0


# --- load_machine ---


def test_without_a_machine_the_truth_is_the_nominal_robot() -> None:
    rig, robot = load_rig("emps-rig")
    assert load_machine(rig, robot) is robot


def test_a_machine_is_found_beside_the_rig_file(tmp_path: Path) -> None:
    rig, robot = load_rig("emps-rig")
    other = msgspec.structs.replace(robot, name="worn")
    (tmp_path / "worn.toml").write_text(config.to_toml(other), encoding="utf-8")
    named = msgspec.structs.replace(rig, emulated=Emulated(machine="worn.toml"))
    assert load_machine(named, robot, tmp_path).name == "worn"


def test_a_machine_that_is_nowhere() -> None:
    rig, robot = load_rig("tx40-rig")
    named = msgspec.structs.replace(rig, emulated=Emulated(machine="tx41-machine"))
    with pytest.raises(ConfigError, match=r"machine tx41-machine: no such file, and not one of the shipped tx40-mach"):
        load_machine(named, robot)


def test_a_machine_with_other_joints() -> None:
    rig, robot = load_rig("emps-rig")
    named = msgspec.structs.replace(rig, emulated=Emulated(machine="tx40-machine"))
    with pytest.raises(ConfigError, match=r"EMPS rig: machine tx40-machine has the joints joint1, .*EMPS has carriage"):
        load_machine(named, robot)


def test_effects_of_machine_and_rig_come_together_with_every_parameter() -> None:
    rig, robot = load_rig("emps-rig")
    spring = msgspec.structs.replace(robot, effect=[EffectEntry(effect="spring", joint="carriage")])
    stribeck = EffectEntry(effect="friction.stribeck", joint="carriage", parameters={"stiction_Nm": 7.0})
    machine = load_machine(msgspec.structs.replace(rig, emulated=Emulated(effect=[stribeck])), spring)
    assert [entry.effect for entry in machine.effect] == ["spring", "friction.stribeck"]
    assert machine.effect[1].parameters["stiction_Nm"] == 7.0
    assert machine.effect[1].parameters["exponent"] == 1.0


def test_an_effect_that_is_not_emulated() -> None:
    rig, robot = load_rig("emps-rig")
    entry = EffectEntry(effect="unlisted", joint="carriage")
    with pytest.raises(ConfigError, match=r"EMPS rig: unlisted is what explain answers .* it cannot be emulated"):
        load_machine(msgspec.structs.replace(rig, emulated=Emulated(effect=[entry])), robot)
    spring = msgspec.structs.replace(robot, effect=[EffectEntry(effect="spring")])
    with pytest.raises(ConfigError, match=r"EMPS rig: spring needs a joint: one of carriage\."):
        load_machine(rig, spring)
