"""The methods by the names of the command line. A new one is a class with `name` and `fit`, and a line here and in
`protocols.messages.Method`."""

from collections.abc import Mapping

from ident.cloe import Cloe
from ident.didim import Didim
from ident.ekf import ExtendedKalman
from ident.estimate import LeastSquares
from ident.irls import IterativelyReweighted
from ident.iv import IdimIv
from ident.ml import MaximumLikelihood
from ident.problem import Estimator
from ident.setmembership import SetMembership
from ident.tls import TotalLeastSquares

METHODS: Mapping[str, Estimator] = {
    "ols": LeastSquares(weighted=False),
    "wls": LeastSquares(weighted=True),
    "iv": IdimIv(),
    "didim": Didim(),
    "cloe": Cloe(),
    "irls": IterativelyReweighted(),
    "tls": TotalLeastSquares(),
    "ml": MaximumLikelihood(),
    "ekf": ExtendedKalman(),
    "setmembership": SetMembership(),
}
