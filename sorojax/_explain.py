"""Error messages about arguments of a wrong kind, in the form got - need - do."""

import functools
import inspect
import linecache
import sys
import sysconfig
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.trace_state import is_tracer
from sorojax._kinds import PUBLIC, Kind, number_like, rank

if TYPE_CHECKING:
    from sorojax._arguments import Parameters

RAW = AttributeError, LookupError, TypeError, ValueError, jax.errors.JAXTypeError
_HOW = {
    "one of ": "Choose one of them.",
    "' or '": "Choose one of them.",
    "a function": "Give one, as `lambda x: ...`.",
    "a path": "Give the name of a file.",
    "a string": "Write it in quotes.",
    "a dict": "Give one by name: `{name: value}`.",
    "True or False": "Set it or leave it out.",
    "a class": "Give the class itself, without making an object of it.",
    "a random key": "Make one by jax.random.key(0).",
}
_NEEDS_NUMBERS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)


def refusal(where: str, name: str, kind: Kind, value: Any) -> Exception:
    """The error for `value` as the argument `name` of `where`."""
    text = f"{where}: got {got(value)} for `{name}`, need {kind.need}. {_do(kind, name, value)}"
    is_shape = kind.dims is not None and number_like(value)
    counted = kind.need.removeprefix("a tuple of ")[:1].isdigit()
    is_shape = is_shape or (isinstance(value, list | tuple) and counted)
    is_choice = isinstance(value, str) and kind.need.startswith(("one of ", "'"))
    return ValueError(text) if is_shape or is_choice else TypeError(text)


def got(value: Any) -> str:
    """`value` in a few words."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return f"the string {value[:40]!r}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__name__', '')!r}"
    if inspect.ismodule(value):
        return f"the module {value.__name__}"
    if is_tracer(value) or isinstance(value, jax.Array | np.ndarray | np.generic):
        return f"{value.dtype} of shape {value.shape}"
    if isinstance(value, list | tuple) and value:
        return f"a {type(value).__name__} of {len(value)}, the first {got(value[0])}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def _do(kind: Kind, name: str, value: Any) -> str:
    noun = kind.noun or (kind.item and kind.item.noun)
    if kind.item is not None and kind.item.accepts(value) and not isinstance(value, str):
        return f"Put it in a tuple: `({name},)`, with the comma."
    if isinstance(value, type) and noun and issubclass(value, noun):
        return f"Make one: {value.__name__}(...)."
    if inspect.isroutine(value):
        if noun is not None and "__call__" in getattr(noun, "__abstractmethods__", ()):
            own = f"class Mine({noun.__name__})"
            return f"{made_by(noun)} For a function of yours write {own} with __call__."
        return "Call it, and give what it returns."
    if "whole number" in kind.need and not number_like(value) and kind.dims != ():
        return (
            "Nodes and facets come from a mesh, as by `mesh.facets_on(mesh, shape)` or, by "
            "name, `mesh.named(mesh, name)`."
        )
    if noun is not None:
        return made_by(noun)
    if "whole number" in kind.need:
        return "Give it as an int or an array of ints."
    if kind.dims and rank(value) is not None:
        return "For several of them, `jax.vmap` the call."
    if "number" in kind.need:
        return "Give a number, a list or an array, in SI units."
    for words, how in _HOW.items():
        if words in kind.need:
            return how
    return "Its documentation, by `help`, tells what it is for."


def made_by(noun: type) -> str:
    """How to come by an object of a public class."""
    if noun.__name__.startswith("Abstract"):
        heirs = [name for each, name in PUBLIC.items() if issubclass(each, noun)]
        some = [name for name in heirs if "Abstract" not in name][:3]
        return f"Give {', '.join(some)} or another." if some else "Write a subclass of it."
    own = PUBLIC.get(noun)
    makers = sorted(_makers(noun), key=lambda name: (len(name), name))[:2]
    if makers:
        return f"Make it by {' or '.join(makers)}."
    return f"Make it by {own}(...)." if own else f"See help({noun.__module__})."


def _makers(noun: type) -> tuple[str, ...]:
    return _makers_among(noun, len(PUBLIC))


@functools.lru_cache(maxsize=1024)
def _makers_among(noun: type, loaded: int) -> tuple[str, ...]:
    """Public functions that return `noun` and do not take one."""
    found = []
    for name in {public.partition(".")[0] for public in PUBLIC.values()}:
        module = sys.modules.get(f"sorojax.{name}")
        for verb, function in vars(module).items() if module else ():
            parameters = getattr(function, "__arguments__", None)
            if parameters is None or inspect.isclass(function) or verb.startswith("_"):
                continue
            back = parameters.signature.return_annotation
            takes = any(kind.noun is noun for kind in parameters.kinds.values())
            if not takes and (back is noun or getattr(back, "__origin__", None) is noun):
                found.append(f"{name}.{verb}")
    return tuple(found)


def unbound(
    parameters: "Parameters", args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Exception | None:
    """The error for too many arguments, too few, or one of another name."""
    try:
        parameters.signature.bind(*args, **kwargs)
    except TypeError as error:
        all_of_them = parameters.signature.parameters.values()
        names = ", ".join(str(each).partition(":")[0] for each in all_of_them)
        verb = parameters.where.rpartition(".")[2]
        return TypeError(
            f"{parameters.where}: got {len(args) + len(kwargs)} arguments: {error}. Need "
            f"{verb}({names})."
        )
    return None


def explained(
    parameters: "Parameters", args: tuple[Any, ...], kwargs: Mapping[str, Any], error: Exception
) -> Exception | None:
    """A better error for one that arose deep inside, where the arguments are its cause.

    `None` where the framework itself raised it, or a user's own function did.
    """
    if (wrong := unbound(parameters, args, kwargs)) is not None:
        return wrong
    if not _is_raw(error.__traceback__):
        return None
    where = parameters.where
    bound = parameters.signature.bind(*args, **kwargs).arguments
    if isinstance(error, _NEEDS_NUMBERS):
        place = _traced_place(bound)
        return TypeError(
            f"{where}: got traced values{place} inside `jit`, `grad` or `vmap`, need known "
            f"ones: sizes depend on them. Call {where} outside, and set numbers of what it "
            "returns inside, by `sj.replace`."
        )
    kinds = parameters.kinds
    return wrong_numbers(where, kinds, bound) or misfit(where, kinds, bound)


LENGTHS: dict[type, Callable[[Any], Mapping[str, int]]] = {}


def axis_lengths(noun: type) -> Callable[[Any], Any]:
    """Register the lengths of named axes that objects of `noun` fix for arrays with them."""

    def register(lengths: Callable[[Any], Mapping[str, int]]) -> Any:
        LENGTHS[noun] = lengths
        return lengths

    return register


#: What numbers in arrays of such rows count.
COUNTED = {"nodes": "nodes", "facets": "nodes", "n": "nodes", "cells": "cells", "kept": "cells"}

_counted: list[Any] = [None, 0]  # the last array of numbers that was looked through, its bound


def counts(value: Any, count: int | None) -> bool:
    """Whether all numbers in `value` are those of `count` things; so, where it is traced."""
    if count is None or (value is _counted[0] and count == _counted[1]):
        return True
    if is_tracer(value) or 0 in np.shape(value):
        return True
    numbers = np.asarray(value)
    fits = numbers.dtype.kind not in "iu" or (numbers.min() >= 0 and numbers.max() < count)
    if fits:
        _counted[:] = value, count
    return bool(fits)


def misfit(where: str, kinds: Mapping[str, Kind], bound: Mapping[str, Any]) -> Exception | None:
    """The error for numbers of nodes or cells that are not there, as JAX would take others, or
    for arrays whose axes of one name differ in length, if any do."""
    sizes: dict[str, Any] = {}
    for value in bound.values():
        if (lengths := LENGTHS.get(type(value))) is not None:
            sizes.update(lengths(value))
    for name, value in bound.items():
        dims = kinds[name].dims if name in kinds else None
        if not dims or value is None or rank(value) is None:
            continue
        if kinds[name].is_whole:
            count = sizes.get(COUNTED.get(dims[0], ""))
            if not counts(value, count):
                return ValueError(
                    f"{where}: got numbers {np.min(value)} to {np.max(value)} in `{name}`, "
                    f"need 0 to {(count or 0) - 1}. Take them from this mesh."
                )
            continue
        for dim, length in _axes(dims, np.shape(value)):
            if (need := sizes.setdefault(dim, length)) != length:
                return ValueError(
                    f"{where}: got {got(value)} for `{name}`, need {need} along its axis "
                    f"{dim!r}, as the other arguments have. Give arrays that belong together."
                )
    return None


def _axes(dims: tuple[str, ...], shape: tuple[int, ...]) -> list[tuple[str, Any]]:
    """Names of axes with their lengths; of `*several` all of theirs."""
    if not dims[0].startswith("*"):
        named = zip(dims, shape, strict=False)
        return [(dim, length) for dim, length in named if dim.isidentifier()]
    count = len(shape) - len(dims) + 1
    return [(dims[0], shape[:count]), *_axes(dims[1:], shape[count:])] if dims[1:] else []


def wrong_numbers(
    where: str, kinds: Mapping[str, Kind], bound: Mapping[str, Any]
) -> Exception | None:
    """The error for what looks like an array of the right kind and is none: lists, whole
    numbers, another precision than that of the other arguments."""
    leaves = [leaf for leaf in jax.tree.leaves(dict(bound)) if hasattr(leaf, "dtype")]
    floating = [leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    usual = max(floating, key=floating.count, default=jnp.result_type(float))
    for name, value in bound.items():
        kind = kinds.get(name)
        if kind is None or not kind.dims or rank(value) is None:
            continue
        is_open = any(dim.startswith(("*", "...")) for dim in kind.dims)
        if not is_open and rank(value) != len(kind.dims):
            return ValueError(
                f"{where}: got {got(value)} for `{name}`, need {kind.need}. "
                "Give one row for each."
            )
        if isinstance(value, list | tuple | range):
            made = "np.array(..., int)" if kind.is_whole else "jnp.array"
            return TypeError(
                f"{where}: got {got(value)} for `{name}`, need {kind.need}. Make one by {made}."
            )
        if not kind.is_whole and getattr(value, "dtype", usual) != usual:
            return TypeError(
                f"{where}: got {got(value)} for `{name}`, need {usual} as in the other "
                f"arguments. Convert it: `{name}.astype({usual.name!r})`."
            )
    return None


def _is_raw(traceback: TracebackType | None) -> bool:
    """Whether no `raise` of the framework, and no function of the user, is the last word."""
    last = "", "", 0
    while traceback is not None:
        frame = traceback.tb_frame
        module = frame.f_globals.get("__name__", "")
        ours = module.startswith("sorojax.") and module != "sorojax._arguments"
        file = frame.f_code.co_filename
        if ours or not (module.startswith("sorojax.") or file.startswith(_installed())):
            last = module, file, traceback.tb_lineno
        traceback = traceback.tb_next
    if not last[0].startswith("sorojax."):
        return False
    return not linecache.getline(last[1], last[2]).strip().startswith("raise ")


@functools.cache
def _installed() -> tuple[str, ...]:
    places = {sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")}
    return (*places, "<frozen ")


def _traced_place(bound: Mapping[str, Any]) -> str:
    """Where traced leaves are among the arguments: whole numbers, if there are any."""
    leaves = jax.tree_util.tree_leaves_with_path(dict(bound))
    traced = [(path, leaf) for path, leaf in leaves if is_tracer(leaf)]
    whole = [(path, leaf) for path, leaf in traced if leaf.dtype.kind in "iu"]
    for (first, *rest), _ in whole or traced:
        return f" (`{first.key}{jax.tree_util.keystr(tuple(rest))}`)"
    return ""
