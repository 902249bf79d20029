"""Linearised sensitivities against pinocchio's derivatives, finite differences of the simulator and a closed form."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from emulator.derivatives import bodies, inverse_dynamics_derivatives
from emulator.forward import Chain
from emulator.sensitivity import midpoints, sensitivities
from emulator.simulator import Control, Dynamics, Exact, Simulation, Smooth, reference_of, simulate
from ident.model import Model
from protocols.errors import ConfigError
from protocols.motion import Reference
from protocols.robot import Geometry, Robot, geometry

Array = np.ndarray
ToDynamics = Callable[[Model, Array], Dynamics]

COLUMNS = ["ZZ1", "XX2", "MX2", "MY3", "Ia3", "XZ4", "Fv4", "Fc5", "offset2", "Ia6", "Fc6", "fv_m6", "fc_m6"]


@pytest.mark.parametrize("joints", range(1, 13))
def test_derivatives_equal_pinocchio(joints: int) -> None:
    rng = np.random.default_rng(600 + joints)
    place = Geometry(
        np.array([pin.exp3(rng.normal(size=3) * 2) for _ in range(joints)]),
        rng.normal(size=(joints, 3)) * 0.4,
        rng.integers(0, 2, joints),
        rng.normal(size=3) * 9.81,
    )
    link = rng.normal(size=(joints, 10))  # no body has them; only the mass must not be zero, for pinocchio's sake
    link[:, 0] = rng.uniform(0.5, 8.0, joints)
    model, parent = pin.Model(), 0
    model.gravity.linear = place.gravity
    for j, (m, mx, my, mz, xx, xy, xz, yy, yz, zz) in enumerate(link):
        kind = pin.JointModelPZ() if place.prismatic[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, pin.SE3(place.R0[j], place.p0[j]), f"joint{j + 1}")
        inertia = pin.Inertia.FromDynamicParameters(np.array([m, mx, my, mz, xx, xy, yy, xz, yz, zz]))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    chain = Chain(place.R0, place.p0, place.prismatic, place.gravity)
    M, by_q, by_qd = np.empty((3, joints, joints))
    data = model.createData()
    for _ in range(5):
        q, qd, qdd = rng.normal(size=(3, joints)) * np.array([[2.0], [3.0], [10.0]])
        inverse_dynamics_derivatives(chain, link, q, qd, qdd, bodies(joints), M, by_q, by_qd)
        expected_q, expected_qd, upper = pin.computeRNEADerivatives(model, data, q, qd, qdd)
        size = max(np.abs(x).max() for x in (expected_q, expected_qd, upper))
        assert by_q == pytest.approx(expected_q, rel=0, abs=1e-12 * size)
        assert by_qd == pytest.approx(expected_qd, rel=0, abs=1e-12 * size)
        inertia = np.triu(upper) + np.triu(upper, 1).T
        assert np.abs(M - inertia).max() < 1e-12 * size


def swing() -> Reference:
    """From rest into motions that reverse several times on every axis."""
    t = 0.001 * np.arange(1501)
    envelope = 1 - np.exp(-((t / 0.4) ** 3))
    q = 0.4 * envelope[:, None] * np.sin(np.outer(t, [5.0, 7.0, 6.0, 9.0, 8.0, 11.0]) + np.arange(6))
    return reference_of(q, 0.001)


def law(robot: Robot, name: str) -> Control:
    laws = [joint.control for joint in robot.joint]
    pd = Control.pd(
        [x.natural_frequency_rad_s for x in laws], [x.damping for x in laws], [x.inertia_kgm2 for x in laws]
    )
    pid = replace(pd, integral=4 * pd.stiffness)
    believed = Dynamics.of(robot)
    return {
        "pd": pd,
        "pd of the drives": replace(pd, axes=robot.coupling_matrix()),
        "pd of the host": pd.sampled(0.001, 1, difference=True),
        "pd every other sample": pd.sampled(0.002),
        "pd sampled fast": pd.sampled(0.0002, 1, difference=True),
        "pid": pid,
        "pid sampled": pid.sampled(0.001),
        "computed torque": Control.computed_torque(replace(believed, link=1.1 * believed.link), 40.0),
        "computed torque sampled": Control.computed_torque(believed, 40.0).sampled(0.001),
    }[name]


def worst_column(
    robot: Robot, to_dynamics: ToDynamics, control: Control, friction: Exact | Smooth, names: list[str]
) -> tuple[float, float]:
    """Largest relative error of a column of q and of tau, against central differences of the nonlinear simulation."""
    model = Model.of(robot)
    theta, reference, place = model.theta(robot), swing(), geometry(robot)
    start = reference.q[0], np.zeros(6)

    def run(at: Array) -> Simulation:
        return simulate(place, to_dynamics(model, at), control, reference, friction=friction, start=start)

    simulation = run(theta)
    found = sensitivities(simulation, model.regressor(*midpoints(simulation)))
    errors = []
    for name in names:
        p = model.names.index(name)
        e = np.zeros_like(theta)
        e[p] = 1e-3 * max(abs(theta[p]), 0.01)
        plus, minus = run(theta + e), run(theta - e)
        error = []
        for a, b, mine in ((plus.q, minus.q, found.q), (plus.tau_Nm, minus.tau_Nm, found.tau_Nm)):
            expected = (a - b).T / (2 * e[p])
            error.append(float(np.linalg.norm(mine[:, :, p] - expected) / np.linalg.norm(expected)))
        errors.append(error)
    worst_q, worst_tau = np.max(errors, axis=0)
    return float(worst_q), float(worst_tau)


@pytest.mark.parametrize(
    "name",
    ["pd", "pd of the drives", "pd of the host", "pd every other sample", "pd sampled fast", "pid", "pid sampled"],
)
def test_sensitivities_equal_finite_differences(tx40: Robot, to_dynamics: ToDynamics, name: str) -> None:
    q, tau = worst_column(tx40, to_dynamics, law(tx40, name), Exact(), COLUMNS)
    assert q < 0.03
    assert tau < 0.05


@pytest.mark.parametrize("name", ["computed torque", "computed torque sampled"])
def test_sensitivities_under_computed_torque(tx40: Robot, to_dynamics: ToDynamics, name: str) -> None:
    """Looser: the law's friction switches with the reference, and it is linearised where the arm obeys."""
    q, tau = worst_column(tx40, to_dynamics, law(tx40, name), Exact(), COLUMNS)
    assert q < 0.1
    assert tau < 0.1


def test_sensitivities_with_smooth_friction(tx40: Robot, to_dynamics: ToDynamics) -> None:
    smooth = [name for name in COLUMNS if not name.startswith(("Fc", "fc"))]  # the regressor's sign is not smooth
    for name in ("pd", "pd of the host"):
        q, tau = worst_column(tx40, to_dynamics, law(tx40, name), Smooth(20.0), smooth)
        assert q < 0.02
        assert tau < 0.02


def test_at_its_limit_a_torque_does_not_answer(tx40: Robot, to_dynamics: ToDynamics) -> None:
    free = law(tx40, "pd")
    control = replace(free, limit_Nm=np.array([40.0, 60.0, 20.0, 8.0, 8.0, 8.0]))
    model = Model.of(tx40)
    dynamics, reference = to_dynamics(model, model.theta(tx40)), swing()
    run = simulate(geometry(tx40), dynamics, control, reference)
    found = sensitivities(run, model.regressor(*midpoints(run)))
    at_limit = (np.abs(run.tau_Nm) >= control.limit_Nm * (1 - 1e-12)).T
    assert 10 < at_limit.sum() < at_limit.size / 2
    assert (found.tau_Nm[at_limit] == 0.0).all()


def thrown_up() -> Simulation:
    """A block of 2 kg on a vertical rail with 3 N of friction, thrown up at 1 m/s: it turns without resting."""
    rail = Geometry(np.eye(3)[None], np.zeros((1, 3)), np.array([1]), np.array([0.0, 0.0, -9.81]))
    link, one = np.zeros((1, 10)), np.ones((1, 1))
    link[0, 0] = 2.0
    block = Dynamics(link, 0 * one, 0 * one, np.zeros(1), one, np.array([3.0]), np.zeros(1))
    reference = reference_of(np.zeros((301, 1)), 0.001)
    free = Control.gains([0.0], 0.0)
    return simulate(rail, block, free, reference, substeps=10, start=(np.zeros(1), np.ones(1)))


def test_a_speed_that_crosses_zero_loses_what_the_jump_of_friction_takes() -> None:
    run = thrown_up()
    t, m, up, down = run.t_s, 2.0, 9.81 + 1.5, 9.81 - 1.5  # decelerates at `up`, then accelerates at `down`
    turn = 1.0 / up
    after = t - turn
    exact = np.where(
        t < turn,
        -(t**2) / (2 * m),
        -1 / (2 * up**2 * m) + after**2 / (2 * m) - down * after / (up**2 * m),
    )
    speed = midpoints(run)[1]
    by_friction = np.sign(speed).T[:, :, None]
    assert sensitivities(run, by_friction).q[0, :, 0] == pytest.approx(exact, abs=0.02 * np.abs(exact).max())
    # Without the jump, as a regressor's sign alone would have it, the answer is another.
    blind = sensitivities(replace(run, steepness=np.zeros(1)), by_friction).q[0, :, 0]
    assert np.abs(blind - exact).max() > 0.1 * np.abs(exact).max()


def test_refusals() -> None:
    run = thrown_up()
    with pytest.raises(
        ConfigError, match=r"shape \(1, 301, 2\); sensitivities need it between the samples: \(1, 300, P\)"
    ):
        sensitivities(run, np.zeros((1, 301, 2)))
    odd = replace(run, control=run.control.sampled(0.0015))
    with pytest.raises(ConfigError, match=r"control period of 1.5 ms is not a multiple of the sample step of 1 ms"):
        sensitivities(odd, np.zeros((1, 300, 2)))
