"""Mathematics: groups, quadrature, small solves, steppers, sparse systems."""

from sorojax.math.lie import SE2 as SE2, SE3 as SE3
from sorojax.math.status import Status as Status
from sorojax.math.steppers import (
    DormandPrince as DormandPrince,
    GeneralisedAlpha as GeneralisedAlpha,
    RungeKutta4 as RungeKutta4,
)
