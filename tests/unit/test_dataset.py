"""Signals to dataset: differences, alignment, gaps, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from ident.dataset import Signals, differences, prepare
from protocols.errors import ConfigError, DataError

T = 0.001


def sine(samples: int = 4000, delay_s: float = 0.0) -> Signals:
    t = np.arange(samples) * T
    q = np.column_stack([np.sin(4 * t), np.cos(9 * t)])
    tau = np.column_stack([np.sin(20 * (t - delay_s)), np.cos(15 * (t - delay_s))])
    return Signals("run", ["a", "b"], t, q, tau, np.full(2, delay_s))


def test_speed_and_acceleration_are_those_of_the_motion() -> None:
    (segment,) = prepare(sine()).segments
    t = segment.t_s
    np.testing.assert_allclose(segment.q[:, 0], np.sin(4 * t), atol=1e-6)
    np.testing.assert_allclose(segment.qd, np.column_stack([4 * np.cos(4 * t), -9 * np.sin(9 * t)]), atol=1e-5)
    np.testing.assert_allclose(segment.qdd, np.column_stack([-16 * np.sin(4 * t), -81 * np.cos(9 * t)]), atol=3e-3)


def test_five_points_are_as_exact_as_their_comment_says() -> None:
    w = 2 * np.pi * 10.0
    q = np.sin(w * np.arange(2000) * T)[:, None]
    qd, _ = differences(q, T)
    error = np.abs(qd[2:-2, 0] - w * np.cos(w * np.arange(2000) * T)[2:-2]).max() / w
    assert 4e-7 < error < 6e-7


@pytest.mark.parametrize("delay_s", [0.0, 0.0005, 0.001, 0.0025])
def test_a_late_torque_is_put_back_to_its_instant(delay_s: float) -> None:
    (segment,) = prepare(sine(delay_s=delay_s)).segments
    np.testing.assert_allclose(segment.tau_Nm[:, 0], np.sin(20 * segment.t_s), atol=6e-5)


def test_a_torque_taken_as_timely_is_late() -> None:
    late = replace(sine(delay_s=0.0025), delay_s=np.zeros(2))
    (segment,) = prepare(late).segments
    assert np.abs(segment.tau_Nm[:, 0] - np.sin(20 * segment.t_s)).max() > 0.04


def test_a_gap_starts_a_new_segment_and_nothing_is_made_up() -> None:
    whole = sine()
    keep = np.r_[0:1500, 1503:4000]
    dataset = prepare(replace(whole, t_s=whole.t_s[keep], q=whole.q[keep], tau_Nm=whole.tau_Nm[keep]))
    assert len(dataset.segments) == 2
    assert dataset.segments[0].t_s[-1] < 1.5 <= dataset.segments[1].t_s[0]
    assert all(np.allclose(np.diff(s.t_s), T) for s in dataset.segments)
    assert "run: 1 gaps, 0.004 s in all, the longest 0.004 s after 1.499 s" in dataset.notes[0]


def test_stretches_too_short_to_filter_are_left_out_and_counted() -> None:
    whole = sine()
    keep = np.r_[0:3000, 3003:3050]
    dataset = prepare(replace(whole, t_s=whole.t_s[keep], q=whole.q[keep], tau_Nm=whole.tau_Nm[keep]))
    assert len(dataset.segments) == 1
    assert "1 stretches between gaps, 47 samples, are too short" in dataset.notes[1]


def test_input_is_left_alone() -> None:
    signals = sine()
    before = signals.q.copy(), signals.tau_Nm.copy()
    prepare(signals)
    np.testing.assert_array_equal(signals.q, before[0])
    np.testing.assert_array_equal(signals.tau_Nm, before[1])


def broken(what: str) -> Signals:
    signals = sine()
    q, tau, t = signals.q.copy(), signals.tau_Nm.copy(), signals.t_s.copy()
    if what == "nan":
        q[700:702, 1] = np.nan
    elif what == "nan torque":
        tau[5, 0] = np.inf
    elif what == "back":
        t[100] = t[98]
    elif what == "uneven":
        t[100] += 0.3 * T
    elif what == "short":
        t, q, tau = t[:300], q[:300], tau[:300]
    elif what == "one":
        t, q, tau = t[:1], q[:1], tau[:1]
    return replace(signals, t_s=t, q=q, tau_Nm=tau)


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("nan", "run: position of b is not a number in 2 of 4000 samples, first at 0.700 s."),
        ("nan torque", "run: torque of a is not a number in 1 of 4000 samples, first at 0.005 s."),
        ("back", "run: time goes from 0.099000 s to 0.098000 s, sample 100 of 4000; times must increase. Sort or cut"),
        ("uneven", "run: 2 of 3999 steps differ by more than 2 % from the period of 1.000 ms"),
        ("short", "none with the 409 samples (0.41 s) that the 50 Hz filter needs. Record longer."),
        ("one", "run: 1 samples; a motion of some seconds is needed."),
    ],
)
def test_unusable_signals_are_refused_with_numbers(what: str, sentence: str) -> None:
    with pytest.raises(DataError) as error:
        prepare(broken(what))
    assert sentence in str(error.value)


def test_a_cut_off_above_the_sampling_rate_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="filter_Hz = 600 does not fit run, sampled at 1000 Hz; choose at most 450 Hz"
    ):
        prepare(sine(), 600.0)


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DataError, match=r"q \(4000, 1\)"):
        replace(sine(), q=np.zeros((4000, 1)))
