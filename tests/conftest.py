"""Motions of the shipped TX40 with known parameters, made without the emulator: torques straight from the model.
The same as recordings."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from daq.cycles import Cycle
from daq.recorder import run_start
from daq.rows import CycleRows
from daq.store import Store
from ident.dataset import Signals
from ident.model import Model
from protocols import config, topics
from protocols.rig import load_rig
from protocols.robot import Robot, load

PERIOD_S = 0.001


@pytest.fixture(scope="session")
def tx40() -> Robot:
    return load("tx40")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the public recordings, which are not part of this repository."""
    folder = Path(os.environ.get("ARMRIG_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip("the public recordings are not here; ARMRIG_SHARED names their folder")
    return folder


@pytest.fixture(scope="session")
def make_signals() -> Callable[..., Signals]:
    """Signals of a robot on a random smooth motion: exact inverse dynamics plus white torque noise."""

    def make(robot: Robot, seed: int, duration_s: float = 6.0, noise_Nm: float = 0.0, delay_s: float = 0.0) -> Signals:
        rng = np.random.default_rng(seed)
        J = robot.joints
        t = np.arange(round(duration_s / PERIOD_S)) * PERIOD_S
        frequency = rng.uniform(0.2, 1.2, (5, J))
        amplitude, phase = rng.uniform(0.1, 0.35, (5, J)), rng.uniform(0, 2 * np.pi, (5, J))

        def state(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            w = 2 * np.pi * frequency
            angle = w * t_s[:, None, None] + phase
            return (
                (amplitude * np.sin(angle)).sum(1),
                (amplitude * w * np.cos(angle)).sum(1),
                -(amplitude * w**2 * np.sin(angle)).sum(1),
            )

        model = Model.of(robot)
        tau = (model.regressor(*state(t - delay_s)) @ model.theta(robot)).T
        tau = tau + noise_Nm * rng.normal(size=tau.shape)
        return Signals(f"motion {seed}", robot.joint_names, t, state(t)[0], tau, np.full(J, delay_s))

    return make


@pytest.fixture(scope="session")
def make_recording(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Robot, Signals], bytes]:
    """MCAP bytes of signals, as the recorder writes what the drives of that robot would have sent."""

    def make(robot: Robot, signals: Signals) -> bytes:
        path = tmp_path_factory.mktemp("recording") / "run.mcap"
        rig, _ = load_rig("tx40-rig")
        start = run_start(rig, robot, {}, 0, None)
        store = Store(path, start, [bus.name for bus in rig.bus], 256 * 1024)
        store.attach(topics.ROBOT_FILE, topics.TOML_TYPE, config.to_toml(robot))
        store.attach(topics.RIG_FILE, topics.TOML_TYPE, config.to_toml(rig.for_recording()))
        rated = np.array([j.drive.rated_current_A for j in robot.joint])
        counts = np.rint(robot.motor_counts(signals.q)).astype(int)
        permille = np.rint(1000 * robot.drive_current(signals.tau_Nm) / rated).astype(int)
        present = (False,) * robot.joints
        cycles = [
            Cycle(k, k * 1_000_000, tuple(p), tuple(c), (k % 65536,) * robot.joints, present)
            for k, (p, c) in enumerate(zip(counts.tolist(), permille.tolist(), strict=True))
        ]
        arrival, grid, raw, states = CycleRows(robot, 1_000_000)(cycles)
        store.write(topics.CYCLE, arrival, grid, raw)
        store.write(topics.JOINTS, arrival, grid, states)
        store.finish({"verdict": "LOSSLESS", "because": ""})
        return path.read_bytes()

    return make
