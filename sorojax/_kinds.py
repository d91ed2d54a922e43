"""Kinds of arguments: the tests of values that annotations ask for."""

import collections.abc
import dataclasses
import functools
import inspect
import numbers
import os
import pathlib
import types
import typing
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np

from sorojax._types import Numbers, integers, optional_real, real

Test = Callable[[Any], bool]


@dataclasses.dataclass(frozen=True, eq=False)
class Kind:
    """A kind of argument: its test, what it is called, and types that pass whatever they hold.

    Attributes:
        need: What is needed, as it stands in a sentence.
        noun: The class, where it is one.
        item: The kind of the members, where it is a tuple of them.
        dims: Names or lengths of the axes of an array, where they are given.
        is_whole: Whether an array holds whole numbers, as those of nodes.
        always: Classes whose objects pass.
        seen: Types and shapes of arrays that passed.
    """

    test: Test
    need: str
    noun: type | None = None
    item: "Kind | None" = None
    dims: tuple[str, ...] | None = None
    is_whole: bool = False
    always: set[type] = dataclasses.field(default_factory=set)
    seen: set[Any] = dataclasses.field(default_factory=set, init=False)

    def accepts(self, value: Any) -> bool:
        """Whether `value` passes. Of arrays type and shape decide, of nouns the class: what
        passed once is not tested again."""
        kind = type(value)
        if kind in self.always:
            return True
        if kind not in _ARRAYS:
            passes = self.test(value)
            if passes and isinstance(value, eqx.Module):
                self.always.add(kind)
            return passes
        key = value.dtype, value.shape
        if key in self.seen:
            return True
        passes = self.test(value)
        if passes and len(self.seen) < _REMEMBERED:
            self.seen.add(key)
        return passes

    def or_none(self) -> "Kind":
        if self.test(None):
            return self
        return dataclasses.replace(
            self, test=lambda value: value is None or self.test(value), always={type(None)}
        )


_WITH_NOUNS = "sorojax", "equinox", "diffrax", "optax", "numpy"
_REMEMBERED = 256
_ARRAYS: set[type] = set()  # classes that were met: `isinstance` of `jax.Array` is slow


def _is_array(value: Any) -> bool:
    if type(value) in _ARRAYS:
        return True
    found = isinstance(value, jax.Array | np.ndarray | np.generic)
    if found:
        _ARRAYS.add(type(value))
    return found


def rank(value: Any) -> int | None:
    """Number of axes of what can become an array of real numbers, else `None`."""
    if _is_array(value):
        return value.ndim if _real(value.dtype) else None
    if isinstance(value, numbers.Real):
        return 0
    if isinstance(value, list | tuple | range):
        if all(type(item) in (float, int) for item in value):
            return 1
        ranks = {rank(item) for item in value}
        rows = [item for item in value if isinstance(item, list | tuple) or _is_array(item)]
        lengths = {
            np.shape(row)[0] if _is_array(row) and np.ndim(row) else _length(row)
            for row in rows
        }
        if len(ranks) > 1 or None in ranks or len(lengths) > 1:
            return None  # no numbers, or rows of different lengths
        return 1 + next(iter(ranks), 0)  # type: ignore[operator]
    if hasattr(value, "__array__") or hasattr(value, "__jax_array__"):
        return len(np.shape(value))
    if isinstance(value, jax.ShapeDtypeStruct):
        return len(value.shape)
    return None


def _length(row: Any) -> int:
    return len(row) if isinstance(row, list | tuple) else 0


def _shape(value: Any) -> tuple[int, ...]:
    try:
        return np.shape(value)
    except ValueError:  # rows of different lengths
        return ()


def _real(dtype: Any) -> bool:
    return getattr(dtype, "kind", "?") in "fiub" or jnp.issubdtype(dtype, jnp.floating)


def number_like(value: Any) -> bool:
    return rank(value) is not None


def whole(value: Any) -> bool:
    """Whether `value` holds whole numbers only, as far as its type tells."""
    if _is_array(value):
        return getattr(value.dtype, "kind", "?") in "iub" or value.size == 0
    if isinstance(value, list | tuple | range):
        return all(whole(item) for item in value[:8])
    return isinstance(value, numbers.Integral) or hasattr(value, "__array__")


PUBLIC: dict[type, str] = {}  # what the packages loaded so far make public

ANYTHING = Kind(lambda value: True, "anything")
NUMBERS = Kind(number_like, "a number or an array of numbers")
_ROWS = Kind(lambda value: (rank(value) or 0) > 0, "an array of numbers")
_ARRAY = Kind(lambda value: number_like(value) or _is_array(value), "an array")
_NUMBER = Kind(lambda value: rank(value) == 0, "a number", dims=())
_WHOLE = Kind(
    lambda value: rank(value) == 0 and whole(value), "a whole number", dims=(), always={int}
)
_SWITCH = Kind(lambda value: rank(value) == 0, "True or False", always={bool})
_TEXT = Kind(lambda value: isinstance(value, str), "a string", always={str})
_NOTHING = Kind(lambda value: value is None, "None", always={type(None)})
_FUNCTION = Kind(callable, "a function", always={types.FunctionType})
_PATH = Kind(lambda value: isinstance(value, str | os.PathLike), "a path", always={str})
_SIMPLE: dict[Any, Kind] = {
    float: _NUMBER, int: _WHOLE, bool: _SWITCH, str: _TEXT, None: _NOTHING,
    type(None): _NOTHING, os.PathLike: _PATH, pathlib.Path: _PATH,
    jax.Array: _ARRAY, np.ndarray: _ROWS, Numbers: NUMBERS,
}  # fmt: skip


def kind_of(annotation: Any, scope: dict[str, Any], loose: bool = False) -> Kind:
    """The kind that an annotation asks for; what it cannot read asks for nothing.

    Args:
        annotation: As written, a string too.
        scope: Names that a string may use.
        loose: Leave the shapes of arrays to the one who uses them: constructors keep what
            may be a batch.
    """
    inner = functools.partial(kind_of, scope=scope, loose=loose)
    if isinstance(annotation, str | typing.ForwardRef):
        text = annotation if isinstance(annotation, str) else annotation.__forward_arg__
        try:
            return inner(eval(text, dict(scope)))  # the module's own annotation
        except NameError:  # a class that is imported for type checkers only
            found = [noun for noun in PUBLIC if noun.__name__ == text]
            return inner(found[0]) if len(found) == 1 else _called(text)
    if isinstance(annotation, typing.TypeVar):
        bounds = annotation.__constraints__ or (annotation.__bound__ or Any,)
        return _any_of([inner(each) for each in bounds])
    if annotation in _SIMPLE:
        return _SIMPLE[annotation]
    if isinstance(annotation, type) and issubclass(annotation, jaxtyping.AbstractArray):
        return _array(annotation, loose)
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _any_of([inner(arg) for arg in args])
    if origin is typing.Literal:
        words = [repr(arg) for arg in args]
        need = " or ".join(words) if len(words) < 3 else "one of " + ", ".join(words)
        return Kind(lambda value: value in args if isinstance(value, str) else False, need)
    if origin is type:
        return Kind(lambda value: isinstance(value, type), f"a class, as {_name(args[0])}")
    if origin is tuple and len(args) == 2 and args[1] is Ellipsis:
        return _several(inner(args[0]), loose)
    if origin is tuple or annotation is tuple:
        return _row([inner(arg) for arg in args], loose)
    if origin in (collections.abc.Sequence, collections.abc.Iterable, list):
        return _several(inner(args[0]), loose, iterable=origin is collections.abc.Iterable)
    if origin in (dict, collections.abc.Mapping) or annotation in (dict,):
        return _mapping(inner(args[1]) if args else ANYTHING)
    if origin is collections.abc.Callable or annotation is collections.abc.Callable:
        known = bool(args) and isinstance(args[0], list)
        return _function(len(args[0])) if known else _FUNCTION
    noun = origin if isinstance(origin, type) else annotation
    if isinstance(noun, type) and noun.__module__.partition(".")[0] in _WITH_NOUNS:
        return Kind(lambda value: isinstance(value, noun), _name(noun), noun)
    return ANYTHING


def _any_of(kinds: list[Kind]) -> Kind:
    if ANYTHING in kinds:
        return ANYTHING
    spoken = [kind for kind in kinds if kind is not _NOTHING] or kinds
    need = " or ".join(dict.fromkeys(kind.need for kind in spoken))
    always = set().union(*(kind.always for kind in kinds))
    nouns = [kind.noun for kind in spoken if kind.noun]
    items = [kind.item for kind in spoken if kind.item]
    return Kind(
        lambda value: any(kind.accepts(value) for kind in kinds),
        need,
        nouns[0] if nouns else None,
        items[0] if items else None,
        spoken[0].dims if len(spoken) == 1 else None,
        spoken[0].is_whole,
        always,
    )


def _function(count: int) -> Kind:
    """A function of `count` arguments; only nouns that can be called are asked for theirs."""

    def test(value: Any) -> bool:
        if not callable(value) or not isinstance(value, eqx.Module):
            return callable(value)
        as_function: Any = value
        try:
            inspect.signature(as_function).bind(*(None,) * count)
        except TypeError:
            return False
        return True

    need = f"a function of {count} argument{'s' * (count != 1)}"
    return Kind(test, need, always={types.FunctionType})


def _called(name: str) -> Kind:
    """Of a class that is not imported, by its name."""
    if not name.isidentifier():
        return ANYTHING
    return Kind(
        lambda value: any(kind.__name__ == name for kind in type(value).__mro__), f"a {name}"
    )


def _row(items: list[Kind], loose: bool) -> Kind:
    """A tuple of known length, each of its own kind; none for any tuple. `loose` leaves the
    length to the one who uses it."""

    def test(value: Any) -> bool:
        if _is_array(value):
            return np.shape(value)[:1] == (len(items),)
        if not isinstance(value, list | tuple) or not (loose or len(value) == len(items)):
            return False
        return all(kind.accepts(each) for kind, each in zip(items, value, strict=False))

    if not items:
        return Kind(lambda value: isinstance(value, list | tuple), "a tuple")
    needs = [item.need for item in items]
    each = f"each {needs[0]}" if len(set(needs)) == 1 else ", ".join(needs)
    return Kind(test, f"a tuple of {len(items)}, {each}")


def _several(item: Kind, loose: bool, iterable: bool = False) -> Kind:
    need = f"a tuple of {_plural(item.need)}" if item is not ANYTHING else "a tuple"
    of_arrays = not loose and item.noun is None and item.accepts(0)  # else an array is static

    def test(value: Any) -> bool:
        if isinstance(value, list | tuple):
            return all(map(item.accepts, value))
        if isinstance(value, str | bytes):
            return False
        if _is_array(value):
            return np.ndim(value) > 0 and (of_arrays or item is ANYTHING) and number_like(value)
        many = collections.abc.Iterable if iterable else collections.abc.Sequence
        return isinstance(value, many)

    return Kind(test, need, item=item)


def _mapping(item: Kind) -> Kind:
    need = "a dict" if item is ANYTHING else f"a dict of {_plural(item.need)}"

    def test(value: Any) -> bool:
        if not isinstance(value, collections.abc.Mapping):
            return False
        return item.noun is None or all(map(item.accepts, value.values()))

    return Kind(test, need)


def _array(annotation: Any, loose: bool) -> Kind:
    dims = tuple(annotation.dim_str.split())
    if any("key" in str(each) for each in annotation.dtypes):
        return Kind(_is_array, "a random key, as jax.random.key(0)")
    is_whole = all("int" in str(each) for each in annotation.dtypes)
    open_ended = loose or any(dim.startswith(("*", "...")) for dim in dims)
    fixed = {i: int(dim) for i, dim in enumerate(dims) if dim.isdigit()}
    least = sum(not dim.startswith(("*", "...")) for dim in dims) if not loose else 0

    def test(value: Any) -> bool:
        found = rank(value)
        if found is None or (is_whole and not whole(value)):
            return False
        if found < least or (not open_ended and found != len(dims)):
            return is_whole and 0 in _shape(value)  # none of them, as ()
        if not fixed or open_ended:
            return True
        shape = _shape(value) or (0,) * len(dims)
        return all(shape[axis] == length for axis, length in fixed.items())

    what = "whole numbers" if is_whole else "numbers"
    if not dims:
        return Kind(test, "a whole number" if is_whole else "a number", dims=dims)
    need = f"an array of {what} of shape ({', '.join(dims)}{',' * (len(dims) == 1)})"
    need = f"an array of {what}" if loose else need
    return Kind(test, need, dims=dims, is_whole=is_whole)


def converted(annotation: Any, converter: Callable[[Any], Any], scope: dict[str, Any]) -> Kind:
    """The kind that a field takes whose constructor converts what it is given."""
    if converter is real:
        return NUMBERS
    if converter is optional_real:
        return NUMBERS.or_none()
    if converter is integers:
        return Kind(lambda value: number_like(value) and whole(value), "whole numbers")
    kind = kind_of(annotation, scope, loose=True)

    def test(value: Any) -> bool:
        if kind is not ANYTHING and kind.accepts(value):
            return True
        try:
            made = converter(value)
        except (ArithmeticError, AttributeError, LookupError, TypeError):
            return False
        except ValueError as error:
            return _is_spoken(error)  # the converter itself says what is wrong
        return kind.accepts(made)

    return dataclasses.replace(kind, test=test, always=set())


def _is_spoken(error: Exception) -> bool:
    frames = list(inspect.getinnerframes(error.__traceback__)) if error.__traceback__ else []
    return bool(frames and frames[-1].code_context and "raise" in frames[-1].code_context[0])


def _plural(need: str) -> str:
    article, _, bare = need.partition(" ")
    bare = bare if article in ("a", "an") else need
    return {"number": "numbers", "string": "strings", "whole number": "whole numbers"}.get(
        bare, bare.replace(" or a ", " or ").replace(" or an ", " or ")
    )


def _name(noun: Any) -> str:
    name = getattr(noun, "__name__", str(noun))
    article = "an" if name[0] in "AEIO" else "a"
    return f"{article} {name}"
