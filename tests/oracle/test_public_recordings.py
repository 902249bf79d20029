"""Real machines: the public TX40 and EMPS recordings, read in place (see their README for the sources)."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from ident.base import base_parameters
from ident.dataset import Signals, prepare
from ident.estimate import Estimate, estimate
from ident.model import Model
from ident.observation import Observation, observe, relative_error
from protocols.robot import Robot, load

# Janot, Vandanjon & Gautier 2014, Table 2, with its relative deviations: the same robot type, another specimen or day.
TABLE_2 = {
    "ZZ1R": 1.25, "Fv1": 8.18, "Fc1": 6.57, "XX2R": -0.48, "XZ2R": -0.16, "ZZ2R": 1.08, "MX2R": 2.20, "Fv2": 5.67,
    "Fc2": 7.76, "XX3R": 0.13, "ZZ3R": 0.12, "MY3R": -0.60, "Ia3": 0.09, "Fv3": 2.02, "Fc3": 6.10, "MX4": -0.02,
    "Ia4": 0.03, "Fv4": 1.14, "Fc4": 2.30, "MY5R": -0.03, "Ia5": 0.04, "Fv5": 1.88, "Fc5": 2.90, "Ia6": 0.01,
    "Fv6": 0.68, "Fc6": 2.10, "fv_m6": 0.63, "fc_m6": 1.80,
}  # fmt: skip
PERIOD_S = 0.0002


@pytest.fixture(scope="module")
def recording(shared: Path) -> Signals:
    folder = shared / "data" / "tx40"
    if not folder.is_dir():
        pytest.skip("the TX40 recording is not here")
    motor, torque = (
        np.loadtxt(folder / f"tx40_motor_{what}_5kHz.csv", delimiter=",", skiprows=1) for what in ("pos", "torque")
    )
    R = np.diag([32.0, 32, 45, -48, 45, 32])
    R[5, 4] = 32
    q = motor @ np.linalg.inv(R).T + np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    t = np.arange(len(q)) * PERIOD_S
    return Signals("tx40", [f"joint{j}" for j in range(1, 7)], t, q, torque @ R, np.zeros(6))


@pytest.fixture(scope="module")
def model() -> Model:
    tx40 = load("tx40")
    joints = [msgspec.structs.replace(j, theta0_rad=0.0) for j in tx40.joint]  # the file's angles contain it
    return Model.of(msgspec.structs.replace(tx40, joint=joints), free_coupling_inertia=True)


def cut(signals: Signals, start: float, end: float) -> Signals:
    rows = (signals.t_s >= start) & (signals.t_s <= end)
    return Signals(
        signals.source, signals.joints, signals.t_s[rows], signals.q[rows], signals.tau_Nm[rows], signals.delay_s
    )


def fit(signals: Signals, model: Model, threshold: float | None) -> tuple[Estimate, Observation]:
    base = base_parameters(model)
    o = observe(prepare(signals, 100.0), model, base, 50.0, threshold)
    return estimate([o], base), o


def test_all_rows_fit_as_well_as_the_best_known(recording: Signals, model: Model) -> None:
    """Best known: 5.56 % with all rows from 0.1 to 7.5 s."""
    fitted, _ = fit(cut(recording, 0.1, 7.5), model, 0.0)
    assert fitted.relative_error_percent < 5.56
    assert (fitted.per_joint_percent < [4.9, 5.0, 8.3, 8.3, 11.2, 9.8]).all()


def test_rows_around_zero_speed_cost_most_of_the_error(recording: Signals, model: Model) -> None:
    """Best known: 5.10 %, condition 1031, column-scaled 22.6."""
    fitted, _ = fit(recording, model, None)
    assert fitted.relative_error_percent < 5.10
    assert fitted.condition_scaled < 30


def test_estimates_agree_with_the_published_table(recording: Signals, model: Model) -> None:
    fitted, _ = fit(cut(recording, 0.1, 7.5), model, 0.0)
    value = dict(zip(fitted.base.names, fitted.beta, strict=True))
    std = dict(zip(fitted.base.names, fitted.std, strict=True))
    for name, published in TABLE_2.items():
        assert abs(value[name] - published) < 3 * std[name] + 0.006, name  # the table is rounded to 0.01


def test_unseen_motion_is_predicted_as_well_as_the_best_known(recording: Signals, model: Model) -> None:
    """Best known: 7.20 % without rows around zero speed, 7.79 % with them; train on the first 60 %."""
    base = base_parameters(model)
    middle = 0.1 + 0.6 * 7.4
    for threshold, best in ((None, 7.20), (0.0, 7.79)):
        train, test = (
            observe(prepare(part, 100.0), model, base, 50.0, threshold)
            for part in (cut(recording, 0.1, middle), cut(recording, middle, 7.5))
        )
        error, _ = relative_error([test], estimate([train], base).beta)
        assert error < 1.05 * best


def test_emps_gives_its_authors_values(shared: Path) -> None:
    """Janot, Gautier & Brunot 2019: M 95.11 kg, Fv 203.50, Fc 20.39, offset -3.16; errors 4.08 and 5.98 %."""
    robot: Robot = load("emps")
    model = Model.of(robot)
    base = base_parameters(model)
    found = []
    for name in ("train", "pulses"):
        path = shared / "data" / "emps" / f"emps_{name}.csv"
        if not path.is_file():
            pytest.skip(f"{path.name} is not here")
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        t = np.arange(len(table)) * 0.001
        signals = Signals(name, robot.joint_names, t, table[:, [1]], 35.1507 * table[:, [2]], np.zeros(1))
        found.append(observe(prepare(signals, 100.0), model, base, 40.0, 0.0))
    fitted = estimate(found[:1], base)
    assert fitted.beta == pytest.approx([95.11, 203.50, 20.39, -3.16], rel=0.03)
    assert fitted.relative_error_percent < 4.08
    assert relative_error(found[1:], fitted.beta)[0] < 5.98
