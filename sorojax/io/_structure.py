"""What a saved tree is made of, as JSON: data classes of sorojax by name, and never code.

A class is looked up among those that the packages below define for data: nothing is
imported by a name from a file, no constructor runs, and functions are not written at all.
"""

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.io._archive import Arrays, Damaged
from sorojax.math import sparse
from sorojax.math.status import Status

_PACKAGES = (
    "contact", "design", "fem", "material", "math", "mesh", "reduction", "robots", "rod", "sdf",
    "systems",
)  # fmt: skip
_PLAIN = (type(None), bool, int, float, str)


class NotPlain(ValueError):
    """What cannot be written as JSON and arrays; the message names it."""


def described(tree: Any) -> tuple[Any, dict[str, Any]]:
    """The tree as JSON, and its arrays by their place, those of static fields as well.

    Raises:
        NotPlain: If it holds a function, or a class that is not one of sorojax's for data.
    """
    arrays: dict[str, Any] = {}
    return _described(tree, "", arrays), arrays


def _described(value: Any, place: str, arrays: dict[str, Any]) -> Any:
    if type(value) in _PLAIN:
        return value
    if eqx.is_array(value):
        if value.dtype == object:
            raise NotPlain(f"`{place}` is an array of objects")
        arrays[place] = value
        return {"array": place, "as": _kind(value)}
    if type(value) in (tuple, list):
        return {
            type(value).__name__: [
                _described(item, f"{place}[{k}]", arrays) for k, item in enumerate(value)
            ]
        }
    if type(value) is dict:
        pairs = [[key, _described(v, f"{place}[{key!r}]", arrays)] for key, v in value.items()]
        if all(type(key) in _PLAIN for key, _ in pairs):
            return {"dict": pairs}
    if isinstance(value, type(Status.successful)):
        inner = _described(value._value, f"{place}._value", arrays)
        return {"outcome": _name(value._enumeration, place), "value": inner}
    parts = {k: v for k, v in _fields(type(value), value).items() if k != _solver(type(value))}
    return {
        "class": _name(type(value), place),
        "fields": {k: _described(v, f"{place}.{k}", arrays) for k, v in parts.items()},
    }


def _kind(array: Any) -> str:
    if isinstance(array, np.generic):
        return "number"
    if isinstance(array, np.ndarray):
        return "numpy"
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return f"key {jax.random.key_impl(array)}"
    return "jax"


def _solver(cls: type) -> str:
    """The field that is made again, not written."""
    return "_kept" if cls is sparse.SparseSymmetric else ""


def _fields(cls: type, value: Any = None) -> dict[str, Any]:
    if issubclass(cls, tuple):
        names = getattr(cls, "_fields", ())
    else:
        names = (
            [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
        )
    return {name: getattr(value, name, None) for name in names}


def _name(cls: type, place: str) -> str:
    home = cls.__module__.split(".")
    if home[0] == "sorojax" and len(home) > 1:
        own = cls.__qualname__
        for name in (f"{home[1]}.{own}", ".".join((*home[1:], own))):  # a public one first
            if _class(name) is cls:
                return name
    what = cls.__qualname__ if home == ["builtins"] else f"{cls.__module__}.{cls.__qualname__}"
    raise NotPlain(f"{f'`{place}`' if place else 'the tree'} is a {what}")


def _class(name: Any) -> type | None:
    """The data class of that name, `None` where sorojax has no such one."""
    package, *inner, own = str(name).split(".") if "." in str(name) else ("", "")
    if package not in _PACKAGES:
        return None
    importlib.import_module(f"sorojax.{package}")
    module = sys.modules.get(".".join(("sorojax", package, *inner)))
    found = vars(module).get(own) if module is not None else None
    if not inspect.isclass(found) or inspect.isabstract(found):
        return None
    is_own = found.__module__.startswith(f"sorojax.{package}.") and found.__qualname__ == own
    is_data = issubclass(found, eqx.Module | eqx.Enumeration) or bool(_fields(found))
    return found if is_own and is_data else None


def built(node: Any, arrays: Arrays) -> Any:
    """The tree that was described, of the arrays that came with it.

    Raises:
        Damaged: If `node` is not what `described` writes, or of another version.
    """
    unused = dict(arrays)
    try:
        tree = _built(node, unused)
    except RecursionError as error:
        raise Damaged("nested too deep") from error
    if unused:
        raise Damaged(f"{min(unused)} belongs nowhere")
    return tree


def _built(node: Any, arrays: Arrays) -> Any:
    if type(node) in _PLAIN:
        return node
    for kind, make in _MAKERS.items():
        if type(node) is dict and kind in node:
            return make(node, arrays)
    raise Damaged(f"no structure: {str(node)[:40]}")


def _array(node: dict, arrays: Arrays) -> Any:
    name, kind = node["array"], str(node.get("as"))
    if type(name) is not str or name not in arrays:
        raise Damaged(f"no array {str(name)[:40]}")  # each is used once, however large
    array = arrays.pop(name)
    if kind == "number" and array.ndim == 0:
        return array[()]
    if kind == "numpy":
        return array
    if kind.startswith("key "):
        try:
            return jax.random.wrap_key_data(jnp.asarray(array), impl=kind[4:])
        except Exception as error:  # JAX has several for what is no key
            raise Damaged(f"{name}: {error}") from error
    if kind != "jax":
        raise Damaged(f"no array {name}: {kind[:40]}")
    made = jnp.asarray(array)
    if made.dtype != array.dtype:
        raise ValueError(
            f"io.load: `{name}` is {array.dtype}, need double precision to keep its digits. "
            'Call jax.config.update("jax_enable_x64", True) first.'
        )
    return made


def _sequence(node: dict, arrays: Arrays) -> Any:
    kind, items = next(iter(node.items()))
    if type(items) is not list:
        raise Damaged(f"a {kind} of {str(items)[:40]}")
    made = [_built(item, arrays) for item in items]
    return tuple(made) if kind == "tuple" else made


def _dict(node: dict, arrays: Arrays) -> dict:
    pairs = node["dict"]
    if type(pairs) is not list or not all(
        type(pair) is list and len(pair) == 2 and type(pair[0]) in _PLAIN for pair in pairs
    ):
        raise Damaged(f"a dict of {str(pairs)[:40]}")
    return {key: _built(item, arrays) for key, item in pairs}


def _outcome(node: dict, arrays: Arrays) -> Any:
    enumeration, value = _class(node["outcome"]), _built(node.get("value"), arrays)
    if enumeration is None or not issubclass(enumeration, eqx.Enumeration):
        raise Damaged(f"no outcome {str(node['outcome'])[:40]}")
    numbers = np.asarray(value) if eqx.is_array(value) else np.full(1, -1)
    inside = (numbers >= 0) & (numbers < len(enumeration))
    if numbers.dtype.kind != "i" or not inside.all():
        raise Damaged(f"no {enumeration.__name__}: {value}")
    return _with(type(Status.successful), {"_value": value, "_enumeration": enumeration})


def _instance(node: dict, arrays: Arrays) -> Any:
    cls, fields = _class(node["class"]), node.get("fields")
    if cls is None or issubclass(cls, eqx.Enumeration):
        raise Damaged(f"{str(node['class'])[:60]} is no data class of sorojax")
    needed = _fields(cls).keys() - {_solver(cls)}
    if type(fields) is not dict or fields.keys() != needed:
        raise Damaged(f"{node['class']} of this version has the fields {sorted(needed)}")
    values = {name: _built(part, arrays) for name, part in fields.items()}
    if cls is not sparse.SparseSymmetric:
        return _with(cls, values)
    try:
        return sparse.from_pattern(**values)
    except ValueError as error:
        raise Damaged(str(error)) from error


def _with(cls: type, values: dict[str, Any]) -> Any:
    """An instance without its constructor, which may compute."""
    if issubclass(cls, tuple):
        return tuple.__new__(cls, [values[name] for name in _fields(cls)])
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


_MAKERS: dict[str, Callable[[dict, Arrays], Any]] = {
    "array": _array, "tuple": _sequence, "list": _sequence, "dict": _dict, "outcome": _outcome,
    "class": _instance,
}  # fmt: skip
