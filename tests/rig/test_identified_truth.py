"""The emulated TX40 on its shipped motions: what went in comes out, within its own standard deviations."""

import msgspec
import numpy as np
import pytest

from emulator.machine import load_machine
from emulator.plant import Plant
from ident.dataset import Signals
from ident.identify import Identification, identify, truth_values
from protocols import config
from protocols.motion import Motion, sample
from protocols.rig import Rig, load_rig
from protocols.robot import Robot

CST = 10  # cyclic synchronous torque


def run(name: str, rig: Rig, nominal: Robot, machine: Robot, seed: int) -> Signals:
    """Closed loop of eq. (19): encoder counts and per-mille currents as the drives send them."""
    period = rig.sync_period_us * 1e-6
    J = nominal.joints
    noise, encoder = (np.broadcast_to(v, J) for v in (rig.emulated.current_noise_A, rig.emulated.encoder_noise_rad))
    plant = Plant(machine, period, np.random.default_rng(seed), noise, encoder)
    motion = config.read(config.locate(name), Motion)
    reference = sample(motion, nominal, period, plant.q.copy())
    control = [j.control for j in nominal.joint if j.control is not None]
    w, z, inertia = (
        np.array([getattr(c, key) for c in control]) for key in ("natural_frequency_rad_s", "damping", "inertia_kgm2")
    )
    rated = np.array([j.drive.rated_current_A for j in nominal.joint])
    limit = np.array([j.drive.max_current_A for j in nominal.joint])
    before = plant.q.copy()
    positions, currents = np.empty_like(reference.q), np.empty_like(reference.q)
    for k in range(len(reference.t_s)):
        counts, _, mean = plant.measure()
        q = nominal.joint_position(counts)
        positions[k], currents[k] = q, np.rint(1000 * mean / rated) * rated / 1000
        tau = (w**2 * (reference.q[k] - q) - 2 * z * w * (q - before) / period) * inertia
        before = q
        plant.advance(np.full(J, CST), np.zeros(J), np.clip(nominal.drive_current(tau), -limit, limit))
    delay = np.array([j.drive.current_delay_s for j in nominal.joint])
    return Signals(name, nominal.joint_names, reference.t_s, positions, nominal.joint_torque(currents), delay)


@pytest.fixture(scope="module")
def identified() -> list[Identification]:
    rig, nominal = load_rig("tx40-rig")
    if rig.emulated.machine is None:
        rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, machine="tx40-machine"))
    machine = load_machine(rig, nominal)
    seen, unseen = (run(name, rig, nominal, machine, seed) for seed, name in enumerate(("tx40-train", "tx40-test")))
    return identify([seen], nominal, ("wls", "ols"), [unseen], truth=truth_values(nominal, machine))


def test_essential_parameters_are_within_three_standard_deviations(identified: list[Identification]) -> None:
    for found in identified:
        essential = [p for p in found.result.parameters if p.essential]
        z = {p.name: (p.value - (p.truth or 0.0)) / p.std for p in essential}
        assert len(essential) >= 26
        assert max(abs(v) for v in z.values()) < 3, z


def test_standard_deviations_are_honest_over_all_parameters(identified: list[Identification]) -> None:
    z = np.array([(p.value - (p.truth or 0.0)) / p.std for p in identified[0].result.parameters])
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4


def test_unseen_motion_is_predicted_down_to_the_noise(identified: list[Identification]) -> None:
    validation = identified[0].result.validation
    assert validation is not None and validation.noise_floor_percent is not None
    assert validation.relative_error_percent < 1.2 * validation.noise_floor_percent


def test_the_nominal_robot_would_not_do(identified: list[Identification]) -> None:
    """Negative control: the a-priori parameters miss the torques by far more than the noise."""
    found = identified[0]
    prior = np.array([p.prior for p in found.result.parameters])
    residual = [(o.y - o.predict(prior))[o.used] for o in found.unseen]
    torque = [o.y[o.used] for o in found.unseen]
    assert np.linalg.norm(np.concatenate(residual)) > 0.1 * np.linalg.norm(np.concatenate(torque))


def test_the_paper_s_reduction_is_accepted(identified: list[Identification]) -> None:
    (F,) = [s for s in identified[0].result.statistics if s.name == "F, model reduction"]
    assert F.verdict == "accepted"
    assert "of 60 base parameters" in F.null
