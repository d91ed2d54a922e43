"""Programs of small arrays, compiled for speed where they run by themselves.

Rests on `sorojax._jax.small_kernels`, without which they are compiled as by `jax.jit`.
"""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax import _mappings
from sorojax._jax.small_kernels import (
    LARGEST_GIVEN,
    LARGEST_PRODUCT,
    OPTIONS,
    is_alone,
    one_kernel,
    runs_alone,
)

Verb = TypeVar("Verb", bound=Callable[..., Any])
Answer = TypeVar("Answer")

_mappings.watch()


def jit(function: Verb, *, kernels: bool = True, largest: float = LARGEST_GIVEN) -> Verb:
    """`function` compiled, as by `equinox.filter_jit`: for rods, networks and their gradients.

    On a CPU, loops over small arrays become one kernel each, which is up to two and a half
    times faster, where the installed jaxlib is one that was proven to compile them
    (`sorojax info`). Sine and cosine in them are polynomials (Cody and Waite, 1980): to 3e-16,
    of angles rounded to 1e-16 of their size. Inside `jit`, `vmap` or `grad` the function is
    part of the program around it, so wrap the outermost function: `sj.jit(jax.grad(cost))`.

    Args:
        function: Any function of arrays, pytrees and static values; arrays are traced, all
            else is static.
        kernels: Make kernels of loops. Long programs compile faster without.
        largest: Calls with arrays of more numbers than this are compiled as by `jax.jit`.

    Returns:
        A function of the same arguments.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> height = sj.jit(lambda q: rod.tip_pose(finger, q)[1, 2])
        >>> print(f"{float(height(jnp.array([10.0, 0.0, 0.0]))) / mm:.2f} mm")
        45.97 mm
    """
    inside = eqx.filter_jit(function)
    marked = one_kernel(function) if kernels else _unmarked(function)
    alone = eqx.filter_jit(marked, compiler_options=OPTIONS)

    def fits(*args: Any, **kwargs: Any) -> bool:
        return runs_alone(args, kwargs, largest=largest)

    return functools.wraps(function)(_alone_or_inside(alone, inside, fits))  # type: ignore[return-value]


def _alone_or_inside(
    alone: Callable[..., tuple[Answer, Any]],
    inside: Callable[..., Answer],
    fits: Callable[..., bool],
) -> Callable[..., Answer]:
    """Of two programs the first where it `fits` the arguments, and the compiler takes it."""
    refused = []

    def call(*args: Any, **kwargs: Any) -> Any:
        if not refused and fits(*args, **kwargs):
            try:
                return alone(*args, **kwargs)[0]
            except jax.errors.JaxRuntimeError as error:
                # the words may be the program's own: it must not run twice for them
                if not _is_refusal(error) or compiles(alone, *args, **kwargs):
                    raise
                refused.append(True)
        return inside(*args, **kwargs)

    return call


def by_itself(
    function: Callable[..., Answer],
    *,
    kernels: bool = True,
    largest: float = math.inf,
    largest_product: int = LARGEST_PRODUCT,
    optimised: bool = True,
) -> Callable[[list[Any], Any], Answer]:
    """`function` of a list of arrays, and of what is static, compiled as by `jit`; one that is
    not `optimised` compiles in a third of the time and runs some 1.5 times as long."""
    inside = jax.jit(function, static_argnums=1)
    marked = _unmarked(function)
    if kernels:
        marked = one_kernel(function, largest_product=largest_product)
    options = OPTIONS if optimised else {**OPTIONS, "xla_backend_optimization_level": 0}
    alone = jax.jit(marked, static_argnums=1, compiler_options=options)

    def fits(arrays: list[Any], _: Any) -> bool:
        return is_alone() if largest == math.inf else runs_alone(arrays, largest=largest)

    return _alone_or_inside(alone, inside, fits)


def once(function: Verb) -> Verb:
    """`function` compiled as by `equinox.filter_jit`, but faster: for programs that run a few
    times, of arrays of any size."""
    return jit(function, kernels=False, largest=math.inf)


def _unmarked(function: Callable[..., Any]) -> Callable[..., tuple[Any, None]]:
    @functools.wraps(function)
    def answer(*args: Any, **kwargs: Any) -> tuple[Any, None]:
        return function(*args, **kwargs), None

    return answer


class Compiled:
    """A program for arguments of one structure, from `compiled`."""

    def __init__(self, program: Callable[..., Any], examples: tuple[Any, ...]) -> None:
        self._program = program
        self._examples = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), examples
        )

    def __call__(self, *args: Any) -> Any:
        try:
            return self._program(*args)[0]
        except (OverflowError, TypeError):  # other kinds of numbers
            return self._program(*self._alike(args))[0]

    def _alike(self, args: tuple[Any, ...]) -> Any:
        wanted, found = jax.tree.structure(self._examples), jax.tree.structure(args)
        if wanted != found:
            raise ValueError(
                f"compiled: got arguments of the structure {found}, need {wanted}. Call it "
                "with arguments like the examples."
            )

        def one(leaf: Any, example: Any) -> Any:
            if np.shape(leaf) != example.shape:
                raise ValueError(
                    f"compiled: got an array of shape {np.shape(leaf)}, need {example.shape}. "
                    "Compile once more for other shapes."
                )
            return _exactly(leaf, example.dtype)

        return jax.tree.map(one, args, self._examples)


def _exactly(leaf: Any, dtype: Any) -> jax.Array:
    """`leaf` in the numbers of the example: rounded, never cut off or wrapped."""
    made = None
    with contextlib.suppress(OverflowError, TypeError):  # a Python int, what is no number
        if eqx.is_array_like(leaf) and np.can_cast(jnp.result_type(leaf), dtype, "same_kind"):
            made = jnp.asarray(leaf).astype(dtype)
    if made is None or (dtype.kind in "iu" and not np.array_equal(made, np.asarray(leaf))):
        raise ValueError(
            f"compiled: got {leaf!r}, need numbers that {dtype} holds, as the example does. "
            "Give such numbers, or compile with an example of that kind, as 1.0 instead of 1."
        )
    return made


def compiled(function: Callable[..., Any], *examples: Any) -> Compiled:
    """`function` compiled now, for arguments like `examples`: for loops in real time.

    A call costs some 10 us more than the work. What does not change from call to call is
    closed over, and made once.

    Args:
        function: Any function of arrays, or pytrees of them.
        *examples: Arguments; their values do not matter, their shapes and types do.

    Returns:
        A function of such arguments.

    Raises:
        TypeError: If there is more than numbers and arrays in `examples`.
        ValueError: When called with arguments of another structure or shape, or with numbers
            that those of the example cannot hold, as 2.7 where it was 1.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> height = sj.compiled(lambda q: rod.tip_pose(finger, q)[1, 2], jnp.zeros(3))
        >>> print(f"{float(height(jnp.array([10.0, 0.0, 0.0]))) / mm:.2f} mm")
        45.97 mm
    """
    for leaf in jax.tree.leaves(examples):
        if not eqx.is_array_like(leaf) or isinstance(leaf, bool | np.bool_):
            raise TypeError(
                f"compiled: got {leaf!r} among the arguments, need numbers and arrays. Close "
                "over all else."
            )
    examples = jax.tree.map(jnp.asarray, examples)
    if runs_alone():
        program = jax.jit(one_kernel(function), compiler_options=OPTIONS)
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # it does not run here
            return Compiled(program.lower(*examples).compile(), examples)
    plain = jax.jit(lambda *args: (function(*args), None))
    return Compiled(plain.lower(*examples).compile(), examples)


def _is_refusal(error: Exception) -> bool:
    """Whether it may be the compiler that cannot, by the words of its errors."""
    words = "UNIMPLEMENTED", "Unsupported", "No such compile option"
    return any(word in str(error) for word in words)


def compiles(program: Any, *args: Any, **kwargs: Any) -> bool:
    """Whether the compiler takes `program`: then an error was the program's own."""
    try:
        program.lower(*args, **kwargs).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
