"""Covariances against sums by hand, closed forms and their own coverage; each fails where its assumption does."""

import numpy as np
import pytest
from scipy import signal

from ident.base import Base
from ident.covariance import HAC, Covariance, Moments, Period, White, find_period, long_run, named
from ident.estimate import Estimate, estimate
from ident.montecarlo import MonteCarlo
from ident.observation import Observation
from protocols.errors import ConfigError, IdentificationError

TRUTH = np.array([1.0, -2.0, 0.5])
SIGMA = np.array([1.0, 3.0])
ROWS, PERIOD = 600, 150


def laboratory(seed: int, rho: float, periodic: bool = False, gap: bool = False) -> tuple[Observation, Base]:
    """Two joints with a constant, a slow and a fast column; AR(1) errors, correlated between joints."""
    rng = np.random.default_rng(99)
    fast = rng.normal(size=(2, PERIOD if periodic else ROWS))
    columns = np.empty((2, ROWS, 3))
    columns[:, :, 0] = 1.0
    columns[:, :, 1] = np.sin(2 * np.pi * np.arange(ROWS) / PERIOD)
    columns[:, :, 2] = np.tile(fast, (1, ROWS // fast.shape[1]))
    rng = np.random.default_rng(seed)
    white = np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]]) @ rng.normal(size=(2, ROWS + 100))
    error = signal.lfilter([np.sqrt(1 - rho**2)], [1, -rho], white)[:, 100:] * SIGMA[:, None]
    t_s = 0.02 * np.arange(ROWS)
    first = t_s == 0
    if gap:
        first[ROWS // 2] = True
    names = ["p1", "p2", "p3"]
    o = Observation(
        "lab", ["a", "b"], t_s, first, columns, columns @ TRUTH + error, np.ones((2, ROWS), bool), 50.0, 20.0, []
    )
    return o, Base(np.arange(3), np.eye(3), names, ["1"] * 3, names)


def coverage(covariance: Covariance, rho: float, periodic: bool = False, runs: int = 200) -> float:
    """Share of 95 % intervals that hold the truth, fits 10000 and up: not the ones looked at while writing."""
    fits = [
        estimate([o], base, "wls", covariance)
        for o, base in (laboratory(10_000 + s, rho, periodic) for s in range(runs))
    ]
    return float(np.mean([np.abs(f.beta - TRUTH) < 1.96 * f.std for f in fits]))


@pytest.mark.parametrize(
    ("covariance", "rho", "low", "high"),
    [
        (White(), 0.0, 0.88, 0.97),  # it leaves out that the joints correlate
        (HAC, 0.0, 0.92, 0.98),
        (HAC, 0.6, 0.92, 0.98),
        (MonteCarlo(100), 0.6, 0.92, 0.98),
        (White(), 0.6, 0.3, 0.85),  # must fail
    ],
)
def test_intervals_cover_as_they_claim(covariance: Covariance, rho: float, low: float, high: float) -> None:
    assert low <= coverage(covariance, rho) <= high


def test_period_intervals_cover_and_ignore_what_repeats() -> None:
    assert 0.91 <= coverage(Period(), 0.6, periodic=True) <= 0.98
    o, base = laboratory(1, 0.6, periodic=True)
    spoiled = Observation(
        **{**vars(o), "y": o.y + 20 * np.sin(6 * np.pi * np.arange(ROWS) / PERIOD) * o.W[:, :, 2]}
    )  # an effect that the model lacks, the same in every period
    np.testing.assert_allclose(
        estimate([spoiled], base, "ols", Period(3.0)).std, estimate([o], base, "ols", Period(3.0)).std, rtol=0.05
    )
    assert (estimate([spoiled], base, "ols").std > 2 * estimate([o], base, "ols").std)[2]


def test_hac_is_newey_west_with_prewhitening_summed_by_hand() -> None:
    o, base = laboratory(3, 0.5, gap=True)
    fitted = estimate([o], base)
    W = np.vstack([o.W[j] / fitted.sigma_Nm[j] for j in (0, 1)])
    A = np.linalg.inv(W.T @ W)
    rho = (o.y - o.predict(fitted.beta)) / fitted.sigma_Nm[:, None] ** 2
    scores = np.array([rho[:, t] @ o.W[:, t] for t in range(ROWS)])
    half = ROWS // 2
    same = np.arange(1, ROWS) != half
    a = (scores[1:] * scores[:-1])[same].sum(axis=0) / (scores**2).sum(axis=0)
    white = scores.copy()
    for t in range(1, ROWS):
        if t != half:
            white[t] -= a * scores[t - 1]
    lags = int(fitted.covariance_name.split("prewhitened, ")[1].split(" ")[0])
    S = np.zeros((3, 3))
    for t in range(ROWS):
        for s in range(ROWS):
            if abs(t - s) <= lags and (t < half) == (s < half):
                S += (1 - abs(t - s) / (lags + 1)) * np.outer(white[t], white[s])
    S = np.diag(1 / (1 - a)) @ S @ np.diag(1 / (1 - a))
    np.testing.assert_allclose(fitted.covariance, A @ S @ A * 2 * ROWS / (2 * ROWS - 3), rtol=1e-9)


def test_long_run_variance_of_an_autoregression() -> None:
    """Closed form: an AR(1) of unit innovations has the long-run variance 1 / (1 - rho)^2."""
    series = signal.lfilter([1.0], [1, -0.7], np.random.default_rng(8).normal(size=(40_000, 1)), axis=0)
    S, _ = long_run([series])
    assert S[0, 0] / 40_000 == pytest.approx(1 / 0.3**2, rel=0.05)


def test_monte_carlo_agrees_with_hac_and_repeats() -> None:
    o, base = laboratory(4, 0.5)
    drawn = estimate([o], base, "wls", MonteCarlo(2000))
    np.testing.assert_allclose(drawn.std, estimate([o], base, "wls", HAC).std, rtol=0.2)
    np.testing.assert_array_equal(drawn.covariance, estimate([o], base, "wls", MonteCarlo(2000)).covariance)
    assert drawn.covariance_name.startswith("Monte-Carlo (2000 error series")


def test_the_period_is_found_or_refused() -> None:
    o, base = laboratory(5, 0.5, periodic=True)
    assert find_period(o, TRUTH) == PERIOD
    assert estimate([o], base, "wls", Period()).covariance_name.startswith("period-based (4 periods of 3.00 s")
    aperiodic, _ = laboratory(5, 0.5)
    with pytest.raises(IdentificationError, match=r"lab: the torques do not repeat \(at best to \d+ %, limit 10 %\)"):
        find_period(aperiodic, np.array([0.0, 0.0, 1.0]))
    with pytest.raises(ConfigError, match="A period of 3.01 s is 150.50 rows at 50 Hz; decimate to a rate that"):
        estimate([o], base, "wls", Period(3.01))
    with pytest.raises(IdentificationError, match="fewer than 3 whole periods of 5.00 s. Record more periods"):
        estimate([o], base, "wls", Period(5.0))
    with pytest.raises(IdentificationError, match="in 2 gapless stretches"):
        estimate([laboratory(5, 0.5, True, gap=True)[0]], base, "wls", Period(3.0))


@pytest.mark.parametrize("name", ["white", "hac", "period", "period:2.5", "montecarlo", "montecarlo:50"])
def test_names_name_covariances(name: str) -> None:
    assert isinstance(named(name), (White, type(HAC), Period, MonteCarlo))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("grey", "Covariance grey is unknown; choose from white, hac, period, montecarlo, period:SECONDS"),
        ("period:x", "Covariance period:x: 'x' is not a number."),
        ("white:3", "Covariance white:3 is unknown"),
    ],
)
def test_unknown_names_are_refused(name: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        named(name)
    assert sentence in str(error.value)


def test_the_estimate_says_which_and_what_it_assumes() -> None:
    def note(fit: Estimate) -> str:
        return fit.notes[-1]

    o, base = laboratory(6, 0.5)
    white = estimate([o], base, "wls", White())
    assert white.covariance_name.startswith("white (eq. (8)")
    assert note(white).endswith("The standard deviations assume that there is none.")
    assert note(estimate([o], base)).endswith("The standard deviations allow for it, eq. (8) does not.")
    assert Moments.weighted([o], white.beta, white.sigma_Nm, white.white).inflation == pytest.approx(1200 / 1197)
