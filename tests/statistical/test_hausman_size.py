"""Durbin-Wu-Hausman: rejects 5 % of the time when least squares is consistent, and always when it is not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident.base import base_parameters
from ident.dataset import Signals, prepare
from ident.hausman import hausman
from ident.model import Model
from ident.observation import Observation, observe
from protocols.robot import Robot

RUNS = 1000
SIGMA_NM = np.array([1.0, 1.0, 0.6, 0.3, 0.3, 0.2])


@pytest.fixture(scope="module")
def rows(tx40: Robot, make_signals: Callable[..., Signals]) -> tuple[Observation, Observation]:
    """Columns of a motion, and those of another that differs from it by a few milliradians, as a simulated one does."""
    model = Model.of(tx40)
    base = base_parameters(model)
    signals = make_signals(tx40, 41, 8.0)
    t = signals.t_s[:, None]
    beside = signals.q + 2e-3 * np.sin(2 * np.pi * np.array([0.7, 0.9, 1.1, 0.8, 1.3, 1.0]) * t)
    return observe(prepare(signals), model, base), observe(prepare(replace(signals, q=beside)), model, base)


def test_size_is_five_percent(rows: tuple[Observation, Observation]) -> None:
    columns, instruments = rows
    rng = np.random.default_rng(42)
    rejected = 0
    for _ in range(RUNS):
        noise = SIGMA_NM[:, None] * rng.normal(size=columns.y.shape)
        rejected += hausman([replace(columns, y=columns.y + noise)], [instruments], SIGMA_NM).verdict == "rejected"
    assert 0.033 < rejected / RUNS < 0.067, "2.5 standard deviations of a proportion of 5 %"


def test_an_error_that_follows_the_motion_is_found(rows: tuple[Observation, Observation]) -> None:
    """Power: columns with errors of their own, as differentiated noise makes them."""
    columns, instruments = rows
    rng = np.random.default_rng(43)
    for _ in range(20):
        W = columns.W + 0.02 * columns.W.std(axis=(0, 1)) * rng.normal(size=columns.W.shape)
        noise = SIGMA_NM[:, None] * rng.normal(size=columns.y.shape)
        test = hausman([replace(columns, W=W, y=columns.y + noise)], [instruments], SIGMA_NM)
        assert test.verdict == "rejected"


def test_instruments_that_are_the_columns_tell_nothing(rows: tuple[Observation, Observation]) -> None:
    test = hausman([rows[0]], [rows[0]], SIGMA_NM)
    assert test.statistic is None
    assert test.not_applicable == "columns and instruments are the same"
