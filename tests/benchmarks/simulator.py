"""Time of the closed-loop simulator on the TX40, one core, warm. Run: python tests/benchmarks/simulator.py

The loop in Python calls pinocchio's aba with the same fixed-step method, law and smooth friction.
"""

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from emulator.sensitivity import midpoints, sensitivities
from emulator.simulator import Control, Dynamics, Exact, Smooth, reference_of, simulate
from ident.base import base_parameters
from ident.model import Model
from protocols.robot import Robot, geometry, load

SECONDS, SUBSTEPS = 8.0, 5  # 5 kHz on a grid of 1 ms
PYTHON_SAMPLES = 100  # of the loop in Python; its time is scaled to SECONDS
REPEATS = 7


def best(call: Callable[[], object]) -> float:
    """Shortest of some repetitions, after one that compiles [s]."""
    call()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def twin(robot: Robot, dynamics: Dynamics) -> pin.Model:
    """The same links in pinocchio; rotors as its armature, which has no coupling."""
    place, model, parent = geometry(robot), pin.Model(), 0
    model.gravity.linear = place.gravity
    for j, (m, mx, my, mz, xx, xy, xz, yy, yz, zz) in enumerate(dynamics.link):
        parent = model.addJoint(parent, pin.JointModelRZ(), pin.SE3(place.R0[j], place.p0[j]), f"joint{j + 1}")
        inertia = pin.Inertia.FromDynamicParameters(np.array([m, mx, my, mz, xx, xy, yy, xz, yz, zz]))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    model.armature = np.diag(dynamics.rotor).copy()
    return model


def in_python(model: pin.Model, d: Dynamics, control: Control, q_r: np.ndarray, steepness: np.ndarray) -> None:
    """Fourth-order Runge-Kutta over PYTHON_SAMPLES."""
    data, h = model.createData(), 0.001 / SUBSTEPS
    q, v = q_r[0].copy(), np.zeros(model.nq)

    def slope(aim: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        tau = control.stiffness * (aim - q) - control.damping * v - d.viscous @ v
        return pin.aba(model, data, q, v, tau - d.dry_rows.T @ (d.dry_Nm * np.tanh(steepness * (d.dry_rows @ v))))

    for n in range(PYTHON_SAMPLES):
        for s in range(SUBSTEPS):
            a, b, c = (q_r[n] + x / SUBSTEPS * (q_r[n + 1] - q_r[n]) for x in (s, s + 0.5, s + 1))
            v1, a1 = v, slope(a, q, v)
            v2 = v + h / 2 * a1
            a2 = slope(b, q + h / 2 * v1, v2)
            v3 = v + h / 2 * a2
            a3 = slope(b, q + h / 2 * v2, v3)
            v4 = v + h * a3
            a4 = slope(c, q + h * v3, v4)
            q, v = q + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def main() -> None:
    robot = load("tx40")
    place, dynamics, model = geometry(robot), Dynamics.of(robot), Model.of(robot)
    t = 0.001 * np.arange(round(SECONDS * 1000) + 1)
    grow = (1 - np.exp(-((t / 0.5) ** 3)))[:, None]
    reference = reference_of(0.5 * grow * np.sin(np.outer(t, [2.0, 3.0, 2.5, 3.5, 4.0, 4.5])), 0.001)
    laws = [joint.control for joint in robot.joint if joint.control is not None]
    law = Control.pd(
        [x.natural_frequency_rad_s for x in laws], [x.damping for x in laws], [x.inertia_kgm2 for x in laws]
    )
    host = law.sampled(0.001, 1, difference=True)

    first = time.perf_counter()
    simulate(place, dynamics, law, reference, friction=Smooth())
    print(f"first call {time.perf_counter() - first:.2f} s (compiles where the cache is empty)")
    steepness = simulate(place, dynamics, law, reference, friction=Smooth()).steepness
    rk = best(lambda: simulate(place, dynamics, law, reference, substeps=SUBSTEPS, friction=Smooth()))
    loop = best(lambda: in_python(twin(robot, dynamics), dynamics, law, reference.q, steepness))
    loop *= SECONDS * 1000 / PYTHON_SAMPLES
    print(f"{SECONDS:.0f} s at 5 kHz, 6 joints")
    print(
        f"  Runge-Kutta, smooth friction      {rk:.3f} s   {loop / rk:.0f} times faster than the loop in Python"
        f" ({loop:.1f} s)"
    )
    for name, control in (("continuous law", law), ("host's law", host)):
        for substeps in (SUBSTEPS, 2):
            took = best(
                lambda c=control, n=substeps: simulate(place, dynamics, c, reference, substeps=n, friction=Exact())
            )
            print(f"  leapfrog, exact friction, {substeps} kHz  {took:.3f} s   {name}")
    run = simulate(place, dynamics, host, reference)
    W = model.regressor(*midpoints(run))
    for what, columns in (
        (f"{W.shape[2]} standard", W),
        ("base", np.ascontiguousarray(W[:, :, base_parameters(model).kept])),
    ):
        took = best(lambda X=columns: sensitivities(run, X))
        print(f"  sensitivities, {what} columns ({columns.shape[2]})  {took:.3f} s   {took / rk:.2f} of the simulation")


if __name__ == "__main__":
    main()
