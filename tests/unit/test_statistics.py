"""Tests after a fit: they accept what is true, reject what is not, and say when they do not apply."""

import numpy as np
import pytest

from ident import statistics as tests
from ident.contract import Statistic

RNG = np.random.default_rng(11)
NORMAL = RNG.normal(size=4000)


def runs(values: np.ndarray) -> list[np.ndarray]:
    return np.split(values, 20)


def autoregressive(rho: float) -> np.ndarray:
    x = RNG.normal(size=4000)
    for t in range(1, x.size):
        x[t] += rho * x[t - 1]
    return x


@pytest.mark.parametrize(
    ("statistic", "verdict"),
    [
        (tests._kolmogorov(NORMAL), "accepted"),
        (tests._kolmogorov(NORMAL + 0.1), "rejected"),
        (tests._kolmogorov(1.2 * NORMAL), "rejected"),
        (tests._lilliefors(3 * NORMAL + 1), "accepted"),
        (tests._lilliefors(RNG.standard_t(3, size=4000)), "rejected"),
        (tests._regression(runs(NORMAL)), "accepted"),
        (tests._regression(runs(autoregressive(0.5))), "rejected"),
        (tests._ljung_box(runs(NORMAL)), "accepted"),
        (tests._ljung_box(runs(autoregressive(0.15))), "rejected"),
    ],
)
def test_verdicts(statistic: Statistic, verdict: str) -> None:
    assert statistic.verdict == verdict
    assert statistic.p_value is not None
    assert (statistic.p_value >= 0.05) == (verdict == "accepted")


def test_false_alarms_are_as_rare_as_the_level() -> None:
    rng = np.random.default_rng(3)
    samples = [rng.normal(size=400) for _ in range(300)]
    for test in (tests._kolmogorov, tests._lilliefors, lambda x: tests._ljung_box([x])):
        rejected = np.mean([test(x).verdict == "rejected" for x in samples])
        assert rejected < 0.09


def test_r2_is_adjusted_for_its_regressors() -> None:
    rng = np.random.default_rng(4)
    values = [tests._regression([rng.normal(size=100)]).statistic or 0.0 for _ in range(200)]
    assert abs(np.mean(values)) < 0.01


@pytest.mark.parametrize("test", [tests._kolmogorov, tests._lilliefors])
def test_few_residuals_get_a_reason_not_a_number(test: object) -> None:
    statistic = test(NORMAL[:20])
    assert statistic.p_value is None
    assert statistic.not_applicable == "only 20 residuals"
    assert statistic.verdict == "undecidable"


def test_short_runs_get_a_reason() -> None:
    statistic = tests._regression([NORMAL[:4]] * 100)
    assert statistic.not_applicable == "unbroken runs of more than 6 residuals are too few"
