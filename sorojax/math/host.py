"""Work on the host beside compiled programs: progress messages, threads, and SciPy's neighbour
searches and triangulations, which are imported at first use.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.host_call import tell_host
from sorojax._progress import report


def tell(label: str, share: Float[Array, ""]) -> None:
    """Report that `share` of the call `label` is done; of lanes that run at once their
    mean, in one report."""
    share = mean_of_lanes(jax.lax.stop_gradient(share))
    tell_host(lambda x: report(label, float(x), 1.0), share)


def _over_lanes(reduce: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The number itself, under `vmap` one number of all lanes."""

    @jax.custom_batching.custom_vmap
    def over(x: Any) -> Any:
        return x

    @over.def_vmap
    def _(axis_size, in_batched, x):
        del axis_size
        return (over(reduce(x)) if in_batched[0] else x), False

    return over


mean_of_lanes = _over_lanes(lambda x: jnp.mean(x, axis=0))
any_of_lanes = _over_lanes(lambda x: jnp.any(x, axis=0))
largest_of_lanes = _over_lanes(lambda x: jnp.max(x, axis=0))


@jax.custom_batching.custom_vmap
def true_alone(condition: Any) -> Any:
    """A condition that is true, a constant, unless there are lanes, each with its own."""
    return jnp.ones_like(condition)


@true_alone.def_vmap
def _(axis_size, in_batched, condition):
    del axis_size
    return (condition, True) if in_batched[0] else (true_alone(condition), False)


# Independent work of the host at the same time: compilers and BLAS leave Python to others


def together(*works: Callable[[], Any]) -> list[Any]:
    """Results of `works`, functions of concrete numbers, each in a thread of its own.

    Precision and default device of the caller hold in all of them.
    """
    first, *rest = works
    x64, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # type: ignore

    def alike(work: Callable[[], Any]) -> Any:
        with jax.enable_x64(x64), jax.default_device(device):
            return work()

    with ThreadPoolExecutor(max(1, len(rest))) as pool:
        others = [pool.submit(alike, work) for work in rest]
        return [first(), *(other.result() for other in others)]


# SciPy's neighbour searches and triangulations, imported at first use


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
