"""What this machine offers identification."""

from collections.abc import Iterator

import numpy as np

from ident.kernels import inertial_regressor
from ident.zenoh_session import router
from protocols.checks import Check
from protocols.clock import RealClock
from protocols.errors import PeerError
from protocols.robot import geometry, load

SAMPLES = 20_000


def checks() -> Iterator[Check]:
    """Look at Zenoh and the regressor kernel."""
    yield _zenoh()
    yield _kernel()


def _zenoh() -> Check:
    try:
        router("tcp/127.0.0.1:0").close()  # type: ignore[no-untyped-call]
    except PeerError as error:
        return Check("Zenoh session", False, str(error))
    return Check("Zenoh session", True, "a router opens on loopback.")


def _kernel() -> Check:
    clock = RealClock()
    chain = geometry(load("tx40"))
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.standard_normal((3, SAMPLES, 6))
    inertial_regressor(chain, q[:2], qd[:2], qdd[:2])
    ready_s = clock.now_ns() * 1e-9
    begin = clock.now_ns()
    inertial_regressor(chain, q, qd, qdd)
    sample_us = (clock.now_ns() - begin) * 1e-3 / SAMPLES
    return Check("regressor", True, f"ready after {ready_s:.1f} s; a sample of 6 joints takes {sample_us:.2f} us.")
