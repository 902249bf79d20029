"""Drive gains from a known payload (Gautier & Briot 2014, ASME J. Dyn. Syst. Meas. Control 136, 051025).

Without a payload the gains and the parameters scale together: any factor fits. A payload of known mass and inertia
puts newton metres into the loaded run, and with them a scale into both. All rows of both runs are one system,
    V g - W beta = 0  (unloaded),      V g - W beta = W_load theta_load  (loaded),
with V the torques that each motor would give at its nominal gain; g are the factors to those.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from ident.base import Base, base_parameters
from ident.dataset import Dataset
from ident.model import Model
from ident.observation import DECIMATE_TO_HZ, Observation, observe
from ident.system import triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

Method = Literal["ls", "tls", "constrained"]
LEVEL = 0.95
FEWEST_BATCHES = 10
BATCH_S = 0.5  # longer than the memory of friction errors (lag-1 correlation 0.6 at 50 Hz is gone in 0.2 s)
SEEN = 1e-3  # share of the known torque in all rows below which there is no scale to find
SMALLEST_FACTOR = 1e-3  # of the nominal gain, lower bound of the constrained fit


@dataclass(frozen=True)
class DriveGains:
    """Gains of all drives.

    Attributes:
        method: How.
        joints: Joint names.
        gain_Nm_A: shape (J,).
        std_Nm_A: From the spread over batches of the recordings, shape (J,).
        low_Nm_A, high_Nm_A: 95 % interval by Student's t, shape (J,).
        nominal_Nm_A: Of the robot file, shape (J,).
        beta: Base parameters of the arm without payload, on the scale of these gains, shape (b,).
        notes: What the reader should know.
    """

    method: Method
    joints: list[str]
    gain_Nm_A: Array
    std_Nm_A: Array
    low_Nm_A: Array
    high_Nm_A: Array
    nominal_Nm_A: Array
    beta: Array
    notes: list[str]

    def __str__(self) -> str:
        rows = zip(self.joints, self.gain_Nm_A, self.low_Nm_A, self.high_Nm_A, self.nominal_Nm_A, strict=True)
        table = [f"{n:>8} {g:8.3f}  [{low:.3f}, {high:.3f}] N·m/A  (nominal {k:.3f})" for n, g, low, high, k in rows]
        return "\n".join([f"Drive gains with a known payload, {self.method}, 95 % intervals", *table, *self.notes])


def drive_gains(
    unloaded: Sequence[Dataset],
    loaded: Sequence[Dataset],
    model: Model,
    payload: Array,
    method: Method = "tls",
    decimate_to_Hz: float = DECIMATE_TO_HZ,
) -> DriveGains:
    """Gains from runs without and with a payload on the last link.

    Args:
        payload: Its ten inertial parameters in the frame of the last link, order of `protocols.robot.INERTIAL`.
        method: `ls` takes the currents as exact and is pulled to small gains by their noise; `tls` gives every row
            the error of its motors' currents, in the columns where they stand (weighted total least squares, for which
            rows are divided by what the gains make of that error); `constrained` is `ls` with gains above zero.

    Raises:
        IdentificationError: No payload to speak of, no loaded or unloaded run, or a gain that is not positive.
    """
    if not unloaded or not loaded:
        raise IdentificationError(
            f"{len(unloaded)} runs without and {len(loaded)} with payload; drive gains need at least one of each."
        )
    base = base_parameters(model)
    batches, spread = _batches(unloaded, loaded, model, base, payload, decimate_to_Hz)
    whole = _merged(batches)
    joints = model.joints
    known = float(np.linalg.norm([t[:, -1] for t in whole]))
    torque = float(np.linalg.norm([t[:, :joints] for t in whole]))
    if known < SEEN * torque:
        raise IdentificationError(
            f"The payload's torques are {100 * known / torque:.2g} % of the motors'; that gives the gains no scale. Use"
            " a heavier payload, farther from the axes."
        )
    factor, beta = _solve(whole, spread, method)
    if (factor <= 0).any():
        worst = int(np.argmin(factor))
        raise IdentificationError(
            f"The gain of {model.robot.joint_names[worst]} would be {factor[worst]:.2g} times its nominal value. Check"
            " the payload's parameters and the signs of its currents, or use the method constrained."
        )
    std, freedom = _jackknife(batches, spread, method)
    nominal = model.robot.drive_gains()
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, freedom)) * std
    at_bound = [n for n, f in zip(model.robot.joint_names, factor, strict=True) if f <= 2 * SMALLEST_FACTOR]
    notes = [f"Intervals from {freedom + 1} batches, one left out at a time."]
    if at_bound:
        notes.append(f"At the lower bound, so without an interval: {', '.join(at_bound)}.")
    return DriveGains(
        method,
        model.robot.joint_names,
        factor * nominal,
        std * nominal,
        np.maximum(factor - reach, 0.0) * nominal,
        (factor + reach) * nominal,
        nominal,
        beta,
        notes,
    )


def _batches(
    unloaded: Sequence[Dataset],
    loaded: Sequence[Dataset],
    model: Model,
    base: Base,
    payload: Array,
    decimate_to_Hz: float,
) -> tuple[list[list[Array]], Array]:
    """Per consecutive batch and joint the triangle of [V, -W, k], rows weighted by the joint's error and k the known
    torque; and the motors' errors in those rows at nominal gain, shape (J, J)."""
    last = np.arange(10 * (model.joints - 1), 10 * model.joints)
    names = [model.names[k] for k in last]
    load = Base(last, np.eye(len(model.names))[last], names, [model.units[k] for k in last], model.names)
    pieces: list[tuple[Observation, Array]] = []
    for dataset in unloaded:
        o = observe(dataset, model, base, decimate_to_Hz)
        pieces.append((o, np.zeros_like(o.y)))
    for dataset in loaded:
        o = observe(dataset, model, base, decimate_to_Hz)
        pieces.append((o, observe(dataset, model, load, decimate_to_Hz).predict(payload)))
    sigma = _sigma(pieces)
    inverse = np.linalg.inv(model.coupling.T)
    out = []
    for o, known in pieces:
        motor = inverse @ o.y
        step = max(1, round(BATCH_S * o.rate_Hz))
        for start in range(0, o.t_s.size, step):
            part = slice(start, start + step)
            rows = []
            for j in range(model.joints):
                used = o.used[j, part]
                V = (model.coupling.T[j][:, None] * motor[:, part]).T
                rows.append(triangle([np.column_stack([V, -o.W[j, part], known[j, part]])[used] / sigma[j]]))
            if o.used[:, part].any():
                out.append(rows)
    if len(out) < FEWEST_BATCHES:
        raise IdentificationError(
            f"The runs hold {len(out)} batches of {BATCH_S:g} s; intervals need {FEWEST_BATCHES}. Record longer."
        )
    # variances of motor currents add up in coupled rows; what differences would leave below a quarter is noise
    motors = np.linalg.solve((model.coupling.T) ** 2, sigma**2)
    motors = np.maximum(motors, sigma**2 / 4)
    return out, np.asarray(np.abs(model.coupling.T) * np.sqrt(motors) / sigma[:, None])


def _merged(batches: Sequence[Sequence[Array]]) -> list[Array]:
    """One triangle per joint."""
    return [triangle([batch[j] for batch in batches]) for j in range(len(batches[0]))]


def _sigma(pieces: Sequence[tuple[Observation, Array]]) -> Array:
    """Error per joint with the nominal gains, payload taken off, shape (J,)."""
    out = []
    for j in range(len(pieces[0][0].joints)):
        W = np.vstack([o.W[j, o.used[j]] for o, _ in pieces])
        y = np.concatenate([(o.y[j] - known[j])[o.used[j]] for o, known in pieces])
        shown = np.linalg.norm(W, axis=0) > 0
        rest = y - W[:, shown] @ np.linalg.lstsq(W[:, shown], y, rcond=1e-8)[0]
        out.append(
            max(float(np.linalg.norm(rest) / np.sqrt(max(1, len(y) - shown.sum()))), float(np.finfo(float).tiny))
        )
    return np.array(out)


def _solve(triangles: Sequence[Array], spread: Array, method: Method) -> tuple[Array, Array]:
    """Factors to the nominal gains, shape (J,), and base parameters."""
    joints = len(triangles)
    R = triangle(triangles)
    A, k = R[:, :-1], R[:, -1]
    scale = np.linalg.norm(A, axis=0)
    if method == "constrained":
        low = np.full(A.shape[1], -np.inf)
        low[:joints] = SMALLEST_FACTOR * scale[:joints]
        x = optimize.lsq_linear(A / scale, k, bounds=(low, np.inf), tol=1e-12).x / scale
    else:
        x = np.linalg.lstsq(A / scale, k, rcond=None)[0] / scale
    if method == "tls":
        x = _total(triangles, spread, x, scale)
    return x[:joints], x[joints:]


def _total(triangles: Sequence[Array], spread: Array, start: Array, scale: Array) -> Array:
    """Minimum over (g, beta) of the sum over joints of |V g - W beta - k|² / sum_m (spread_m g_m)²."""
    joints = len(triangles)
    A = np.array([t[:, :-1] / scale for t in triangles])
    k = np.array([t[:, -1] for t in triangles])

    def sizes(x: Array) -> Array:
        return np.asarray(np.linalg.norm(spread * x[:joints] / scale[:joints], axis=1))

    def residual(x: Array) -> Array:
        return np.asarray(((A @ x - k) / sizes(x)[:, None]).ravel())

    def slope(x: Array) -> Array:
        s = sizes(x)
        out = A / s[:, None, None]
        by_gain = spread**2 * x[:joints] / scale[:joints] ** 2 / s[:, None] ** 3
        out[:, :, :joints] -= (A @ x - k)[:, :, None] * by_gain[:, None, :]
        return np.asarray(out.reshape(-1, len(x)))

    found = optimize.least_squares(residual, start * scale, slope, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    if not found.success:
        raise IdentificationError(
            "The gains by tls did not settle: the payload shows them less than the noise. Use a heavier payload or ls."
        )
    return np.asarray(found.x / scale)


def _jackknife(batches: Sequence[list[Array]], spread: Array, method: Method) -> tuple[Array, int]:
    """Standard deviation of the factors by leaving batches out (Efron & Stein 1981), and degrees of freedom."""
    size = -(-len(batches) // (4 * FEWEST_BATCHES))
    groups = [_merged(batches[i : i + size]) for i in range(0, len(batches), size)]
    n = len(groups)
    found = np.array([_solve(_merged([*groups[:i], *groups[i + 1 :]]), spread, method)[0] for i in range(n)])
    return np.asarray(np.sqrt((n - 1) * found.var(axis=0))), n - 1
