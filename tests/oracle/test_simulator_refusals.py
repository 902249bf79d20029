"""What the simulator refuses, by its words; and that the step limits are where integrators really fail."""

from dataclasses import replace

import numpy as np
import pytest

from emulator.closed_loop import runge_kutta
from emulator.forward import Chain
from emulator.law import Path
from emulator.simulator import Control, Dynamics, Smooth, reference_of, simulate
from emulator.step_limit import RUNGE_KUTTA
from protocols.errors import ConfigError, IdentificationError
from protocols.motion import Reference
from protocols.robot import Geometry, Robot, geometry

RAIL = Geometry(np.eye(3)[None], np.zeros((1, 3)), np.array([1]), np.zeros(3))
AT_REST = reference_of(np.zeros((101, 1)), 0.001)
PD = Control.gains([100.0], 10.0)


def block(mass: float = 2.0, dry: float = 3.0) -> Dynamics:
    link, one = np.zeros((1, 10)), np.ones((1, 1))
    link[0, 0] = mass
    return Dynamics(link, 0 * one, 0 * one, np.zeros(1), one, np.array([dry]), np.zeros(1))


def test_friction_too_steep_for_the_step() -> None:
    """I = 2 kg, Fc = 3 N, k = 10000 s/m, h = 0.2 ms: h Fc k / I = 3 without the 5/s of the law."""
    message = (
        r"Dry friction of steepness 10000 s/rad decays at 1.5e\+04/s, which a step of 0.2 ms does not carry"
        r" \(h Fc k / I = 3, limit 2.785\). Use 2 times the substeps, a lower steepness or exact friction"
    )
    with pytest.raises(ConfigError, match=message):
        simulate(RAIL, block(), PD, AT_REST, friction=Smooth(10000.0))
    simulate(RAIL, block(), PD, AT_REST, friction=Smooth(10000.0), substeps=10)


@pytest.mark.parametrize(("share", "shakes"), [(0.98, False), (1.02, True)])
def test_the_limit_is_where_runge_kutta_starts_to_shake(share: float, shakes: bool) -> None:
    """Released at a speed around which friction is linear, past the check: below the limit it stops, above it grows."""
    h, dynamics = 0.001, block()
    steepness = share * RUNGE_KUTTA * 2.0 / (3.0 * h)
    out = np.empty((4, 101, 1))
    chain = Chain(RAIL.R0, RAIL.p0, RAIL.prismatic, RAIL.gravity)
    path = Path(AT_REST.q, AT_REST.qd, AT_REST.qdd, h)
    free = Control.gains([0.0], 0.0).law(0)
    start = np.array([[0.0], [1e-6 / steepness]])
    runge_kutta(chain, dynamics.terms(), np.array([steepness]), free, None, path, start, 1, out)
    assert bool(np.abs(out[1, -1, 0]) > start[1, 0]) is shakes


def test_the_step_leaves_no_steepness_worth_the_name() -> None:
    with pytest.raises(ConfigError, match=r"carries dry friction of 3 N·m only with a steepness of .* s/rad, below 5"):
        simulate(RAIL, block(mass=0.0005), PD, reference_of(np.zeros((101, 1)), 0.001), friction=Smooth(), substeps=10)


def test_a_law_too_stiff_for_the_leapfrog() -> None:
    message = (
        r"control law damps at 6000/s, which a step of 0.2 ms .* \(step times rate = 1.2, limit 1\). Use 2 times the"
    )
    with pytest.raises(ConfigError, match=message):
        simulate(RAIL, block(), Control.gains([100.0], 12000.0), AT_REST)


def test_mass_matrix_that_is_not_positive_definite_on_the_reference() -> None:
    with pytest.raises(IdentificationError, match=r"not positive definite on this motion \(smallest eigenvalue -2 kg"):
        simulate(RAIL, block(mass=-2.0), PD, AT_REST)


def test_mass_matrix_that_stops_being_so_where_the_arm_goes() -> None:
    """A first moment without the mass it needs: M is regular only while the outer link stands across."""
    planar = Geometry(
        np.array([np.eye(3), np.eye(3)]), np.array([[0, 0, 0], [1.0, 0, 0]]), np.zeros(2, dtype=np.int64), np.zeros(3)
    )
    link = np.zeros((2, 10))
    link[1, 1], link[1, 9] = 1.0, 0.4  # mx and zz of the outer link: det M = zz - (mx cos q2)²
    none = np.zeros(0)
    dynamics = Dynamics(link, np.diag([1.0, 0.0]), np.zeros((2, 2)), np.zeros(2), np.zeros((0, 2)), none, none)
    control = Control.gains([0.0, 0.0], 0.0)
    across = np.array([0.0, np.pi / 2])
    reference = reference_of(np.tile(across, (2001, 1)), 0.001)
    start = across, np.array([0.0, 3.0])
    with pytest.raises(IdentificationError, match=r"not positive definite .* s after the start, near q = .* rad"):
        simulate(planar, dynamics, control, reference, start=start)


def test_an_arm_that_runs_away() -> None:
    with pytest.raises(
        IdentificationError, match=r"ran away 0\.\d+ s after the start, near q = .*update the gains to its"
    ):
        simulate(RAIL, block(dry=0.0), Control.gains([-1e6], 0.0), AT_REST, start=(np.ones(1), np.zeros(1)))


def test_settings_that_do_not_fit(tx40: Robot) -> None:
    with pytest.raises(ConfigError, match=r"Number of joints: 1 in the parameters, 6 in the arm"):
        simulate(geometry(tx40), block(), PD, AT_REST)
    with pytest.raises(ConfigError, match=r"Number of joints: 2 in the control law, 1 in the arm"):
        simulate(RAIL, block(), Control.gains([1.0, 1.0], 1.0), AT_REST)
    with pytest.raises(
        ConfigError, match=r"control period of 0.3 ms is not a multiple of the integration step of 0.2 ms"
    ):
        simulate(RAIL, block(), PD.sampled(0.0003), AT_REST)
    with pytest.raises(ConfigError, match=r"101 samples with 0 substeps cannot be simulated; take at least 2 and 1"):
        simulate(RAIL, block(), PD, AT_REST, substeps=0)
    jump = shifted(AT_REST, 50, 0.0005)
    with pytest.raises(ConfigError, match=r"not regular: its steps differ from 0.001 s by up to 0.0005 s. Resample it"):
        simulate(RAIL, block(), PD, jump)
    gap = reference_of(np.where(np.arange(101)[:, None] == 7, np.nan, 0.0), 0.001)
    with pytest.raises(
        ConfigError, match=r"reference's q of joint 1 is nan at sample 7. Simulate stretches without gaps"
    ):
        simulate(RAIL, block(), PD, gap)


def shifted(reference: Reference, sample: int, by_s: float) -> Reference:
    t_s = reference.t_s.copy()
    t_s[sample] += by_s
    return Reference(t_s, reference.q, reference.qd, reference.qdd)


def test_laws_that_make_no_sense() -> None:
    with pytest.raises(ConfigError, match=r"A delay, or speed from positions, needs a sampled control law: give its"):
        replace(PD, delay=1)
    with pytest.raises(ConfigError, match=r"period -0.001 s and delay 0 cannot be simulated"):
        PD.sampled(-0.001)
    with pytest.raises(ConfigError, match=r"Computed torque acts on joints: leave the axes of the law out"):
        replace(Control.computed_torque(block(), 10.0), axes=2 * np.eye(1))


def test_parameters_that_make_no_sense() -> None:
    good = block()
    with pytest.raises(ConfigError, match=r"Dynamics.offset_Nm has shape \(2,\); it must be \(1,\)"):
        replace(good, offset_Nm=np.zeros(2))
    with pytest.raises(ConfigError, match=r"Dynamics.link holds 1 values that are not numbers"):
        replace(good, link=np.where(np.arange(10) == 3, np.nan, 1.0)[None])
    two = Dynamics(np.ones((2, 10)), np.eye(2), np.eye(2), np.zeros(2), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    with pytest.raises(ConfigError, match=r"Dynamics.rotor must be symmetric; mirrored entries differ by up to 0.5"):
        replace(two, rotor=np.array([[1.0, 0.5], [0.0, 1.0]]))


def test_merged_rows_are_the_same_friction() -> None:
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [-2.0, 0.0], [0.5, 0.5], [0.0, 0.0], [1.0, 1.0]])
    rng = np.random.default_rng(5)
    dry, skew = rng.uniform(1, 2, 6), rng.normal(size=6)
    whole = Dynamics(np.ones((2, 10)), np.eye(2), np.eye(2), np.zeros(2), rows, dry, skew)
    merged = whole.merged()
    assert merged.dry_rows.tolist() == [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    for qd in rng.normal(size=(5, 2)):
        first, second = (
            d.dry_rows.T @ (d.dry_Nm * np.sign(d.dry_rows @ qd) + d.skew_Nms_rad * abs(d.dry_rows @ qd))
            for d in (whole, merged)
        )
        assert second == pytest.approx(first, abs=1e-12)
