"""The closed-loop simulator against pinocchio, scipy's DOP853, the motion host, conserved energy and closed forms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from emulator.forward import Chain, smooth_acceleration, workspace
from emulator.host import PdLaw
from emulator.simulator import Control, Dynamics, Exact, Smooth, axis_inertia, reference_of, simulate
from ident.model import Model
from protocols.motion import Reference
from protocols.robot import Geometry, Robot, geometry

Array = np.ndarray
Arm = tuple[Geometry, Dynamics, pin.Model]

SLIDER = Geometry(np.eye(3)[None], np.zeros((1, 3)), np.array([1]), np.array([0.0, 0.0, -9.81]))  # up and down


def random_arm(joints: int, seed: int) -> Arm:
    """A chain of both kinds of joints with physical links, coupled motors and every kind of friction."""
    rng = np.random.default_rng(seed)
    R0 = np.array([pin.exp3(rng.normal(size=3) * 2) for _ in range(joints)])
    place = Geometry(R0, rng.normal(size=(joints, 3)) * 0.3, rng.integers(0, 2, joints), rng.normal(size=3) * 5)
    model, parent, link = pin.Model(), 0, []
    model.gravity.linear = place.gravity
    for j in range(joints):
        spread = rng.normal(size=(3, 3)) * 0.2
        inertia = pin.Inertia(rng.uniform(1, 3), rng.normal(size=3) * 0.2, np.eye(3) * 0.2 + spread @ spread.T)
        kind = pin.JointModelPZ() if place.prismatic[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, pin.SE3(R0[j], place.p0[j]), f"joint{j + 1}")
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()  # pinocchio's own order
        link.append([m, mx, my, mz, xx, xy, xz, yy, yz, zz])
    C = np.eye(joints) + np.diag(rng.uniform(0.2, 1.0, joints - 1), -1)
    rows = np.vstack([np.eye(joints), C[1:]])
    dynamics = Dynamics(
        link=np.array(link),
        rotor=C.T @ np.diag(rng.uniform(0.1, 0.5, joints)) @ C,
        viscous=C.T @ np.diag(rng.uniform(0.1, 2.0, joints)) @ C,
        offset_Nm=rng.normal(size=joints),
        dry_rows=rows,
        dry_Nm=rng.uniform(0.2, 2.0, len(rows)),
        skew_Nms_rad=rng.normal(size=len(rows)) * 0.05,
    )
    return place, dynamics, model


def parts_by_pinocchio(model: pin.Model, d: Dynamics, q: Array, qd: Array) -> tuple[Array, Array]:
    """M and N with rotors, viscous friction and offsets, written out in numpy around pinocchio's."""
    data = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    bias = pin.rnea(model, data, q, qd, 0 * qd) + d.viscous @ qd + d.offset_Nm
    return upper + np.triu(upper, 1).T + d.rotor, bias + d.dry_rows.T @ (d.skew_Nms_rad * abs(d.dry_rows @ qd))


def acceleration_by_pinocchio(model: pin.Model, d: Dynamics, k: float, q: Array, qd: Array, tau: Array) -> Array:
    M, N = parts_by_pinocchio(model, d, q, qd)
    return np.linalg.solve(M, tau - N - d.dry_rows.T @ (d.dry_Nm * np.tanh(k * (d.dry_rows @ qd))))


def parabola(joints: int, T: int, step_s: float) -> Reference:
    """A reference whose positions are cubic at most and whose speeds are straight, so nothing is lost in between."""
    t = step_s * np.arange(T)[:, None]
    slope, bend = np.linspace(0.4, 1.0, joints), np.linspace(-1.0, 2.0, joints)
    return Reference(t[:, 0], slope * t + bend * t**2 / 2, slope + bend * t, 0 * t + bend)


@pytest.mark.parametrize("joints", range(1, 13))
def test_acceleration_equals_pinocchio(joints: int) -> None:
    place, dynamics, model = random_arm(joints, 500 + joints)
    arm = Chain(place.R0, place.p0, place.prismatic, place.gravity), dynamics.terms()
    rng, qdd = np.random.default_rng(joints), np.empty(joints)
    for _ in range(5):
        q, qd, tau = rng.normal(size=(3, joints)) * np.array([[2.0], [3.0], [10.0]])
        assert smooth_acceleration(*arm, np.full(len(dynamics.dry_Nm), 20.0), q, qd, tau, workspace(joints), qdd)
        expected = acceleration_by_pinocchio(model, dynamics, 20.0, q, qd, tau)
        assert qdd == pytest.approx(expected, rel=0, abs=1e-12 * np.abs(expected).max())


def test_acceleration_equals_articulated_bodies() -> None:
    """pinocchio's aba, another algorithm: without rotors and friction, which it does not know."""
    place, dynamics, model = random_arm(7, 3)
    none = np.zeros(0)
    bare = Dynamics(dynamics.link, np.zeros((7, 7)), np.zeros((7, 7)), np.zeros(7), np.zeros((0, 7)), none, none)
    q, qd, tau = np.random.default_rng(4).normal(size=(3, 7))
    qdd = np.empty(7)
    arm = Chain(place.R0, place.p0, place.prismatic, place.gravity), bare.terms()
    assert smooth_acceleration(*arm, none, q, qd, tau, workspace(7), qdd)
    expected = pin.aba(model, model.createData(), q, qd, tau)
    assert qdd == pytest.approx(expected, rel=0, abs=1e-12 * np.abs(expected).max())


def laws() -> dict[str, tuple[Control, Callable[..., Array]]]:
    """Each law with its torque written out: error, speed error, speed, integral, reference's acceleration -> torque."""
    kp, kd, ki = np.array([60.0, 50.0, 40.0]), np.array([9.0, 8.0, 7.0]), np.array([30.0, 20.0, 10.0])
    A = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, -1.0, 1.0]])
    return {
        "pd": (Control.gains(kp, kd), lambda e, ed, qd, z: kp * e - kd * qd),
        "pid": (Control.gains(kp, kd, ki, speed_weight=1.0), lambda e, ed, qd, z: kp * e + kd * ed + ki * z),
        "pd on motors": (Control.gains(kp, kd, axes=A), lambda e, ed, qd, z: A.T @ (kp * (A @ e) - kd * (A @ qd))),
        "pd at its limit": (
            Control.gains(kp, kd, limit_Nm=5.0),
            lambda e, ed, qd, z: np.clip(kp * e - kd * qd, -5, 5),
        ),
    }


@pytest.mark.parametrize("name", ["pd", "pid", "pd on motors", "pd at its limit"])
def test_runge_kutta_follows_dop853_under_continuous_laws(name: str) -> None:
    place, dynamics, model = random_arm(3, 21)
    dynamics = replace(dynamics, skew_Nms_rad=np.zeros(5))  # |qd| has a corner, which costs orders
    control, torque = laws()[name]
    reference = parabola(3, 61, 0.01)
    start = np.array([0.3, -0.2, 0.1]), np.array([0.5, -0.5, 0.2])

    def slope(t: float, x: Array) -> Array:
        q, qd, z = x.reshape(3, 3)
        aim = reference.qd[0] * t + reference.qdd[0] * t**2 / 2
        aim_qd = reference.qd[0] + reference.qdd[0] * t
        tau = torque(aim - q, aim_qd - qd, qd, z)
        return np.concatenate([qd, acceleration_by_pinocchio(model, dynamics, 5.0, q, qd, tau), aim - q])

    first = np.concatenate([*start, np.zeros(3)])
    exact = solve_ivp(slope, (0, 0.6), first, "DOP853", reference.t_s, rtol=1e-10, atol=1e-12).y.T
    coarse, fine = (
        np.abs(
            simulate(place, dynamics, control, reference, substeps=n, friction=Smooth(5.0), start=start).q
            - exact[:, :3]
        ).max()
        for n in (2, 6)
    )
    if name == "pd at its limit":  # another corner
        assert fine < 1e-5
    else:
        assert coarse < 1e-6
        assert fine < coarse / 40  # 81 in fourth order


def test_computed_torque_with_the_true_model_tracks_and_without_it_does_not() -> None:
    place, dynamics, model = random_arm(3, 22)
    reference = parabola(3, 301, 0.002)
    heavier = replace(dynamics, link=1.3 * dynamics.link)
    follow, stray = (
        simulate(place, dynamics, Control.computed_torque(believed, 30.0), reference, substeps=5)
        for believed in (dynamics, heavier)
    )
    assert np.abs(follow.q - reference.q).max() < 1e-6
    assert np.abs(stray.q - reference.q).max() > 1e-3
    M, N = parts_by_pinocchio(model, dynamics, follow.q[50], follow.qd[50])
    dry = dynamics.dry_rows.T @ (dynamics.dry_Nm * np.sign(dynamics.dry_rows @ reference.qd[50]))
    assert follow.tau_Nm[50] == pytest.approx(M @ reference.qdd[50] + N + dry, abs=1e-3)


def host_motion(robot: Robot) -> tuple[Control, Reference]:
    """A motion from rest and the PD of the motion host at 1 ms."""
    t = 0.001 * np.arange(1501)
    s = t / 1.5
    shape, end = 10 * s**3 - 15 * s**4 + 6 * s**5, np.array([0.8, -0.6, 0.9, 1.0, -0.7, 1.2])
    laws_ = [joint.control for joint in robot.joint]
    control = Control.pd(
        [x.natural_frequency_rad_s for x in laws_], [x.damping for x in laws_], [x.inertia_kgm2 for x in laws_]
    )
    limit = np.array([joint.torque_max_Nm for joint in robot.joint])
    control = Control.gains(control.stiffness, control.damping, limit_Nm=limit)
    return control.sampled(0.001, 1, difference=True), reference_of(np.outer(shape, end), 0.001)


@pytest.mark.parametrize("friction", [Exact(), Smooth()])
def test_the_sampled_law_is_that_of_the_motion_host(tx40: Robot, friction: Exact | Smooth) -> None:
    control, reference = host_motion(tx40)
    at_rest = reference.q[0], np.zeros(6)
    run = simulate(geometry(tx40), Dynamics.of(tx40), control, reference, friction=friction, start=at_rest)
    host = PdLaw(tx40, 0.001)
    host.current(reference.q[0], run.q[0])  # what came before the start
    for n in range(1, len(run.q)):
        tau = tx40.joint_torque(host.current(reference.q[n], run.q[n - 1]))  # one cycle late
        assert run.tau_Nm[n] == pytest.approx(tau, abs=1e-9)


def test_between_instants_a_sampled_law_holds_its_torque() -> None:
    """Against DOP853 started anew at each instant."""
    place, dynamics, model = random_arm(2, 23)
    reference = parabola(2, 41, 0.005)
    kp, kd = np.array([60.0, 50.0]), np.array([9.0, 8.0])
    control = Control.gains(kp, kd).sampled(0.01, 1)
    run = simulate(place, dynamics, control, reference, substeps=20, friction=Smooth(5.0))
    x = np.concatenate([reference.q[0], reference.qd[0]])
    before = np.concatenate([reference.q[0] - 0.01 * reference.qd[0], reference.qd[0]])
    for n in range(0, 40, 2):
        assert np.concatenate([run.q[n], run.qd[n]]) == pytest.approx(x, abs=1e-8)
        tau = kp * (reference.q[n] - before[:2]) - kd * before[2:]
        assert run.tau_Nm[n] == pytest.approx(tau, abs=1e-6)
        assert run.tau_Nm[n + 1] == pytest.approx(tau, abs=1e-6)
        before = x
        x = solve_ivp(
            lambda t, y, tau=tau: np.concatenate(
                [y[2:], acceleration_by_pinocchio(model, dynamics, 5.0, y[:2], y[2:], tau)]
            ),
            (0, 0.01),
            x,
            "DOP853",
            rtol=1e-10,
            atol=1e-12,
        ).y[:, -1]


def one_axis(mass: float, viscous: float = 0.0, dry: float = 0.0) -> Dynamics:
    link = np.zeros((1, 10))
    link[0, 0] = mass
    one = np.ones((1, 1))
    return Dynamics(link, 0 * one, viscous * one, np.zeros(1), one, np.array([dry]), np.zeros(1)).merged()


def test_one_linear_axis_follows_its_matrix_exponential() -> None:
    m, fv, kp, kd, ki = 2.0, 3.0, 500.0, 20.0, 300.0
    control = Control.gains([kp], kd, ki)
    reference = Reference(0.002 * np.arange(501), np.full((501, 1), 0.1), np.zeros((501, 1)), np.zeros((501, 1)))
    start = np.zeros(1), np.array([0.7])
    F = np.array([[0, 1, 0, 0], [-kp / m, -(kd + fv) / m, ki / m, 1 / m], [-1, 0, 0, 0], [0, 0, 0, 0]])
    load = kp * 0.1 - m * 9.81
    F = np.block([[F, np.array([[0.0], [0.0], [0.1], [0.0]])], [np.zeros((1, 5))]])
    exact = np.array([expm(F * t) @ [0.0, 0.7, 0.0, load, 1.0] for t in reference.t_s])
    for friction, tolerance in ((Smooth(), 1e-9), (Exact(), 2e-6)):
        run = simulate(SLIDER, one_axis(m, fv), control, reference, substeps=10, friction=friction, start=start)
        assert run.q[:, 0] == pytest.approx(exact[:, 0], abs=tolerance)


def test_exact_friction_stops_where_it_must_and_holds() -> None:
    level = Geometry(SLIDER.R0, SLIDER.p0, SLIDER.prismatic, np.zeros(3))
    rest = reference_of(np.zeros((1001, 1)), 0.001)
    free = Control.gains([0.0], 0.0)
    run = simulate(level, one_axis(2.0, dry=3.0), free, rest, substeps=10, start=(np.zeros(1), np.ones(1)))
    t = np.minimum(rest.t_s, 2.0 / 3.0)
    assert run.q[:, 0] == pytest.approx(t - 0.75 * t**2, abs=2e-8)
    assert (run.qd[670:] == 0.0).all()
    # Pulled with less than Coulomb torque it stays, exactly; the smooth sign creeps.
    pull = Control.gains([100.0], 0.0)
    aim = reference_of(np.full((1001, 1), 0.029), 0.001)
    at = np.zeros(1), np.zeros(1)
    assert (simulate(level, one_axis(2.0, dry=3.0), pull, aim, start=at).q == 0.0).all()
    assert simulate(level, one_axis(2.0, dry=3.0), pull, aim, friction=Smooth(), start=at).q[-1, 0] > 1e-4


def test_energy_of_a_free_arm_is_conserved() -> None:
    place, dynamics, model = random_arm(4, 24)
    none = np.zeros(0)
    free = Dynamics(dynamics.link, dynamics.rotor, np.zeros((4, 4)), np.zeros(4), np.zeros((0, 4)), none, none)
    reference = reference_of(np.zeros((501, 4)), 0.002)
    start = np.full(4, 0.3), np.array([0.5, -0.5, 0.4, 0.6])
    data = model.createData()

    def drift(friction: Exact | Smooth, substeps: int) -> float:
        control = Control.gains(np.zeros(4), 0.0)
        run = simulate(place, free, control, reference, substeps=substeps, friction=friction, start=start)
        energy = [
            pin.computeKineticEnergy(model, data, q, qd)
            + qd @ dynamics.rotor @ qd / 2
            + pin.computePotentialEnergy(model, data, q)
            for q, qd in zip(run.q, run.qd, strict=True)
        ]
        return float(np.ptp(energy))

    assert drift(Smooth(), 4) < 1e-8
    assert drift(Exact(), 4) < 0.3 * drift(Exact(), 2) < 1e-2  # second order


def test_torque_and_acceleration_satisfy_the_identification_model(tx40: Robot, to_dynamics) -> None:
    """tau = W theta at the samples, through every column of the model of `ident`."""
    model = Model.of(tx40)
    theta = model.theta(tx40)
    dynamics = to_dynamics(model, theta)
    for name in ("link", "rotor", "viscous", "offset_Nm", "dry_rows", "dry_Nm"):
        assert getattr(dynamics, name) == pytest.approx(getattr(Dynamics.of(tx40), name), abs=1e-12)
    control, reference = host_motion(tx40)
    run = simulate(geometry(tx40), dynamics, control, reference)
    moving = (np.abs(np.column_stack([run.qd, run.qd @ model.coupling[5]])) > 0.05).all(axis=1)
    assert moving.mean() > 0.5
    tau = (model.regressor(run.q[moving], run.qd[moving], run.qdd[moving]) @ theta).T
    assert run.tau_Nm[moving] == pytest.approx(tau, abs=1e-9)


def test_regular_initialisation_with_updated_gains_follows_the_real_arm(tx40: Robot) -> None:
    """Eq. (24): no mass, no friction, Ia = 1. With (22) the positions agree as in Table 5, row k = 0."""
    host, reference = host_motion(tx40)
    place, none, C = geometry(tx40), np.zeros(0), tx40.coupling_matrix()
    regular = Dynamics(np.zeros((6, 10)), C.T @ C, np.zeros((6, 6)), np.zeros(6), np.zeros((0, 6)), none, none)
    assert axis_inertia(place, regular, reference.q) == pytest.approx([1, 1, 1, 1, 2, 1])
    wanted = [joint.control.natural_frequency_rad_s for joint in tx40.joint]
    real = replace(host, period_s=0.0, delay=0, difference=False)  # the paper's law is continuous
    updated = Control.pd(wanted, 1.0, axis_inertia(place, regular, reference.q))
    arm = simulate(place, Dynamics.of(tx40), real, reference)
    model = simulate(place, regular, updated, reference)
    error = np.linalg.norm(arm.q - model.q, axis=0) / np.linalg.norm(arm.q, axis=0)
    assert (error < 0.02).all()
    # Ten times heavier still, updated gains follow as well, and gains that are not updated lose it.
    heavy = replace(regular, rotor=10 * regular.rotor)
    again = simulate(place, heavy, Control.pd(wanted, 1.0, axis_inertia(place, heavy, reference.q)), reference)
    stale = simulate(place, heavy, real, reference)
    assert again.q == pytest.approx(model.q, abs=1e-9)
    assert np.abs(stale.q - model.q).max() > 0.01


def test_exact_friction_converges_with_the_square_of_the_step_and_smooth_does_not(tx40: Robot) -> None:
    """Why exact friction is the default: at 5 kHz it is closer by three orders."""
    control, reference = host_motion(tx40)
    arm = geometry(tx40), Dynamics.of(tx40), control, reference
    fine = simulate(*arm, substeps=40)
    two, four = (np.abs(simulate(*arm, substeps=n).q - fine.q).max() for n in (2, 4))
    assert four < 0.4 * two
    five, smooth = (np.abs(simulate(*arm, friction=f).q - fine.q).max() for f in (Exact(), Smooth()))
    assert five < 1e-6
    assert smooth > 100 * five
