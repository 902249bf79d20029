"""Dataset to rows: the same filter over torque and columns, in blocks as in one piece; rows around zero speed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from ident import observation
from ident.base import base_parameters
from ident.dataset import Signals, prepare
from ident.model import Model
from ident.observation import decimate, observe, relative_error
from protocols.errors import ConfigError, DataError
from protocols.robot import Robot

Make = Callable[..., Signals]


def test_decimation_is_matlab_s() -> None:
    x = np.random.default_rng(1).normal(size=(4000, 2))
    ours = decimate(x, 20)[::20]
    theirs = signal.decimate(x, 20, axis=0, ftype="iir", zero_phase=True)
    np.testing.assert_allclose(ours[70:-70], theirs[70:-70], atol=1e-6)  # they differ in how they start


def test_blocks_give_what_one_piece_gives(tx40: Robot, make_signals: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Model.of(tx40)
    base = base_parameters(model)
    dataset = prepare(make_signals(tx40, 1))
    whole = observe(dataset, model, base)
    monkeypatch.setattr(observation, "BLOCK", 1100)
    blocks = observe(dataset, model, base)
    scale = np.abs(whole.W).max(axis=(0, 1))
    assert (np.abs(blocks.W - whole.W) <= 1e-7 * scale).all()
    np.testing.assert_allclose(blocks.y, whole.y, atol=1e-5)


def test_rows_of_slow_joints_and_motors_are_not_used(tx40: Robot, make_signals: Make) -> None:
    model = Model.of(tx40)
    base = base_parameters(model)
    dataset = prepare(make_signals(tx40, 2))
    o = observe(dataset, model, base, speed_threshold=0.3)
    (segment,) = dataset.segments
    at = np.searchsorted(segment.t_s, o.t_s - 1e-9)
    speed = np.abs(segment.qd[at])
    assert not o.used[:, :].T[speed < 0.3].any()
    motor = np.abs(segment.qd[at] @ model.coupling.T)[:, 5]
    assert not o.used[4][motor < 0.3].any()
    assert o.used[3][motor < 0.3].any()
    assert observe(dataset, model, base, speed_threshold=0.0).used.all()
    assert "rows left out around zero speed: joint1" in o.notes[0]


def test_a_joint_at_rest_has_no_rows_and_a_note(tx40: Robot, make_signals: Make) -> None:
    signals = make_signals(tx40, 3)
    q = signals.q.copy()
    q[:, 2] = 0.4
    model = Model.of(tx40)
    o = observe(prepare(replace(signals, q=q)), model, base_parameters(model))
    assert not o.used[2].any()
    assert o.used[1].any()
    assert any("joint3 moved by only" in note for note in o.notes)
    total, per_joint = relative_error([o], np.zeros(o.W.shape[2]))
    assert total == pytest.approx(100)
    assert np.isnan(per_joint[2])


def test_the_grid_does_not_cross_a_gap(tx40: Robot, make_signals: Make) -> None:
    signals = make_signals(tx40, 4)
    keep = np.r_[0:3000, 3500:6000]
    cut = replace(signals, t_s=signals.t_s[keep], q=signals.q[keep], tau_Nm=signals.tau_Nm[keep])
    model = Model.of(tx40)
    o = observe(prepare(cut), model, base_parameters(model))
    assert o.first.sum() == 2
    assert not ((o.t_s > 3.0) & (o.t_s < 3.5)).any()


def test_impossible_rates_are_refused(tx40: Robot, make_signals: Make) -> None:
    model = Model.of(tx40)
    base = base_parameters(model)
    with pytest.raises(ConfigError, match="decimate_to_Hz = 5000 is more than the 1000 Hz"):
        observe(prepare(make_signals(tx40, 5)), model, base, 5000.0)
    with pytest.raises(DataError, match="is too short to decimate to 2 Hz"):
        observe(prepare(make_signals(tx40, 5, duration_s=2.0)), model, base, 2.0)
