"""IRLS, TLS, ML, EKF and set membership against closed forms, scipy and corners; and where each must fail."""

import itertools
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from ident.base import Base, base_parameters
from ident.dataset import Signals, prepare
from ident.ekf import ExtendedKalman, predict
from ident.estimate import LeastSquares
from ident.irls import TUNING, IterativelyReweighted
from ident.ml import MaximumLikelihood
from ident.model import Model
from ident.observation import Observation, observe
from ident.positionnoise import position_noise, state_covariance
from ident.problem import Problem
from ident.setmembership import SetMembership
from ident.tls import TotalLeastSquares, equal_errors, solve
from protocols.errors import ConfigError, IdentificationError
from protocols.robot import Robot, load

Make = Callable[..., Signals]
TRUTH = np.array([1.0, -2.0, 0.5])


def laboratory(seed: int, rows: int = 400, noise: float = 1.0, column_noise: float = 0.0) -> Problem:
    """One joint and three random columns; nothing but rows."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(1, rows, 3))
    y = W @ TRUTH + noise * rng.uniform(-1, 1, size=(1, rows))
    W = W + column_noise * rng.normal(size=W.shape)
    t = 0.02 * np.arange(rows)
    names = ["p1", "p2", "p3"]
    o = Observation("lab", ["a"], t, t == 0, W, y, np.ones((1, rows), bool), 50.0, 20.0, [])
    base = Base(np.arange(3), np.eye(3), names, ["1"] * 3, names)
    return Problem(None, base, [], [], [o], 50.0, None)  # type: ignore[arg-type]


def emps(q_noise: float, tau_noise: float, filter_Hz: float = np.inf, to_Hz: float = np.inf, seed: int = 1) -> Problem:
    """One sliding axis: torque linear in speed and acceleration, but for the sign."""
    robot = load("emps")
    rng = np.random.default_rng(seed)
    t = np.arange(8000) * 0.001
    w = 2 * np.pi * np.array([0.4, 0.7, 1.1])[:, None]
    q = (0.05 * np.sin(w * t)).sum(0)
    qd, qdd = (0.05 * w * np.cos(w * t)).sum(0), (-0.05 * w**2 * np.sin(w * t)).sum(0)
    model = Model.of(robot)
    base = base_parameters(model)
    states = (x[:, None] for x in (q, qd, qdd))
    tau = (model.regressor(*states)[:, :, base.kept] @ np.array([95.0, 200.0, 20.0, -3.0])).T
    signals = Signals(
        "emps", robot.joint_names, t, (q + q_noise * rng.normal(size=t.size))[:, None],
        tau + tau_noise * rng.normal(size=tau.shape), np.zeros(1),
    )  # fmt: skip
    dataset = prepare(signals, filter_Hz)
    return Problem(model, base, [signals], [dataset], [observe(dataset, model, base, to_Hz, None)], to_Hz, None)


def odr(x: np.ndarray, y: np.ndarray, sx: np.ndarray, sy: np.ndarray, start: np.ndarray) -> np.ndarray:
    """ODRPACK: parameters of y = x' beta with errors in every x and in y; sx of 0 for exact columns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from scipy import odr as odrpack
    fixed = np.broadcast_to((sx > 0).astype(int)[:, None], x.T.shape)
    data = odrpack.RealData(x.T, y, sx=np.broadcast_to(np.where(sx > 0, sx, 1.0)[:, None], x.T.shape), sy=sy)
    model = odrpack.Model(lambda beta, u: beta @ u)
    run = odrpack.ODR(data, model, beta0=start, ifixx=fixed, maxit=500, sstol=1e-14, partol=1e-12)
    return np.asarray(run.run().beta)


def test_huber_has_the_minimum_that_scipy_finds() -> None:
    problem = laboratory(1)
    fitted = IterativelyReweighted().fit(problem)
    (o,) = problem.observations
    s = fitted.sigma_Nm[0]
    scipy_fit = optimize.least_squares(
        lambda beta: (o.y[0] - o.W[0] @ beta) / s, np.zeros(3), loss="huber", f_scale=TUNING["huber"], xtol=1e-14,
        ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(fitted.beta, scipy_fit.x, rtol=1e-4)


@pytest.mark.parametrize("loss", ["huber", "bisquare"])
def test_gross_errors_ruin_wls_and_not_irls(loss: str) -> None:
    problem = laboratory(2, noise=0.1)
    (o,) = problem.observations
    y = o.y.copy()
    y[0, ::20] += 30.0 * np.sign(o.W[0, ::20, 0])
    spoiled = replace(problem, observations=[replace(o, y=y)])
    robust = IterativelyReweighted(loss=loss).fit(spoiled)  # type: ignore[arg-type]
    assert np.abs(robust.beta - TRUTH).max() < (0.03 if loss == "huber" else 0.015)
    assert np.abs(LeastSquares(weighted=True).fit(spoiled).beta - TRUTH).max() > 0.3
    assert any("Rows whose weight fell below one half: a 5." in note for note in robust.notes)


def test_irls_costs_little_where_nothing_is_wrong() -> None:
    """95 % efficiency under normal errors."""
    squares = []
    for seed in range(150):
        problem = laboratory(100 + seed, rows=100)
        (o,) = problem.observations
        rng = np.random.default_rng(seed)
        normal = replace(problem, observations=[replace(o, y=o.W @ TRUTH + rng.normal(size=o.y.shape))])
        squares.append(
            [np.sum((m.fit(normal).beta - TRUTH) ** 2) for m in (LeastSquares(True), IterativelyReweighted())]
        )
    ols, irls = np.mean(squares, axis=0)
    assert 0.85 < ols / irls <= 1.0


def test_many_bad_rows_are_called_a_missing_effect() -> None:
    problem = laboratory(3, noise=0.05)
    (o,) = problem.observations
    y = o.y.copy()
    y[0, ::3] += 5.0
    notes = IterativelyReweighted().fit(replace(problem, observations=[replace(o, y=y)])).notes
    assert any("that is not a few bad rows but something the model lacks" in note for note in notes)


def test_tls_is_what_odrpack_finds() -> None:
    problem = laboratory(4, noise=0.3, column_noise=0.2)
    (o,) = problem.observations
    R = np.linalg.qr(np.column_stack([o.W[0], o.y[0]]), mode="r")
    beta, smallest = solve(R, np.eye(3))
    np.testing.assert_allclose(beta, odr(o.W[0], o.y[0], np.ones(3), np.ones(400), TRUTH), rtol=1e-6)
    v = np.linalg.svd(np.column_stack([o.W[0], o.y[0]]))
    np.testing.assert_allclose(beta, -v[2][-1, :3] / v[2][-1, 3], rtol=1e-9)
    assert smallest == pytest.approx(v[1][-1])
    exact_third, _ = solve(R, np.diag([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(
        exact_third, odr(o.W[0], o.y[0], np.array([1.0, 1.0, 0.0]), np.ones(400), TRUTH), rtol=1e-5
    )


def test_tls_with_the_errors_it_assumes_has_no_bias_and_ls_has() -> None:
    found = []
    for seed in range(60):
        problem = laboratory(seed, rows=600, noise=0.0, column_noise=0.2)
        (o,) = problem.observations
        y = o.y + 0.2 * np.random.default_rng(seed).normal(size=o.y.shape)
        R = np.linalg.qr(np.column_stack([o.W[0], y[0]]), mode="r")
        found.append([solve(R, np.eye(3))[0], np.linalg.solve(R[:3, :3], R[:3, 3])])
    tls, ls = (np.array(f) for f in zip(*found, strict=True))
    error = np.abs(tls.mean(0) - TRUTH) / (tls.std(0) / np.sqrt(60))
    assert error.max() < 3
    assert (np.abs(ls.mean(0) - TRUTH) / (ls.std(0) / np.sqrt(60))).max() > 10


def test_tls_refuses_when_columns_are_all_error() -> None:
    problem = laboratory(5, noise=3.0)
    (o,) = problem.observations
    W = o.W.copy()
    W[:, :, 2] *= 1e-2
    with pytest.raises(IdentificationError, match="IDIM-TLS has no stable solution: the smallest singular value is"):
        TotalLeastSquares(errors="equal").fit(replace(problem, observations=[replace(o, W=W)]))


def test_textbook_tls_keeps_offsets_exact() -> None:
    names = ["Fv1", "offset1"]
    np.testing.assert_array_equal(equal_errors(Base(np.arange(2), np.eye(2), names, ["1"] * 2, names)), np.diag([1, 0]))


def test_ml_is_what_odrpack_finds() -> None:
    """One sliding axis without decimation: the row's (dq, ddq) are x, their error covariance is that of the filter."""
    problem = emps(q_noise=2e-6, tau_noise=5.0, filter_Hz=60.0)
    fitted = MaximumLikelihood(position_noise_rad=2e-6).fit(problem)
    (o,), (dataset,) = problem.observations, problem.datasets
    C = (2e-6) ** 2 * state_covariance(dataset, o)
    assert abs(C[1, 2]) < 1e-6 * np.sqrt(C[1, 1] * C[2, 2])  # so ODRPACK may treat them one by one
    sx = np.array([np.sqrt(C[2, 2]), np.sqrt(C[1, 1]), 0.0, 0.0])
    x = o.W[0][o.used[0]]
    theirs = odr(x, o.y[0][o.used[0]], sx, np.full(len(x), fitted.sigma_Nm[0]), fitted.beta)
    np.testing.assert_allclose(fitted.beta, theirs, rtol=2e-5)
    V = (x * 0 + sx**2) @ fitted.beta**2 + fitted.sigma_Nm[0] ** 2
    np.testing.assert_allclose(np.diag(fitted.white), np.diag(np.linalg.inv((x / V[:, None]).T @ x)), rtol=0.02)


def test_without_filter_ml_is_near_the_truth_and_wls_far() -> None:
    problem = emps(q_noise=5e-7, tau_noise=2.0)
    truth = np.array([95.0, 200.0, 20.0, -3.0])
    wls, ml = LeastSquares(weighted=True).fit(problem), MaximumLikelihood().fit(problem)
    assert abs(wls.beta - truth)[0] > 10 * abs(ml.beta - truth)[0]
    assert abs(ml.beta - truth)[0] < 1.0
    assert any("Position noise taken: 0.5 urad" in note for note in ml.notes)


def test_position_noise_is_found_under_a_motion() -> None:
    t = np.arange(20_000) * 0.001
    q = np.sin(2 * np.pi * 5 * t) + 3e-6 * np.random.default_rng(1).normal(size=t.size)
    assert position_noise(q[:, None]) == pytest.approx(3e-6, rel=0.05)


def test_filtered_noise_has_the_covariance_it_should() -> None:
    problem = emps(q_noise=0.0, tau_noise=0.0, filter_Hz=50.0, to_Hz=50.0)
    (o,), (dataset,), (signals,) = problem.observations, problem.datasets, problem.signals
    rng = np.random.default_rng(4)
    small = 1e-4  # metres, so that the axis stays within its range; everything here is linear
    noise = prepare(replace(signals, q=small * rng.normal(size=signals.q.shape)), 50.0)
    rows = observe(noise, problem.model, problem.base, 50.0, 0.0)
    C = state_covariance(dataset, o)
    columns = [problem.base.names.index(n) for n in ("Fv1",)]  # the column of Fv is the decimated speed itself
    assert np.var(rows.W[0][:, columns[0]] / small) == pytest.approx(C[1, 1], rel=0.25)


def test_ekf_steps_have_the_slopes_they_say() -> None:
    problem = emps(q_noise=1e-6, tau_noise=1.0)
    x = np.array([0.1, 0.3, 95.0, 200.0, 20.0, -3.0])
    _, F, M_inverse = predict(problem, x, np.array([30.0]), 0.001)
    assert M_inverse[0, 0] == pytest.approx(1 / 95.0)
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-4 * max(1.0, abs(x[i]))
        high, low = (predict(problem, x + s * step, np.array([30.0]), 0.001)[0] for s in (1, -1))
        np.testing.assert_allclose(F[:, i], (high - low) / (2 * step[i]), rtol=5e-3, atol=1e-9)


def test_ekf_comes_near_what_least_squares_finds() -> None:
    problem = emps(q_noise=1e-6, tau_noise=2.0, filter_Hz=100.0, to_Hz=50.0)
    nominal = problem.base.B @ problem.model.theta(problem.model.robot)
    far = replace(problem, model=Model.of(_changed(problem.model.robot, 0.7)))
    found = ExtendedKalman(prior_factor=5.0).fit(far).beta
    truth = np.array([95.0, 200.0, 20.0, -3.0])
    assert np.linalg.norm(found - truth) < 0.02 * np.linalg.norm(truth)
    assert np.linalg.norm(0.7 * nominal - truth) > 0.2 * np.linalg.norm(truth)
    with pytest.raises(IdentificationError, match="inertia matrix of its parameters is no longer positive. Start from"):
        ExtendedKalman(prior_factor=50.0).fit(far)


def _changed(robot: Robot, factor: float) -> Robot:
    import msgspec

    def scaled(j: object) -> object:
        p = j.parameters  # type: ignore[attr-defined]
        return msgspec.structs.replace(
            j,
            parameters=msgspec.structs.replace(
                p,
                mass_kg=factor * p.mass_kg,
                rotor_inertia_kgm2=factor * p.rotor_inertia_kgm2,
                viscous_Nms_rad=factor * p.viscous_Nms_rad,
                coulomb_Nm=factor * p.coulomb_Nm,
            ),
        )

    return msgspec.structs.replace(robot, joint=[scaled(j) for j in robot.joint])


def test_ekf_says_when_it_lost_the_motion() -> None:
    problem = emps(q_noise=1e-6, tau_noise=2.0, filter_Hz=100.0, to_Hz=50.0)
    (signals,) = problem.signals
    q = signals.q.copy()
    q[4000:] += 0.05
    with pytest.raises(
        IdentificationError, match=r"emps: the EKF lost the motion at 4.00 s .*Start from better a-priori"
    ):
        ExtendedKalman().fit(replace(problem, signals=[replace(signals, q=q)]))


def test_set_membership_is_the_polytope_s_box() -> None:
    """Corners of the polytope of two parameters, all of them."""
    problem = laboratory(7, rows=25, noise=0.5)
    (o,) = problem.observations
    small = replace(problem, base=Base(np.arange(2), np.eye(2), ["p1", "p2"], ["1"] * 2, ["p1", "p2"]),
                    observations=[replace(o, W=o.W[:, :, :2], y=o.y - 0.5 * o.W[:, :, 2])])  # fmt: skip
    W, y = o.W[0, :, :2], small.observations[0].y[0]
    planes = np.vstack([np.column_stack([s * W, s * y + 0.6]) for s in (1.0, -1.0)])
    corners = [
        np.linalg.solve(p[:, :2], p[:, 2])
        for p in map(np.array, itertools.combinations(planes, 2))
        if abs(np.linalg.det(p[:, :2])) > 1e-12
    ]
    inside = np.array([c for c in corners if (planes[:, :2] @ c <= planes[:, 2] + 1e-9).all()])
    fitted = SetMembership(bound_Nm=(0.6,)).fit(small)
    half = np.sqrt(3) * fitted.std
    np.testing.assert_allclose(fitted.beta - half, inside.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(fitted.beta + half, inside.max(axis=0), atol=1e-6)


def test_true_bounds_always_hold_the_truth_and_small_ones_leave_nothing() -> None:
    for seed in range(20):
        fitted = SetMembership(bound_Nm=(1.0,)).fit(laboratory(200 + seed, rows=300))
        assert (np.abs(fitted.beta - TRUTH) <= np.sqrt(3) * fitted.std + 1e-9).all()
    with pytest.raises(IdentificationError, match=r"they would have to be 2\.\d+ times as large"):
        SetMembership(bound_Nm=(0.4,)).fit(laboratory(200, rows=300))
    with pytest.raises(ConfigError, match="Set membership needs 1 positive error bounds"):
        SetMembership(bound_Nm=(0.4, 1.0)).fit(laboratory(200))
    assert "from the data: intervals without guarantee" in SetMembership().fit(laboratory(1)).notes[-1]
