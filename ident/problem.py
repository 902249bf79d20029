"""What an estimator is given, and what it must be: one contract for every method."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ident.base import Base
from ident.dataset import Dataset, Signals
from ident.estimate import Estimate, joint_triangles
from ident.model import Model
from ident.observation import Observation, observe

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """Recordings in every stage of their preparation; index i is the same recording everywhere.

    Attributes:
        model: Nominal robot and its standard parameters.
        base: Parameters to estimate.
        signals: As measured, with the reference where it is known.
        datasets: Filtered, at the full rate.
        observations: Rows of Y = W beta.
        decimate_to_Hz, speed_threshold: With which `observe` made the rows.
    """

    model: Model
    base: Base
    signals: Sequence[Signals]
    datasets: Sequence[Dataset]
    observations: Sequence[Observation]
    decimate_to_Hz: float
    speed_threshold: float | None

    @cached_property
    def triangles(self) -> list[Array]:
        """R of QR([W_j y_j]) of every joint: all that least squares needs, see `ident.estimate`."""
        return joint_triangles(self.observations)

    def observe(self, dataset: Dataset) -> Observation:
        """Rows of another dataset by the same settings: on the grid of its original where it has the same times."""
        return observe(dataset, self.model, self.base, self.decimate_to_Hz, self.speed_threshold)


class Estimator(Protocol):
    """One method. Pure: the same problem gives the same estimate, and is not changed."""

    @property
    def name(self) -> str:
        """In the literature."""
        ...

    def fit(self, problem: Problem) -> Estimate:
        """Estimate of the base parameters.

        Raises:
            IdentificationError: The data do not determine them, or the method failed; says what to do.
        """
        ...
