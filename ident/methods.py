"""The methods by the names of the command line. A new one is a class with `name` and `fit`, and a line here and in
`protocols.messages.Method`."""

from collections.abc import Mapping

from ident.estimate import LeastSquares
from ident.iv import IdimIv
from ident.problem import Estimator

METHODS: Mapping[str, Estimator] = {
    "ols": LeastSquares(weighted=False),
    "wls": LeastSquares(weighted=True),
    "iv": IdimIv(),
}
