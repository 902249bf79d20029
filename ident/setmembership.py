"""Set membership: every parameter vector that explains all rows within known error bounds (Ramdani & Poignet 2005).

The comparison that Janot et al. 2014 name in their introduction. No distribution of errors is assumed, only
|y - W beta| <= e in every row; the set is a polytope and its exact bounds are linear programs. What comes out are
guaranteed intervals, as wide as the bound is honest: one row outside empties the set.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, refuse_deficient
from ident.observation import Observation
from ident.problem import Problem
from ident.system import triangle
from protocols.errors import ConfigError, IdentificationError

Array = NDArray[np.float64]

MARGIN = 1.2  # of the smallest error bound that leaves any solution, where no bound is given
FIRST_ROWS = 400  # in the first program; more are added where they are violated
ADDED_ROWS = 100
FEASIBLE = 1e-7  # of the bound
UNIFORM = np.sqrt(3)  # half-width over standard deviation of a uniform distribution


@dataclass(frozen=True)
class SetMembership:
    """Bounds of every parameter over the feasible set; the estimate is their middle.

    Attributes:
        bound_Nm: Largest error of every joint's rows; None for 1.2 times the smallest that leave a solution, which
            guarantees nothing but shows what the method can do.
    """

    bound_Nm: tuple[float, ...] | None = None

    @property
    def name(self) -> str:
        return "set membership"

    def fit(self, problem: Problem) -> Estimate:
        """Two linear programs per parameter.

        Raises:
            IdentificationError: The motion does not show some base parameters, or the bounds leave no solution.
            ConfigError: Not one bound per joint.
        """
        observations, base = problem.observations, problem.base
        joints = len(observations[0].joints)
        if self.bound_Nm is not None and (len(self.bound_Nm) != joints or min(self.bound_Nm) <= 0):
            raise ConfigError(f"Set membership needs {joints} positive error bounds [N·m], not {self.bound_Nm}.")
        refuse_deficient(triangle(problem.triangles)[:, :-1], base, observations)
        sigma = joint_sigma(problem.triangles, joint_rows(observations))
        unit = sigma if self.bound_Nm is None else np.array(self.bound_Nm)
        polytope = _Polytope(*_stack(observations, unit))
        smallest, _ = polytope.minimax()
        if self.bound_Nm is not None and smallest > 1:
            raise IdentificationError(
                f"No parameters explain every row within the error bounds; they would have to be {smallest:.2f} times"
                " as large. Give larger bounds, or look for rows outside with irls."
            )
        factor = 1.0 if self.bound_Nm is not None else MARGIN * smallest
        low, high = polytope.bounds(factor)
        bounds = ", ".join(f"{n} {v:.3g}" for n, v in zip(observations[0].joints, factor * unit, strict=True))
        half = (high - low) / 2
        covariance = np.diag((half / UNIFORM) ** 2)
        return assemble(
            observations,
            base,
            self.name,
            (low + high) / 2,
            covariance=covariance,
            covariance_name="half-width of the feasible interval / sqrt(3), as of a uniform distribution",
            white=covariance,
            sigma_Nm=sigma,
            triangles=problem.triangles,
            notes=[
                f"Error bounds [N·m]: {bounds}"
                + ("." if self.bound_Nm else ", from the data: intervals without guarantee.")
            ],
        )


def _stack(observations: Sequence[Observation], unit: Array) -> tuple[Array, Array]:
    """Rows divided by their bound, and the torques so divided."""
    W = np.vstack([o.W[j, o.used[j]] / e for o in observations for j, e in enumerate(unit)])
    y = np.concatenate([o.y[j, o.used[j]] / e for o in observations for j, e in enumerate(unit)])
    return W, y


class _Polytope:
    """|y - W beta| <= t with linear programs over it; rows join a program when they are violated."""

    def __init__(self, W: Array, y: Array) -> None:
        self.scale = np.linalg.norm(W, axis=0) / np.sqrt(len(W))
        self.W, self.y = W / self.scale, y
        start = np.linalg.lstsq(self.W, y, rcond=None)[0]
        self.rows = np.argsort(-np.abs(y - self.W @ start))[: max(FIRST_ROWS, 4 * W.shape[1])]

    def minimax(self) -> tuple[float, Array]:
        """Smallest t with a solution, and that solution (scaled)."""
        b = self.W.shape[1]
        cost = np.append(np.zeros(b), 1.0)
        while True:
            W, y = self.W[self.rows], self.y[self.rows]
            one = np.ones((len(y), 1))
            x = _program(
                cost, np.block([[W, -one], [-W, -one]]), np.concatenate([y, -y]), [(None, None)] * b + [(0, None)]
            )
            if not self._add(x[:b], x[b] * (1 + FEASIBLE) + FEASIBLE):
                return float(np.abs(self.y - self.W @ x[:b]).max()), x[:b]

    def bounds(self, t: float) -> tuple[Array, Array]:
        """Smallest and largest value of every parameter for errors up to t, shape (b,) each."""
        b = self.W.shape[1]
        out = np.empty((2, b))
        for i in range(b):
            for k, sign in enumerate((1.0, -1.0)):
                cost = np.zeros(b)
                cost[i] = sign
                while True:
                    W, y = self.W[self.rows], self.y[self.rows]
                    x = _program(cost, np.vstack([W, -W]), np.concatenate([y + t, t - y]), [(None, None)] * b)
                    if not self._add(x, t * (1 + FEASIBLE)):
                        break
                out[k, i] = x[i] / self.scale[i]
        return out[0], out[1]

    def _add(self, x: Array, t: float) -> bool:
        """Let the rows violated most join; False where there are none."""
        excess = np.abs(self.y - self.W @ x) - t
        excess[self.rows] = 0.0
        worst = np.argsort(-excess)[:ADDED_ROWS]
        worst = worst[excess[worst] > 0]
        self.rows = np.concatenate([self.rows, worst])
        return bool(worst.size)


def _program(cost: Array, A: Array, limit: Array, bounds: list[tuple[float | None, float | None]]) -> Array:
    result = optimize.linprog(cost, A_ub=A, b_ub=limit, bounds=bounds, method="highs-ds")
    if result.x is None:
        raise IdentificationError(
            f"The linear program of the feasible set has no answer ({result.message.strip()}). Give larger"
            " error bounds."
        )
    return np.asarray(result.x)
