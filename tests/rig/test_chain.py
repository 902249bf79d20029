"""The whole chain in simulated time: emulated TX40, frames, MCAP, parameters beside the true ones.

Seeds: 101 and 102 are for this test alone; nothing was tuned on them.
"""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from daq.recorder import Recorder, Summary
from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from ident.identify import Identification, identify, truth_values
from ident.recorded import signals
from protocols import config
from protocols.cia402 import Mode
from protocols.motion import Motion, sample
from protocols.recording import read_recording
from protocols.rig import load_rig

# Janot et al. 2014, Table 3; XX3R and ZZ3R as far as a body can have them
ESSENTIAL_OF_THE_PAPER = [
    "ZZ1R",
    "Fv1",
    "Fc1",
    "XX2R",
    "XZ2R",
    "ZZ2R",
    "MX2R",
    "Fv2",
    "Fc2",
    "XX3R",
    "ZZ3R",
    "MY3R",
    "Ia3",
    "Fv3",
    "Fc3",
    "MX4",
    "Ia4",
    "Fv4",
    "Fc4",
    "MY5R",
    "Ia5",
    "Fv5",
    "Fc5",
    "Ia6",
    "Fv6",
    "Fc6",
    "fv_m6",
    "fc_m6",
]


def record(name: str, motion: str, seed: int, path: Path, mode: Mode = Mode.CST) -> Summary:
    """One motion of a shipped rig, through every frame, into a file."""
    rig, robot = load_rig(f"{name}-rig")
    rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, seed=seed))
    plan = config.read(config.locate(motion), Motion)
    buses = [b.name for b in rig.bus]
    recorder = Recorder(path, rig, robot, seed=seed)
    lockstep(
        EmulatedRig(rig, load_machine(rig, robot)),
        Host(rig, robot, plan, mode),
        rig.sync_period_us * 1000,
        lambda t_ns, bus, frames: recorder.frames(buses[bus], [(t_ns, f) for f in frames]),
    )
    return recorder.close()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("chain")
    paths = [folder / "train.mcap", folder / "test.mcap"]
    for path, motion, seed in zip(paths, ("tx40-train", "tx40-test"), (101, 102), strict=True):
        assert record("tx40", motion, seed, path).verdict == "LOSSLESS"
    return paths


@pytest.fixture(scope="module")
def identified(recordings: list[Path]) -> Identification:
    train, test = (read_recording(p) for p in recordings)
    rig, robot = load_rig("tx40-rig")
    truth = truth_values(robot, load_machine(rig, robot))
    return identify([signals(train)], train.robot, ["wls"], [signals(test)], truth=truth)[0]


def test_the_essential_parameters_are_the_papers(identified: Identification) -> None:
    found = {p.name for p in identified.result.parameters if p.essential}
    assert set(ESSENTIAL_OF_THE_PAPER) <= found
    assert len(found) <= len(ESSENTIAL_OF_THE_PAPER) + 3, "a reduction that keeps everything reduces nothing"


def test_essential_parameters_lie_within_three_standard_deviations(identified: Identification) -> None:
    far = {
        p.name: (p.value - p.truth) / p.std
        for p in identified.result.parameters
        if p.essential and p.truth is not None and abs(p.value - p.truth) > 3 * p.std
    }
    assert not far


def test_standard_deviations_are_not_too_large_either(identified: Identification) -> None:
    z = np.array([(p.value - p.truth) / p.std for p in identified.result.parameters if p.truth is not None])
    assert len(z) == 60
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.5


def test_unseen_motion_is_predicted_to_the_noise(identified: Identification) -> None:
    fit = identified.result.validation
    assert fit is not None
    assert fit.noise_floor_percent is not None
    assert fit.relative_error_percent < 1.2 * fit.noise_floor_percent
    assert 1.0 < fit.noise_floor_percent < 6.0, "an emulator without noise would make this test empty"


def test_a_wrong_drive_gain_shows(recordings: list[Path]) -> None:
    """Negative control: the same recordings under a robot file whose third drive gain is 20 % off."""
    train = read_recording(recordings[0])
    joints = list(train.robot.joint)
    gain = joints[2].drive.drive_gain_Nm_A * 1.2
    joints[2] = msgspec.structs.replace(joints[2], drive=msgspec.structs.replace(joints[2].drive, drive_gain_Nm_A=gain))
    wrong = msgspec.structs.replace(train.robot, joint=joints)
    rig, robot = load_rig("tx40-rig")
    truth = truth_values(robot, load_machine(rig, robot))
    runs = [signals(read_recording(p, wrong)) for p in recordings]
    result = identify(runs[:1], wrong, ["wls"], runs[1:], truth=truth)[0].result
    far = [p.name for p in result.parameters if p.truth is not None and abs(p.value - p.truth) > 3 * p.std]
    assert {"Fv3", "Fc3", "Ia3"} <= set(far)


def test_the_log_does_not_know_the_truth(recordings: list[Path]) -> None:
    rig, robot = load_rig("tx40-rig")
    machine = load_machine(rig, robot)
    attached = read_recording(recordings[0])
    assert attached.robot == robot
    assert attached.rig == rig.for_recording()
    assert attached.robot.joint[0].parameters != machine.joint[0].parameters
    assert b"tx40-machine" not in recordings[0].read_bytes()


def test_the_same_seed_gives_the_same_file(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(files, (103, 103, 104), strict=True):
        record("emps", "emps-test", seed, path)
    a, b, c = (path.read_bytes() for path in files)
    assert a == b
    assert a != c


def test_position_mode_follows_too(tmp_path: Path) -> None:
    record("tx40", "tx40-test", 105, tmp_path / "csp.mcap", Mode.CSP)
    run = read_recording(tmp_path / "csp.mcap")
    plan = config.read(config.locate("tx40-test"), Motion)
    reference = sample(plan, run.robot, run.period_s, run.position_rad[0])
    end = run.position_rad[-100]
    assert end == pytest.approx(reference.q[-1], abs=0.02)


def test_emps_is_identified_as_published(tmp_path: Path) -> None:
    """One prismatic axis: Janot, Gautier & Brunot's M, Fv, Fc and offset, which its robot file has as the truth."""
    record("emps", "emps-train", 106, tmp_path / "emps.mcap")
    run = read_recording(tmp_path / "emps.mcap")
    result = identify([signals(run)], run.robot, ["wls"])[0].result
    value = {p.name: p for p in result.parameters}
    truth = run.robot.joint[0].parameters
    mass = next(p for n, p in value.items() if n not in {"Fv1", "Fc1"} and not n.startswith("off"))
    for p, true in (
        (mass, truth.mass_kg + truth.rotor_inertia_kgm2),
        (value["Fv1"], truth.viscous_Nms_rad),
        (value["Fc1"], truth.coulomb_Nm),
    ):
        assert abs(p.value - true) < 4 * p.std, p.name
