"""What users hand over by mistake: each case is named with numbers and a next step, and sound data are left alone."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident.base import Base, base_parameters
from ident.dataset import Signals, prepare
from ident.estimate import Estimate, estimate
from ident.model import Model
from ident.observation import observe
from ident.reduction import reduce, unshown
from protocols.errors import ConfigError, DataError, IdentificationError
from protocols.robot import Robot

Make = Callable[..., Signals]


@pytest.fixture(scope="module")
def model(tx40: Robot) -> tuple[Model, Base]:
    made = Model.of(tx40)
    return made, base_parameters(made)


@pytest.fixture(scope="module")
def sound(tx40: Robot, make_signals: Make) -> Signals:
    return make_signals(tx40, 1, 8.0, noise_Nm=0.3)


def fit(signals: Signals, model: tuple[Model, Base]) -> Estimate:
    return estimate([observe(prepare(signals), *model)], model[1])


def refusal(kind: type[Exception], signals: Signals, model: tuple[Model, Base]) -> str:
    with pytest.raises(kind) as error:
        fit(signals, model)
    return str(error.value)


def test_sound_data_get_no_complaint(sound: Signals, model: tuple[Model, Base]) -> None:
    notes = fit(sound, model).notes
    assert len(notes) == 2
    assert "rows left out around zero speed" in notes[0]
    assert "Residual autocorrelation" in notes[1]


def test_degrees(sound: Signals, model: tuple[Model, Base]) -> None:
    message = refusal(DataError, replace(sound, q=np.degrees(sound.q)), model)
    assert message.startswith("motion 1: positions of joint")
    assert "rad/s. They look like degrees: divide them by 57.3" in message


def test_motor_angles(sound: Signals, model: tuple[Model, Base], tx40: Robot) -> None:
    gears = np.array([j.drive.gear_ratio for j in tx40.joint])
    message = refusal(DataError, replace(sound, q=sound.q * gears), model)
    assert "motor angles: divide them by gear_ratio" in message


def test_neither_unit_explains(sound: Signals, model: tuple[Model, Base]) -> None:
    message = refusal(DataError, replace(sound, q=1e6 * sound.q), model)
    assert message.endswith("Check the robot file and the units.")


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_times_in_milliseconds_or_nanoseconds(sound: Signals, model: tuple[Model, Base], factor: float) -> None:
    message = refusal(DataError, replace(sound, t_s=factor * sound.t_s), model)
    assert "motion 1: one sample every 1" in message
    assert "these may be in milliseconds or nanoseconds. Divide them." in message


def test_times_that_jump_back(sound: Signals, model: tuple[Model, Base]) -> None:
    t = sound.t_s.copy()
    t[5000:] -= 1.0
    message = refusal(DataError, replace(sound, t_s=t), model)
    assert "time goes from 4.999000 s to 4.000000 s, sample 5000 of 8000; times must increase. Sort or cut" in message


def test_times_that_jump_ahead_are_a_gap(sound: Signals, model: tuple[Model, Base]) -> None:
    t = sound.t_s.copy()
    t[5000:] += 3.0
    notes = fit(replace(sound, t_s=t), model).notes
    assert "motion 1: 1 gaps, 3.001 s in all, the longest 3.001 s after 4.999 s; the stretches between" in notes[0]


def test_too_short(sound: Signals, model: tuple[Model, Base]) -> None:
    def first(rows: int) -> Signals:
        return replace(sound, t_s=sound.t_s[:rows], q=sound.q[:rows], tau_Nm=sound.tau_Nm[:rows])

    assert "that the 50 Hz filter needs. Record longer." in refusal(DataError, first(200), model)
    message = refusal(IdentificationError, first(440), model)
    assert " rows at 50 Hz for 60 parameters. Record longer, or decimate less." in message


def test_rank_deficient_motion(sound: Signals, model: tuple[Model, Base]) -> None:
    """All joints proportional to the first: inertias and frictions of the wrist cannot be told apart by posture."""
    q = sound.q.copy()
    q[:, 4] = q[:, 5] = 0.2
    message = refusal(IdentificationError, replace(sound, q=q), model)
    assert "This motion does not show" in message and "of 60 combinations of parameters; involved:" in message
    assert "joint5 moved by only" in message and "joint6 moved by only" in message
    assert "Record a motion in which every joint moves, fast and slow, in several poses." in message


def test_not_a_number(sound: Signals, model: tuple[Model, Base]) -> None:
    q = sound.q.copy()
    q[100:103, 2] = np.nan
    message = refusal(DataError, replace(sound, q=q), model)
    assert "position of joint3 is not a number in 3 of 8000 samples, first at 0.100 s. Cut that part out" in message


def test_torque_of_the_wrong_sign(sound: Signals, model: tuple[Model, Base]) -> None:
    tau = sound.tau_Nm.copy()
    tau[:, 3] *= -1
    notes = [n for n in fit(replace(sound, tau_Nm=tau), model).notes if "negative" in n]
    assert any(n.startswith("joint4: ") and "Fv4 = -" in n and "Fc4 = -" in n for n in notes)
    (note,) = [n for n in notes if n.startswith("joint4: ")]
    assert note.endswith("opposite signs: check gear_ratio and the sign of the current.")


def test_saturated_current(sound: Signals, model: tuple[Model, Base], tx40: Robot) -> None:
    limit = tx40.joint[1].torque_max_Nm
    tau = sound.tau_Nm.copy()
    tau[1000:1400, 1] = limit
    notes = fit(replace(sound, tau_Nm=tau), model).notes
    assert any(f"joint2 was at its largest torque, {limit:g} N·m, in 5." in n and "slow it down" in n for n in notes)


def test_a_filter_that_does_not_fit(sound: Signals) -> None:
    with pytest.raises(ConfigError, match="filter_Hz = 500 does not fit motion 1, sampled at 1000 Hz"):
        prepare(sound, 500.0)


def test_what_a_motion_cannot_show_is_said_in_words(sound: Signals, model: tuple[Model, Base]) -> None:
    fitted = estimate([observe(prepare(sound), *model)], model[1])
    lines = unshown(fitted, reduce(fitted))
    assert lines[-1].startswith("Not to be told from zero, or not needed, on this motion (")
    assert "XY6" in lines[-1] and "Fv1" not in lines[-1]
    assert "% of the torques." in lines[-1]
    assert all("hardly tells" in line and "only a combination of them is known" in line for line in lines[:-1])
    everything = replace(reduce(fitted), essential=np.ones(60, dtype=bool))
    assert unshown(fitted, everything) == []
