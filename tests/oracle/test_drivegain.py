"""Drive gains of the emulated arm, whose currents say one thing and whose payload another; closed forms on top."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy import optimize

from ident import auxiliary, drivegain
from ident.dataset import Command, Dataset, Signals, prepare
from ident.drivegain import Method, drive_gains
from ident.model import Model
from protocols.errors import IdentificationError
from protocols.robot import Robot, load

PERIOD_S, DURATION_S = 0.001, 10.0
NOISE_NM = np.array([0.6, 0.6, 0.3, 0.1, 0.1, 0.06])
FACTOR = np.array([1.1, 0.9, 1.05, 0.95, 1.2, 0.85])  # actual over nominal gain
MASS_KG, CENTRE_M = 3.0, np.array([0.05, 0.02, 0.12])


def payload() -> np.ndarray:
    """A block whose mass and place are known, in the frame of the last link."""
    spin = MASS_KG * (CENTRE_M @ CENTRE_M * np.eye(3) - np.outer(CENTRE_M, CENTRE_M)) + 0.004 * np.eye(3)
    return np.array([MASS_KG, *(MASS_KG * CENTRE_M), *spin[np.triu_indices(3)]])


def stiff(robot: Robot) -> Robot:
    """Current loops that never give way: what was commanded is what was measured."""
    joints = [
        msgspec.structs.replace(j, drive=msgspec.structs.replace(j.drive, current_bandwidth_Hz=1e9))
        for j in robot.joint
    ]
    return msgspec.structs.replace(robot, joint=joints)


def run(model: Model, seed: int, load_theta: np.ndarray) -> Dataset:
    """Closed loop of the simulated arm; its currents times nominal gains."""
    rng = np.random.default_rng(seed)
    J = model.joints
    t = np.arange(round(DURATION_S / PERIOD_S)) * PERIOD_S
    frequency, phase = rng.uniform(0.2, 1.0, (5, J)), rng.uniform(0, 2 * np.pi, (5, J))
    rise = np.clip(t / 0.5, 0, 1)[:, None]
    wave = (0.25 * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=1)
    reference = rise**3 * (10 - 15 * rise + 6 * rise**2) * wave
    blank = Signals(
        f"run {seed}", model.robot.joint_names, t, np.zeros((t.size, J)), np.zeros((t.size, J)),
        np.full(J, PERIOD_S / 2), command=lambda: Command(reference),
    )  # fmt: skip
    theta = model.theta(model.robot)
    theta[10 * (J - 1) : 10 * J] += load_theta
    recorded = auxiliary.runs([blank])[0]
    (simulations,) = auxiliary.simulate([recorded], model, theta, update_gains=False)
    clean = auxiliary.as_signals(recorded, simulations)
    C = model.coupling
    motor = np.linalg.solve(C.T, clean.tau_Nm.T) / FACTOR[:, None] + NOISE_NM[:, None] * rng.normal(size=(J, t.size))
    return prepare(replace(clean, q=clean.q + 1e-6 * rng.normal(size=clean.q.shape), tau_Nm=(C.T @ motor).T))


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.of(stiff(load("tx40")))


@pytest.fixture(scope="module")
def runs(model: Model) -> tuple[Dataset, Dataset]:
    return run(model, 1, np.zeros(10)), run(model, 2, payload())


@pytest.mark.parametrize("method", ["ls", "tls", "constrained"])
def test_gains_come_back(method: Method, model: Model, runs: tuple[Dataset, Dataset]) -> None:
    found = drive_gains([runs[0]], [runs[1]], model, payload(), method)
    ratio = found.gain_Nm_A / found.nominal_Nm_A
    np.testing.assert_allclose(ratio, FACTOR, rtol=0.03)
    assert (found.low_Nm_A > 0).all()
    assert ((found.low_Nm_A < found.gain_Nm_A) & (found.gain_Nm_A < found.high_Nm_A)).all()
    assert "joint1" in str(found) and "N·m/A" in str(found)


def test_intervals_of_tls_hold_the_truth(model: Model, runs: tuple[Dataset, Dataset]) -> None:
    found = drive_gains([runs[0]], [runs[1]], model, payload(), "tls")
    z = (found.gain_Nm_A / found.nominal_Nm_A - FACTOR) / (found.std_Nm_A / found.nominal_Nm_A)
    assert np.abs(z).max() < 3.5
    assert np.sqrt(np.mean(z**2)) < 2.0


def test_least_squares_is_pulled_to_small_gains_and_tls_is_not(model: Model, runs: tuple[Dataset, Dataset]) -> None:
    """The negative control: eight times the noise on the currents."""
    rng = np.random.default_rng(5)
    noisy = [
        replace(
            d, segments=[replace(s, tau_Nm=s.tau_Nm + 8 * NOISE_NM * rng.normal(size=s.q.shape)) for s in d.segments]
        )
        for d in runs
    ]
    error = {}
    for method in ("ls", "tls"):
        found = drive_gains([noisy[0]], [noisy[1]], model, payload(), method)
        error[method] = found.gain_Nm_A / found.nominal_Nm_A / FACTOR - 1
    assert (error["ls"] < 0).all()
    assert np.abs(error["tls"]).mean() < np.abs(error["ls"]).mean() / 2


def test_without_noise_the_least_squares_solution_is_the_stacked_one() -> None:
    rng = np.random.default_rng(0)
    R = [np.triu(rng.normal(size=(7, 7))) for _ in range(2)]
    g, beta = drivegain._solve(R, np.eye(2), "ls")
    whole = np.vstack(R)
    expected = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([g, beta]), expected, rtol=1e-9)


def test_total_is_the_minimum_that_a_simplex_finds() -> None:
    rng = np.random.default_rng(1)
    x = np.array([1.2, 0.8, 2.0])
    R = []
    for j in range(2):
        A = rng.normal(size=(60, 3))
        k = A @ x
        A[:, j] += 0.1 * rng.normal(size=60)
        R.append(np.linalg.qr(np.column_stack([A, k]), mode="r"))
    spread = np.eye(2)
    g, beta = drivegain._solve(R, spread, "tls")

    def cost(v: np.ndarray) -> float:
        return float(sum(np.sum((t[:, :-1] @ v - t[:, -1]) ** 2) / v[j] ** 2 for j, t in enumerate(R)))

    theirs = optimize.minimize(cost, x, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 5000})
    np.testing.assert_allclose([*g, *beta], theirs.x, rtol=1e-5)


def test_constrained_gains_are_positive_where_ls_is_not() -> None:
    A = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    R = [np.column_stack([A, [-1.0, 2.0, 0.0]]), np.zeros((3, 3))]
    assert drivegain._solve(R, np.eye(2), "ls")[0][0] < 0
    assert (drivegain._solve(R, np.eye(2), "constrained")[0] > 0).all()


def test_what_cannot_be_done_is_said(model: Model, runs: tuple[Dataset, Dataset]) -> None:
    with pytest.raises(IdentificationError, match="1 runs without and 0 with payload; drive gains need at least one"):
        drive_gains([runs[0]], [], model, payload())
    with pytest.raises(IdentificationError, match="% of the motors'; that gives the gains no scale. Use a heavier"):
        drive_gains([runs[0]], [runs[1]], model, 1e-5 * payload())
    with pytest.raises(IdentificationError, match=r"would be -\d.* times its nominal value. Check the payload's"):
        drive_gains([runs[0]], [runs[1]], model, -payload())
