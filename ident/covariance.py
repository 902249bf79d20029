"""Covariances by name: what is assumed of the errors decides how far an estimate may be from the truth.

Every method's estimate solves sum over instants of G_t' (y_t - W_t beta) = 0 to first order; G are its weighted
instruments (W / sigma² for least squares, Z / sigma² for instrumental variables). An error e then moves the estimate
by A sum G_t' e_t. The covariances differ in what they take for the size and the memory of e.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ident.observation import Observation
from protocols.errors import ConfigError, IdentificationError

Array = NDArray[np.float64]

LARGEST_ROOT = 0.97  # of the prewhitening autoregression, as Andrews & Monahan 1992
REPEATS = 0.1  # relative difference of two periods' torques up to which a motion is periodic
CHANGED = 0.5  # relative difference above which a motion has left its start
MIN_PERIODS = 3  # deviations from an average of two say nothing of the third


@dataclass(frozen=True)
class Moments:
    """What every covariance is made of.

    Attributes:
        observations: Rows the estimate was made of.
        beta: Estimate, shape (b,).
        bread: A, shape (b, b).
        G: Weighted instruments of every recording, zero in rows not used, each of shape (J, N, b).
        white: Covariance for serially uncorrelated errors, as the method has it (eq. (8) or (26)), shape (b, b).
    """

    observations: Sequence[Observation]
    beta: Array
    bread: Array
    G: Sequence[Array]
    white: Array

    @classmethod
    def weighted(
        cls, observations: Sequence[Observation], beta: Array, sigma: Array, bread: Array, white: Array | None = None
    ) -> "Moments":
        """Of least squares with weights 1/sigma_j, shape (J,); white is A unless given."""
        G = [np.where(o.used[:, :, None], o.W, 0.0) / sigma[:, None, None] ** 2 for o in observations]
        return cls(observations, beta, bread, G, bread if white is None else white)

    @property
    def residuals(self) -> list[Array]:
        """y - W beta, zero in rows not used, each of shape (J, N)."""
        return [np.where(o.used, o.y - o.predict(self.beta), 0.0) for o in self.observations]

    @property
    def inflation(self) -> float:
        """Residual variances are too small by this factor: b parameters were fitted to them."""
        rows = sum(o.rows for o in self.observations)
        return rows / max(1, rows - len(self.beta))

    def sandwich(self, long_run: Array) -> Array:
        """A S A'."""
        return np.asarray(self.bread @ long_run @ self.bread.T)


class Covariance(Protocol):
    """One way to make a covariance."""

    def of(self, moments: Moments) -> tuple[Array, str]:
        """Covariance, shape (b, b), and how it was made, in words."""
        ...


@dataclass(frozen=True)
class White:
    """Eq. (8) of Janot et al. 2014: errors neither correlated in time nor between joints."""

    def of(self, moments: Moments) -> tuple[Array, str]:
        return moments.white, "white (eq. (8): errors uncorrelated in time and between joints)"


@dataclass(frozen=True)
class Hac:
    """Newey & West 1987 (Econometrica 55, 703-708), scores prewhitened and bandwidth chosen from the data as in Andrews
    & Monahan 1992 (Econometrica 60, 953-966). Holds for errors whose memory is short against the recording.

    Joints at one instant may correlate (a coupled motor's current enters two joint torques). Lags do not reach over
    gaps. Without prewhitening the Bartlett kernel covers 90 % where 95 % are claimed, at lag-1 correlations of 0.5.
    """

    def of(self, moments: Moments) -> tuple[Array, str]:
        S, lags = long_run(_stretches(moments, moments.residuals))
        words = f"HAC (Newey-West, Bartlett kernel, prewhitened, {lags} lags), joints at one instant may correlate"
        return moments.sandwich(S) * moments.inflation, words


@dataclass(frozen=True)
class Period:
    """Errors are what differs between repetitions of one motion, Bahloul, Tliba & Chitour, eq. (5) and (11).

    What repeats in every period, such as friction that the model lacks, is no error in this sense: the intervals say
    where another recording of the *same* motion would lead.

    Attributes:
        period_s: Of the motion; None to find it in the predicted torques.
    """

    period_s: float | None = None

    def of(self, moments: Moments) -> tuple[Array, str]:
        periods, deviations, lengths = 0, [], []
        for o, residual in zip(moments.observations, moments.residuals, strict=True):
            rows = self._rows(o, moments.beta)
            count = o.t_s.size // rows
            deviations.append(_deviations(residual, o.used, rows, count))
            periods += count
            lengths.append(rows / o.rate_Hz)
        S, lags = long_run(_stretches(moments, deviations))
        share = sum(int((d != 0).sum()) for d in deviations) / sum(o.rows for o in moments.observations)
        words = (
            f"period-based ({periods} periods of {lengths[0]:.2f} s; HAC over deviations from the average, {lags} lags)"
        )
        return moments.sandwich(S) / max(share, np.finfo(float).tiny), words

    def _rows(self, o: Observation, beta: Array) -> int:
        """Rows per period."""
        rows = round(self.period_s * o.rate_Hz) if self.period_s is not None else find_period(o, beta)
        if self.period_s is not None and abs(rows - self.period_s * o.rate_Hz) > 0.02:
            raise ConfigError(
                f"A period of {self.period_s:g} s is {self.period_s * o.rate_Hz:.2f} rows at {o.rate_Hz:g} Hz; decimate"
                " to a rate that gives whole rows, or use the covariance hac."
            )
        if rows < 1 or o.t_s.size < MIN_PERIODS * rows or o.first[1:].any():
            raise IdentificationError(
                f"{o.source}: {o.t_s[-1] - o.t_s[0]:.1f} s in {int(o.first.sum())} gapless stretches hold fewer than"
                f" {MIN_PERIODS} whole periods of {rows / o.rate_Hz:.2f} s. Record more periods without gaps, or use"
                " the covariance hac."
            )
        return rows


NAMES = ("white", "hac", "period", "montecarlo")
HAC = Hac()


def named(name: str) -> Covariance:
    """Covariance of a name on the command line: one of `NAMES`, `period:SECONDS` or `montecarlo:DRAWS`.

    Raises:
        ConfigError: Unknown name or value.
    """
    kind, _, value = name.partition(":")
    try:
        if kind == "white" and not value:
            return White()
        if kind == "hac" and not value:
            return HAC
        if kind == "period":
            return Period(float(value) if value else None)
        if kind == "montecarlo":
            from ident.montecarlo import MonteCarlo

            return MonteCarlo(int(value)) if value else MonteCarlo()
    except ValueError as error:
        raise ConfigError(f"Covariance {name}: {value!r} is not a number.") from error
    raise ConfigError(
        f"Covariance {name} is unknown; choose from {', '.join(NAMES)}, period:SECONDS, montecarlo:DRAWS."
    )


def hac(observations: Sequence[Observation], beta: Array, sigma: Array, inverse: Array) -> tuple[Array, int]:
    """`Hac` of least squares with weights 1/sigma_j: covariance, shape (b, b), and number of lags.

    Args:
        inverse: inv(R) of the weighted triangle, A = inverse inverse', shape (b, b).
    """
    moments = Moments.weighted(observations, beta, sigma, inverse @ inverse.T)
    S, lags = long_run(_stretches(moments, moments.residuals))
    return moments.sandwich(S) * moments.inflation, lags


def long_run(stretches: Sequence[Array]) -> tuple[Array, int]:
    """Long-run covariance of score series, each of shape (n, b), summed over their instants, and the lags used."""
    total = sum(s.T @ s for s in stretches)
    square = np.maximum(np.diag(total), np.finfo(float).tiny)
    product = sum((s[1:] * s[:-1]).sum(axis=0) for s in stretches)
    root = np.clip(product / square, -LARGEST_ROOT, LARGEST_ROOT)
    white = [np.vstack([s[:1], s[1:] - root * s[:-1]]) for s in stretches]
    lags = _bandwidth(white)
    S = sum(_bartlett(s, lags) for s in white)
    recolour = 1 / (1 - root)
    return np.asarray(recolour[:, None] * S * recolour), lags


def _bartlett(scores: Array, lags: int) -> Array:
    S = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        product = scores[lag:].T @ scores[:-lag]
        S += (1 - lag / (lags + 1)) * (product + product.T)
    return np.asarray(S)


def _bandwidth(stretches: Sequence[Array]) -> int:
    """Andrews 1991 (Econometrica 59, 817-858), eq. (6.2) and (6.4), equal weights to every score."""
    square = sum((s**2).sum(axis=0) for s in stretches)
    square = np.maximum(square, np.finfo(float).tiny)
    a = np.clip(sum((s[1:] * s[:-1]).sum(axis=0) for s in stretches) / square, -LARGEST_ROOT, LARGEST_ROOT)
    curvature = np.sum(4 * a**2 / ((1 - a) ** 6 * (1 + a) ** 2)) / np.sum(1 / (1 - a) ** 4)
    instants = sum(len(s) for s in stretches)
    return int(1.1447 * float(np.cbrt(curvature * instants)))


def _stretches(moments: Moments, errors: Sequence[Array]) -> list[Array]:
    """Scores sum_j G_j' e_j of every gapless stretch, each of shape (n, b)."""
    out: list[Array] = []
    for o, G, e in zip(moments.observations, moments.G, errors, strict=True):
        scores = np.einsum("jn,jnb->nb", e, G)
        out += np.split(scores, np.flatnonzero(o.first)[1:])
    return out


def find_period(o: Observation, beta: Array) -> int:
    """Rows after which the predicted torques repeat.

    Raises:
        IdentificationError: They never do.
    """
    torque = o.predict(beta)
    size = float(np.sqrt(np.mean(torque**2)))
    lags = np.arange(1, o.t_s.size // 2 + 1)
    difference = np.array([np.sqrt(np.mean((torque[:, lag:] - torque[:, :-lag]) ** 2)) / size for lag in lags])
    left = int(np.argmax(difference > CHANGED))
    found = np.flatnonzero(difference[left:] < REPEATS)
    if difference[left] <= CHANGED or found.size == 0:
        raise IdentificationError(
            f"{o.source}: the torques do not repeat (at best to {100 * difference[left:].min():.0f} %, limit"
            f" {100 * REPEATS:.0f} %), so there is no period-based covariance. Use hac, or give period:SECONDS."
        )
    near = difference[left + found[0] :]
    bottom = int(np.argmax(np.diff(near) > 0)) if near.size > 1 and (np.diff(near) > 0).any() else 0
    return int(lags[left + found[0] + bottom])


def _deviations(residual: Array, used: NDArray[np.bool_], rows: int, count: int) -> Array:
    """Residuals less their mean over periods, scaled for the mean's own freedom; zero where fewer than two."""
    out = np.zeros_like(residual)
    shape = (residual.shape[0], count, rows)
    e, u = residual[:, : count * rows].reshape(shape), used[:, : count * rows].reshape(shape)
    n = u.sum(axis=1, keepdims=True)
    mean = (e * u).sum(axis=1, keepdims=True) / np.maximum(n, 1)
    scale = np.sqrt(n / np.maximum(n - 1, 1)) * (n > 1)
    out[:, : count * rows] = ((e - mean) * u * scale).reshape(shape[0], -1)
    return out
