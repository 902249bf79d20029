"""Exact Coulomb friction: speeds after a step whose dry friction acts at the step's end.

Each row of B is one speed with dry friction (a joint, a motor, a brake); its impulse is within plus or minus its
bound, opposes the speed, and takes any value between as long as the speed is zero (Moreau 1988; Anitescu & Potra
1997). So a joint below its Coulomb torque does not creep, as it would with a smoothed sign function.
"""

import numpy as np

from emulator.kernels import Floats, compiled

AT_REST = 1e-10  # rad/s, largest change of a speed in the last sweep; an encoder count at that speed takes hours
SWEEPS = 500  # reached only where many rows stick at once and the mass matrix couples them strongly


@compiled
def factor(A: Floats) -> bool:
    """Cholesky factor in the lower triangle of A, in place; False where A is not positive definite.

    Its diagonal holds the reciprocals, which `solve` multiplies with: divisions were a tenth of a simulated step.
    """
    for j in range(len(A)):
        for i in range(j, len(A)):
            value = A[i, j]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                A[j, j] = 1.0 / np.sqrt(value)
            else:
                A[i, j] = value * A[j, j]
    return True


@compiled
def solve(L: Floats, x: Floats) -> None:
    """x = inv(L L') x, in place, L being from `factor`."""
    n = len(x)
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] *= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] *= L[i, i]


@compiled
def rub(L: Floats, B: Floats, bound: Floats, v: Floats, impulse: Floats, X: Floats) -> int:
    """Adds the dry friction impulses to the speeds v, in place, by projected Gauss-Seidel.

    Args:
        L: The mass matrix (with implicit viscous friction) from `factor`, shape (J, J).
        B: Rows of speeds with friction, shape (K, J).
        bound: Largest impulse of each row, shape (K,) [N·m·s].
        v: Speeds without dry friction, shape (J,) [rad/s].
        impulse: Impulses of the step before, where the search starts, shape (K,); overwritten.
        X: Scratch, shape (K, J).

    Returns:
        Sweeps needed.
    """
    K, J = B.shape
    mobility = np.empty(K)
    for k in range(K):
        impulse[k] = min(max(impulse[k], -bound[k]), bound[k])
        if bound[k] > 0.0:
            X[k, :] = B[k]
            solve(L, X[k])
            mobility[k] = 0.0
            for j in range(J):
                v[j] += X[k, j] * impulse[k]
                mobility[k] += X[k, j] * B[k, j]
    for sweep in range(SWEEPS):
        worst = 0.0
        for k in range(K):
            if bound[k] == 0.0:
                continue
            speed = 0.0
            for j in range(J):
                speed += B[k, j] * v[j]
            value = min(max(impulse[k] - speed / mobility[k], -bound[k]), bound[k])
            change = value - impulse[k]
            if change != 0.0:
                impulse[k] = value
                worst = max(worst, abs(change) * mobility[k])
                for j in range(J):
                    v[j] += X[k, j] * change
        if worst < AT_REST:
            return sweep + 1
    return SWEEPS
