"""The regressor beside a loop over pinocchio's."""

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from ident.kernels import inertial_regressor
from protocols.checks import Figure
from protocols.clock import RealClock
from protocols.robot import Geometry, geometry, load

SAMPLES = 20_000
PEER_SAMPLES = 2_000
REPEATS = 5


def figures() -> Iterator[Figure]:
    """Time per sample of a six-axis arm, best of several."""
    robot = load("tx40")
    chain, clock = geometry(robot), RealClock()
    q, qd, qdd = np.random.default_rng(0).standard_normal((3, SAMPLES, robot.joints))
    inertial_regressor(chain, q[:2], qd[:2], qdd[:2])
    ours, theirs = [], []
    model = _model(chain)
    data = model.createData()
    for _ in range(REPEATS):
        begin = clock.now_ns()
        inertial_regressor(chain, q, qd, qdd)
        ours.append((clock.now_ns() - begin) / SAMPLES)
        begin = clock.now_ns()
        for k in range(PEER_SAMPLES):
            pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k])
        theirs.append((clock.now_ns() - begin) / PEER_SAMPLES)
    yield Figure(
        "regressor, 6 joints", min(ours) * 1e-3, "us/sample", "pinocchio in a loop", min(theirs) * 1e-3,
        min(theirs) / min(ours),
    )  # fmt: skip


def _model(chain: Geometry) -> pin.Model:
    model = pin.Model()
    model.gravity.linear = chain.gravity
    for j, prismatic in enumerate(chain.prismatic):
        joint = pin.JointModelPZ() if prismatic else pin.JointModelRZ()
        model.addJoint(j, joint, pin.SE3(chain.R0[j], chain.p0[j]), f"joint{j + 1}")
    return model
