"""Five million samples of six axes from signals to parameters: CPU seconds and memory above the input.

    .venv/bin/python tests/benchmarks/identify.py [--samples 5000000]

Limits (issue): 20 s of CPU and 1 GB. Not in CI: it takes half a minute and the input alone is 0.5 GB.
"""

import argparse
import resource
import time

import numpy as np

from ident.base import base_parameters
from ident.dataset import Signals
from ident.model import Model
from ident.streaming import estimate_stream
from protocols.robot import Robot, load

RATE_HZ = 5000.0
LIMIT_CPU_S, LIMIT_MB = 20.0, 1000.0
PIECE = 2_000


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, default=5_000_000)
    samples = parser.parse_args().samples
    robot = load("tx40")
    model = Model.of(robot)
    base = base_parameters(model)
    estimate_stream([made(robot, model, 20_000)], model, base)  # kernels compiled, libraries loaded
    signals = made(robot, model, samples)
    input_mb = (signals.q.nbytes + signals.tau_Nm.nbytes + signals.t_s.nbytes) / 1e6
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    cpu, wall = time.process_time(), time.perf_counter()
    fitted = estimate_stream([signals], model, base)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    above_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - before_mb
    truth = base.B @ model.theta(robot)
    z = (fitted.beta - truth) / fitted.std
    print(f"{samples} samples x {robot.joints} joints, input {input_mb:.0f} MB, {fitted.rows} rows used")
    print(
        f"CPU    {cpu:6.1f} s   (limit {LIMIT_CPU_S:.0f})   {1e6 * cpu / samples:.2f} us per sample; wall {wall:.1f} s"
    )
    print(f"memory {above_mb:6.0f} MB  (limit {LIMIT_MB:.0f}) above the input")
    print(f"error  {fitted.relative_error_percent:6.2f} %; largest distance from the truth {np.abs(z).max():.1f} std")


def made(robot: Robot, model: Model, samples: int) -> Signals:
    """Signals of a long motion with torque noise, made in pieces so that making them needs no more than they do."""
    rng = np.random.default_rng(1)
    J = robot.joints
    frequency, phase = rng.uniform(0.1, 1.2, (6, J)), rng.uniform(0, 2 * np.pi, (6, J))
    amplitude, w = rng.uniform(0.1, 0.3, (6, J)), 2 * np.pi * frequency
    t = np.arange(samples) / RATE_HZ
    q, tau = np.empty((samples, J)), np.empty((samples, J))
    theta = model.theta(robot)
    for start in range(0, samples, PIECE):
        part = slice(start, min(start + PIECE, samples))
        angle = w * t[part, None, None] + phase
        q[part] = (amplitude * np.sin(angle)).sum(1)
        qd, qdd = (amplitude * w * np.cos(angle)).sum(1), (-amplitude * w**2 * np.sin(angle)).sum(1)
        tau[part] = (model.regressor(q[part], qd, qdd) @ theta).T + 0.5 * rng.normal(size=(part.stop - part.start, J))
    return Signals("long", robot.joint_names, t, q, tau, np.zeros(J))


if __name__ == "__main__":
    main()
