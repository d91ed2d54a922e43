"""Progress from inside compiled programs, told to the listener of the framework."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
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
