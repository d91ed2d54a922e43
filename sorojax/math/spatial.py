"""SciPy's neighbour searches and triangulations, imported at first use: importing them costs
as much as the rest of the package."""

from typing import Any

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "points dim"]


def KDTree(points: Points) -> Any:
    """Nearest neighbours among `points`, `scipy.spatial.KDTree`."""
    import scipy.spatial

    return scipy.spatial.KDTree(points)


def Delaunay(points: Points) -> Any:
    """Delaunay triangulation, `scipy.spatial.Delaunay`."""
    import scipy.spatial

    return scipy.spatial.Delaunay(points)


def Voronoi(points: Points) -> Any:
    """Voronoi diagram, `scipy.spatial.Voronoi`."""
    import scipy.spatial

    return scipy.spatial.Voronoi(points)
