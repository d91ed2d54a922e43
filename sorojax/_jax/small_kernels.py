"""Loops over small arrays as one kernel each.

On a CPU, XLA makes a kernel of every few operations and calls them one after another. Of a
loop over arrays of a few numbers that is most of the time. A call that is marked so XLA
makes one kernel of, loops and all; here every loop is marked whose arrays are small and
whose operations such a kernel can hold.

Only programs that run by themselves can be compiled so: inside `jit`, `vmap` or `grad` a
function is part of a program that belongs to others.

Rests on a mark and options of XLA's compiler for CPUs, on `set_xla_metadata`, and on the
programs of `jax.extend.core`. A jaxlib that is not among `PROVEN` gets the plain program.
"""

import contextvars
import functools
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.in_kernels import cholesky, cosine, lu, sine, sort, triangular_solve
from sorojax._jax.optional import every
from sorojax._jax.small_products import multiplications
from sorojax._jax.trace_state import is_tracer, outside_transformations
from sorojax._jax.versions import installed

#: Releases of jaxlib on which random programs agree with the plain ones (`make fuzz`).
PROVEN = ("0.10.2", "0.12.0.1")
LARGEST = 4096  # numbers in an array that is made inside a loop: some 32 kB
LARGEST_PASSED = 65536  # numbers in an array that a loop is given, or leaves
LARGEST_PRODUCT = 8192  # multiplications of a matrix product; beyond that a library is faster
LARGEST_SOLVED = 12  # unknowns of a factor: beyond that a library is faster
LONGEST = 4000  # operations in a loop: beyond that one kernel compiles slowly
LARGEST_GIVEN = 1024  # numbers in an argument: batches of states are no small arrays
MARK = {"xla_cpu_small_call": "true", "inlineable": "false"}
NO_MARK = {"xla_cpu_small_call": "false", "inlineable": "true"}  # of what a kernel calls
_JAXLIB = installed("jaxlib") or ""
# No kernel can hold products by that library.
OPTIONS: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": ""}
if _JAXLIB.startswith("0.10."):
    # They take longer to compile what is left, and gain nothing where arrays are small.
    OPTIONS["xla_cpu_use_fusion_emitters"] = False

_found, _status = every(
    ("jax.experimental.xla_metadata", "set_xla_metadata"),
    ("jax.core", "eval_jaxpr"),
    ("jax.extend.core", "Literal"),
    ("jax.extend.core", "Jaxpr"),
    ("jax.extend.core", "ClosedJaxpr"),
)

_NUMBER = "float32"
_KINDS = {
    np.dtype(kind)
    for kind in ("bool", "float32", "float64", "int32", "int64", "uint32", "uint64")
}
_LOOPS = {"scan", "while"}
_INLINED = {
    "checkpoint", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr", "custom_vmap_call", "jit", "pjit", "remat", "remat2",
}  # fmt: skip
_HOW = "left_side", "lower", "transpose_a", "unit_diagonal"
# In a kernel a library would be called for every entry.
_FAST = {"sin": sine, "cos": cosine}
# What solvers of diffrax ask for in batches, where there is none.
_ALONE: dict[str, Callable[..., Any]] = {
    "nonbatchable": lambda x: x, "nontraceable": lambda x: x, "unvmap_any": jnp.any,
    "unvmap_all": jnp.all, "unvmap_max": jnp.max, "select_if_vmap": lambda _, x, other: x,
}  # fmt: skip
_SOLVES = {"cholesky", "lu", "sort", "triangular_solve"}
_OTHER = {"while", *_FAST, *_ALONE, *_SOLVES}
_HELD = _LOOPS | _INLINED | _SOLVES | set(_ALONE) | {
    "abs", "acos", "acosh", "add", "add_any", "and", "argmax", "argmin", "asin", "asinh",
    "atan", "atan2", "atanh", "broadcast_in_dim", "cbrt", "ceil", "clamp", "concatenate",
    "cond", "convert_element_type", "copy", "copy_p", "cos", "cosh", "cumsum",
    "custom_linear_solve", "div", "dot_general", "dynamic_slice", "dynamic_update_slice", "eq",
    "eq_to", "erf", "erf_inv", "erfc", "exp", "exp2", "expand_dims", "expm1", "floor", "gather",
    "ge", "gt", "integer_pow", "iota", "is_finite", "le", "le_to", "log", "log1p", "logistic",
    "lt", "lt_to", "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pad",
    "platform_index", "pow", "reduce_and", "reduce_max", "reduce_min", "reduce_or",
    "reduce_prod", "reduce_sum", "rem", "reshape", "rev", "round", "rsqrt", "select_n", "sign",
    "sin", "sinh", "slice", "small_product", "split", "sqrt", "square", "squeeze", "stack",
    "stop_gradient", "sub", "tan", "tanh", "tile", "transpose", "unstack", "xor",
}  # fmt: skip

Answer = TypeVar("Answer")


_product = contextvars.ContextVar("largest_product", default=LARGEST_PRODUCT)


def one_kernel(
    function: Callable[..., Answer], *, largest_product: int = LARGEST_PRODUCT
) -> Callable[..., tuple[Answer, Any]]:
    """`function` with its small loops marked, to be compiled by itself with `OPTIONS`.

    Beside the answer it returns a number that no one needs, where it has kernels: they hand it
    on, and so none of them can do without its arguments.
    """

    @functools.wraps(function)
    def marked(*args: Any, **kwargs: Any) -> tuple[Answer, Any]:
        closed, shapes, rest = eqx.filter_make_jaxpr(function)(*args, **kwargs)
        arrays = jax.tree.leaves(eqx.filter((args, kwargs), eqx.is_array))
        known = [x for x in arrays if x.size and _is_number(x)]
        if not known:
            return function(*args, **kwargs), None
        reads = [known[0].reshape(-1)[0].astype(_NUMBER)]
        before = _product.set(largest_product)
        try:
            leaves = _run(closed.jaxpr, closed.consts, arrays, reads)
        finally:
            _product.reset(before)
        answer = eqx.combine(jax.tree.unflatten(jax.tree.structure(shapes), leaves), rest)
        return answer, reads[-1] if len(reads) > 1 else None

    return marked


def runs_alone(*args: Any, largest: float = LARGEST_GIVEN) -> bool:
    """Whether a call with `args` is a program by itself on a CPU, of arrays of at most
    `largest` numbers, and its kernels are proven."""
    if not is_alone():
        return False
    return not any(
        is_tracer(leaf) or getattr(leaf, "size", 0) > largest for leaf in jax.tree.leaves(args)
    )


def is_alone() -> bool:
    """Whether a program called here runs by itself on a CPU, and its kernels are proven."""
    if not _IS_PROVEN or not outside_transformations():
        return False
    return jax.default_backend() == "cpu" and jax.device_count() == 1


def status() -> str:
    """Whether loops become kernels, for `sorojax info`."""
    if _JAXLIB not in PROVEN:
        return f"off: not proven on jaxlib {_JAXLIB}, needs one of {', '.join(PROVEN)}"
    return _status


_IS_PROVEN = status() == "on"


def _run(jaxpr: Any, consts: Any, args: list[Any], reads: list[Any]) -> list[Any]:
    return _values(functools.partial(_outside, reads=reads), jaxpr, consts, args)


Evaluate = Callable[[list[Any]], list[Any]]


def _values(
    made_anew: Callable[[Any, Any], Evaluate | None], jaxpr: Any, consts: Any, args: list[Any]
) -> list[Any]:
    """What a program yields, equations in another way where `made_anew` tells one."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))
    as_they_are: list[Any] = []

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, _found["Literal"]) else values[atom]

    for equation in jaxpr.eqns:
        evaluate = made_anew(jaxpr, equation)
        if evaluate is None:
            as_they_are.append(equation)
            continue
        values.update(_bound(jaxpr, as_they_are, values))
        as_they_are.clear()
        found = evaluate([read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, found, strict=True))
    values.update(_bound(jaxpr, as_they_are, values))
    return [read(atom) for atom in jaxpr.outvars]


def _bound(jaxpr: Any, equations: list[Any], values: dict[Any, Any]) -> dict[Any, Any]:
    """What equations yield."""
    if not equations:
        return {}
    made = [var for each in equations for var in each.outvars]
    own = set(made)
    given = dict.fromkeys(
        var
        for each in equations
        for var in each.invars
        if not isinstance(var, _found["Literal"]) and var not in own
    )
    parts = {"eqns": [*equations], "outvars": made, "constvars": []}
    unnamed = jaxpr.debug_info._replace(arg_names=None, result_paths=None)
    alone = jaxpr.replace(invars=list(given), **parts, debug_info=unnamed)
    found = _found["eval_jaxpr"](alone, (), *(values[var] for var in given))
    return dict(zip(made, found, strict=True))


def _outside(jaxpr: Any, equation: Any, reads: list[Any]) -> Evaluate | None:
    """How to evaluate an equation outside of kernels."""
    name, inner = equation.primitive.name, _bodies(equation)
    if name in _LOOPS and _is_held(equation):
        whole = functools.partial(_equation_inside, jaxpr, equation)
        return lambda given: _in_one(whole, given, reads)
    if name in _INLINED and len(inner) == 1 and _holds(inner[0][0], _LOOPS):
        return lambda given: _run(*inner[0], given, reads)
    if name in _LOOPS and not _is_batched(equation) and _marks_within(equation):
        return lambda given: _with_kernels(equation, given, reads)
    return None


def _equation_inside(jaxpr: Any, equation: Any, given: list[Any]) -> list[Any]:
    """One equation in a kernel."""
    evaluate = _inside(jaxpr, equation)
    if evaluate is not None:
        return evaluate(given)
    pairs = zip(equation.invars, given, strict=True)
    values = {v: x for v, x in pairs if not isinstance(v, _found["Literal"])}
    found = _bound(jaxpr, [equation], values)
    return [found[var] for var in equation.outvars]


def _marks_within(loop: Any) -> bool:
    """Whether a loop that no kernel can hold has loops within that one can."""
    return any(
        each.primitive.name in _LOOPS and (_is_held(each) or _marks_within(each))
        for body, _ in _bodies(loop)
        for each in _inlined(body)
    )


def _inlined(jaxpr: Any) -> Iterator[Any]:
    """The equations, with those of the calls among them."""
    for each in jaxpr.eqns:
        inner = _bodies(each)
        if each.primitive.name in _INLINED and len(inner) == 1:
            yield from _inlined(inner[0][0])
        else:
            yield each


def _with_kernels(loop: Any, given: list[Any], reads: list[Any]) -> list[Any]:
    """A loop with kernels within; the number that they hand on goes from turn to turn."""
    params = loop.params

    def turn(body: Any, number: Any, args: list[Any]) -> tuple[Any, list[Any]]:
        inside = [number]
        found = _run(body.jaxpr, body.consts, args, inside)
        return inside[-1], found

    if loop.primitive.name == "scan":
        fixed, ends = _constants_and_carry(params)

        def step(carry: Any, row: Any) -> Any:
            args = [*given[:fixed], *carry[1], *row]
            number, found = turn(params["jaxpr"], carry[0], args)
            return (number, found[: ends - fixed]), found[ends - fixed :]

        how = {key: params[key] for key in ("length", "reverse", "unroll")}
        start = (reads[-1], given[fixed:ends])
        (number, carry), rows = jax.lax.scan(step, start, given[ends:], **how)
        reads.append(number)
        return [*carry, *rows]
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def goes_on(state: Any) -> Any:
        closed, args = params["cond_jaxpr"], [*given[:first], *state[1]]
        return _found["eval_jaxpr"](closed.jaxpr, closed.consts, *args)[0]

    def once(state: Any) -> Any:
        return turn(params["body_jaxpr"], state[0], [*given[first:second], *state[1]])

    number, carry = jax.lax.while_loop(goes_on, once, (reads[-1], given[second:]))
    reads.append(number)
    return carry


def _in_one(function: Callable[..., list[Any]], given: list[Any], reads: list[Any]) -> Any:
    """`function` of `given` in one call that is marked; constants stay constants.

    The compiler ends the process where a computation in such a call does not use its
    argument, and what is found to be constant is no argument any more. So there is one
    argument for each kind of number, and it begins with a number that no compiler can know.
    """
    kinds: dict[Any, list[int]] = {}
    for place, value in enumerate(given):
        if is_tracer(value):
            kinds.setdefault(value.dtype, []).append(place)
    if not kinds:
        return function(given)
    packs = [
        jnp.concatenate(
            [reads[-1].reshape(1).astype(kind), *(given[k].reshape(-1) for k in places)]
        )
        for kind, places in kinds.items()
    ]

    def marked(*packs: Any) -> Any:
        with _found["set_xla_metadata"](**NO_MARK):
            values = list(given)
            for pack, places in zip(packs, kinds.values(), strict=True):
                start = 1
                for k in places:
                    size, shape = given[k].size, given[k].shape
                    values[k] = jax.lax.slice(pack, (start,), (start + size,)).reshape(shape)
                    start += size
            first = [pack[:1].astype(_NUMBER) for pack in packs]
            return function(values), functools.reduce(jnp.maximum, first)[0]

    with _found["set_xla_metadata"](**MARK):
        found, number = jax.jit(marked)(*packs)
    reads.append(number)
    return found


def _inside(jaxpr: Any, equation: Any) -> Evaluate | None:
    """How to evaluate an equation in a kernel. Every loop counts: what forgets its state has no
    argument."""
    name, params, inner = equation.primitive.name, equation.params, _bodies(equation)
    if name in _FAST and equation.invars[0].aval.dtype == np.float64:
        return lambda given: [_FAST[name](given[0])]
    if name in _ALONE:
        return lambda given: [_ALONE[name](*given)]
    if name in _SOLVES:
        return lambda given: _solved(name, given, params)
    if name == "while":
        return lambda given: _counted(params, given)
    if not any(_holds(body, _OTHER) for body, _ in inner):
        return None  # a scan counts anyway
    if name == "scan":
        return lambda given: _scanned(params, given)
    if name == "custom_linear_solve":
        return lambda given: _linear_solution(params, given)
    if name in _INLINED and len(inner) == 1:
        return lambda given: _evaluate(_found["ClosedJaxpr"](*inner[0]), given)
    return None


def _scanned(params: Any, given: list[Any]) -> list[Any]:
    fixed, ends = _constants_and_carry(params)

    def step(carry: Any, row: Any) -> Any:
        found = _evaluate(params["jaxpr"], [*given[:fixed], *carry, *row])
        return found[: ends - fixed], found[ends - fixed :]

    how = {key: params[key] for key in ("length", "reverse", "unroll")}
    carry, rows = jax.lax.scan(step, given[fixed:ends], given[ends:], **how)
    return [*carry, *rows]


def _counted(params: Any, given: list[Any]) -> list[Any]:
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def goes_on(state: Any) -> Any:
        on = _evaluate(params["cond_jaxpr"], [*given[:first], *state[1]])[0]
        return on & (state[0] != 1)  # it is even

    def turn(state: Any) -> Any:
        new = _evaluate(params["body_jaxpr"], [*given[first:second], *state[1]])
        return state[0] + 2, new

    start = (jnp.zeros((), "uint32"), given[second:])
    return jax.lax.while_loop(goes_on, turn, start)[1]


def _solved(name: str, given: list[Any], params: Any) -> list[Any]:
    if name == "cholesky":
        return [cholesky(*given)]
    if name == "lu":
        return [*lu(*given)]
    if name == "sort":
        return sort(*given)
    how = {key: params[key] for key in _HOW}
    return [triangular_solve(*given, **how)]


def _linear_solution(params: Any, given: list[Any]) -> list[Any]:
    """By its solver, as it has no derivative any more."""
    counts, solver = params["const_lengths"], params["jaxprs"].solve
    start = counts.matvec + counts.vecmat
    constants = given[start : start + counts.solve]
    return _evaluate(solver, [*constants, *given[sum(counts) :]])


def _constants_and_carry(params: Any) -> tuple[int, int]:
    """Where the constants of a scan end among its arguments, and where its carry does."""
    if "ft_in" in params:  # since jax 0.11
        constants, carry, _ = params["ft_in"].unpack()
        return len(constants), len(constants) + len(carry)
    return params["num_consts"], params["num_consts"] + params["num_carry"]


def _evaluate(closed: Any, args: list[Any]) -> list[Any]:
    return _values(_inside, closed.jaxpr, closed.consts, args)


def _is_small(equation: Any) -> bool:
    """Whether a kernel can hold what an equation does, and should."""
    name, inner = equation.primitive.name, _bodies(equation)
    if name not in _HELD or equation.effects:
        return False
    # A branch may leave an argument unused; a batched condition is a loop of its own kind.
    if name == "cond" and equation.params.get("branches_platforms") is None:
        return False
    if _is_batched(equation):
        return False
    if name in _SOLVES and not _is_small_solve(equation):
        return False
    if name == "dot_general" and _multiplications(equation) > _product.get():
        return False
    if not all(_is_number(var.aval) for var in (*equation.invars, *equation.outvars)):
        return False
    if name not in _LOOPS | _INLINED and any(_holds(jaxpr, _LOOPS) for jaxpr, _ in inner):
        return False
    return all(
        all(getattr(var.aval, "size", 0) <= LARGEST for var in each.outvars) and _is_small(each)
        for jaxpr, _ in inner
        for each in jaxpr.eqns
    )


def _is_small_solve(equation: Any) -> bool:
    given = [var.aval for var in equation.invars]
    if not all(0 < size <= LARGEST_SOLVED for size in given[0].shape):
        return False
    if equation.primitive.name == "sort":
        one_key = equation.params["num_keys"] == 1 and given[0].dtype.kind == "i"
        return one_key and all(x.ndim == 1 for x in given)
    square = given[0].shape[:1] == given[0].shape[1:]
    return square and all(x.ndim == 2 and x.dtype.kind == "f" for x in given)


def _is_held(loop: Any) -> bool:
    """Whether one kernel can hold a loop."""
    return _passes_few(loop) and _is_small(loop)


def _is_batched(loop: Any) -> bool:
    """Whether it is a loop whose condition has one value for each lane."""
    if loop.primitive.name != "while":
        return False
    return bool(loop.params["cond_jaxpr"].out_avals[0].shape)


def _passes_few(loop: Any) -> bool:
    passed = (*loop.invars, *loop.outvars)
    few = all(getattr(var.aval, "size", 0) <= LARGEST_PASSED for var in passed)
    return few and _length(loop) <= LONGEST


def _holds(jaxpr: Any, names: set[str]) -> bool:
    return any(
        equation.primitive.name in names
        or any(_holds(body, names) for body, _ in _bodies(equation))
        for equation in jaxpr.eqns
    )


def _is_number(array: Any) -> bool:
    return getattr(array, "dtype", None) in _KINDS


def _multiplications(product: Any) -> int:
    shapes = (var.aval for var in product.invars)
    return multiplications(*shapes, product.params["dimension_numbers"])


def _length(equation: Any) -> int:
    inside = [inner for jaxpr, _ in _bodies(equation) for inner in jaxpr.eqns]
    return len(inside) + sum(map(_length, inside))


def _bodies(equation: Any) -> list[tuple[Any, Any]]:
    """The programs inside an equation, with their constants."""
    found, params = [], equation.params
    if equation.primitive.name == "custom_linear_solve":  # what runs: it has no derivative more
        params = {"solve": params["jaxprs"].solve}
    leaves = jax.tree.leaves(
        list(params.values()),
        is_leaf=lambda x: isinstance(x, (_found["Jaxpr"], _found["ClosedJaxpr"])),
    )
    for leaf in leaves:
        if isinstance(leaf, _found["ClosedJaxpr"]):
            found.append((leaf.jaxpr, leaf.consts))
        elif isinstance(leaf, _found["Jaxpr"]):
            found.append((leaf, ()))
    return found
