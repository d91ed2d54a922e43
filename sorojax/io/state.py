"""States, motions and results in files: zips of plain arrays and a JSON header, bit for bit.

Nothing is executed on reading: classes are looked up among the data classes of the packages
below, nothing is imported by a name from a file, no constructor runs, functions are not
written at all, and every length in a file is checked before memory is taken.
"""

import dataclasses
import functools
import hashlib
import importlib
import inspect
import io
import json
import math
import os
import pkgutil
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.io import _files
from sorojax.math.linalg import sparse
from sorojax.math.status import Status

Arrays = dict[str, np.ndarray]
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class Damaged(ValueError):
    """Bytes that `write` did not write; the message says what is wrong with them."""


class TooLarge(ValueError):
    """More bytes than allowed; the message is their number."""


def write(file: BinaryIO, arrays: Arrays) -> None:
    """The arrays by name, not compressed, none of them pickled."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)


def read(content: bytes, max_bytes: int) -> Arrays:
    """The arrays of a file of `write`; sizes are compared before memory is taken.

    Raises:
        Damaged: If it is no such file, or another than was written.
        TooLarge: If it unpacks to more than `max_bytes`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > max_bytes:
                raise TooLarge(str(size))
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise Damaged("an entry is compressed")
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            if len(set(names)) < len(names):
                raise Damaged("two entries have one name")
            return {
                name: _array_of(archive.read(entry))
                for name, entry in zip(names, entries, strict=True)
            }
    except (Damaged, TooLarge):
        raise
    except Exception as error:  # zipfile and NumPy raise a dozen kinds at damaged bytes
        raise Damaged(str(error) or type(error).__name__) from error


def _array_of(data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise Damaged(f"an array of version {version}")
    shape, by_columns, dtype = _HEADERS[version](stream)
    body = memoryview(data)[stream.tell() :]
    if dtype.hasobject:
        raise Damaged("an array of objects")
    if math.prod(shape) * dtype.itemsize != len(body):
        raise Damaged(f"shape {shape} of {dtype} in {len(body)} bytes")
    order = "F" if by_columns else "C"
    return np.ndarray(shape, dtype, bytearray(body), order=order)


# What a saved tree is made of, as JSON: data classes of sorojax by name, and never code


_PACKAGES = (
    "contact", "coupling", "design", "envs", "fem", "material", "math", "mesh", "reduction",
    "robots", "rod", "sdf", "systems",
)  # fmt: skip
_FOREIGN = ("sorojax.envs.gym_adapter",)  # needs a package that need not be there; no data
_PLAIN = (type(None), bool, int, float, str)


class NotPlain(ValueError):
    """A value that cannot be written as JSON and arrays; the message names it."""


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
        for name in (f"{home[1]}.{own}", ".".join((*home[1:], own))):  # the short one first
            if _class(name) is cls:
                return name
    what = cls.__qualname__ if home == ["builtins"] else f"{cls.__module__}.{cls.__qualname__}"
    raise NotPlain(f"{f'`{place}`' if place else 'the tree'} is a {what}")


def _class(name: Any) -> type | None:
    """The data class of that name, `None` where sorojax has no such one."""
    package = str(name).partition(".")[0]
    return _data_classes(package).get(name) if package in _PACKAGES else None


@functools.cache
def _data_classes(package: str) -> dict[str, type]:
    """By the name of the package and their own, which a file can be read by when modules
    have moved; where several have that name, and none is public, by that of the module too."""
    home = importlib.import_module(f"sorojax.{package}")
    walked = pkgutil.walk_packages(home.__path__, f"{home.__name__}.")
    named: dict[str, list[type]] = {}
    found = {}
    modules = [entry.name for entry in walked if entry.name not in _FOREIGN]
    for module in map(importlib.import_module, modules):
        for own, value in vars(module).items():
            if _is_data(value, module.__name__, own):
                named.setdefault(f"{package}.{own}", []).append(value)
                found[f"{module.__name__}.{own}".removeprefix("sorojax.")] = value
    for name, classes in named.items():
        public = getattr(home, name.partition(".")[2], None)
        if len(classes) == 1 or public in classes:
            found[name] = public if public in classes else classes[0]
    return found


def _is_data(found: Any, module: str, own: str) -> bool:
    if not inspect.isclass(found) or inspect.isabstract(found):
        return False
    is_own = found.__module__ == module and found.__qualname__ == own
    return is_own and (issubclass(found, eqx.Module | eqx.Enumeration) or bool(_fields(found)))


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


# States, motions and results in files: every bit back, nothing executed


FORMAT = 1
_HEADER = "sorojax.json"
_EXTENDED = ("bfloat16", "float8_e4m3fn", "float8_e5m2")
_ABSENT = object()


def save(path: str | os.PathLike, tree: Any, *, root: str | os.PathLike | None = None) -> None:
    """Write any noun, state or result to a file.

    The file is a zip of plain arrays with a header of names, shapes, types and checksums, and
    of what they belong to: classes of sorojax, names and counts. It appears whole or not at
    all. Of a tree that holds functions, or classes from elsewhere, only the arrays are
    written; `load` needs `like` then.

    Args:
        path: File name, usually `*.npz`.
        tree: Any pytree; numbers are written in the units they have.
        root: Folder that the file must lie in; any by default.

    Returns:
        None.

    Raises:
        ValueError: If there is nothing that could be written, or the path leaves `root`.

    Example:
        >>> plate = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1))
        >>> io.save("plate.npz", plate)
        >>> io.load("plate.npz").num_cells
        8
    """
    target = _files.inside("io.save", path, root)
    numbers = _leaves(tree)
    try:
        structure, arrays = described(tree)
        others = {name: array for name, array in arrays.items() if name not in numbers}
    except NotPlain as why:
        if not numbers:
            raise ValueError(
                f"io.save: got a {type(tree).__name__} without arrays of its own ({why}), need "
                "arrays, or a noun or result of sorojax. Save its parts by name: {'y': ...}."
            ) from why
        structure, others = {"missing": str(why)}, {}
    kinds = {"leaf": _plain_all(numbers), "static": _plain_all(others)}
    header = {
        "format": FORMAT,
        "leaves": {name: _entry(array) for name, array in kinds["leaf"].items()},
        "statics": {name: _entry(array) for name, array in kinds["static"].items()},
        "structure": structure,
    }
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    packed = {_HEADER: text}
    for kind, named in kinds.items():
        packed |= {f"{kind}{k}": array for k, array in enumerate(named.values())}
    _files.write(target, lambda file: write(file, packed))


def load(
    path: str | os.PathLike,
    like: Any = None,
    *,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> Any:
    """Read what `save` wrote, without running any code from the file.

    Args:
        path: File name.
        like: A tree of the same structure; its numbers are replaced, the rest is kept. By
            default the tree is built as it was saved, without any constructor or function.
        root: Folder that the file must lie in; any by default.
        max_bytes: Larger files, and files that unpack to more, are refused.

    Returns:
        The tree, bit for bit.

    Raises:
        ValueError: If the file is damaged or newer than this version; without `like`, if it
            holds more than data of sorojax; or its names, shapes or types are not those of
            `like`.

    Example:
        >>> io.save("state.npz", {"q": jnp.array([0.5, 1.0])})
        >>> io.load("state.npz")["q"].tolist()
        [0.5, 1.0]
    """
    found = _read("io.load", path, root, max_bytes)
    if like is None:
        return found.tree(path)
    _need_same(path, found.leaves, _leaves(like))

    def put(where, leaf):
        if not eqx.is_array(leaf):
            return leaf
        return _like(found.leaves[jax.tree_util.keystr(where)], leaf)

    return jax.tree_util.tree_map_with_path(put, like)


def leaves(
    path: str | os.PathLike,
    *,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> dict[str, np.ndarray]:
    """The arrays of a file of `save` by name, to look into it without the noun.

    Args:
        path: File name.
        root: Folder that the file must lie in.
        max_bytes: Larger files, and files that unpack to more, are refused.

    Returns:
        Arrays by name.

    Raises:
        ValueError: If the file is damaged or newer than this version.
    """
    return _read("io.leaves", path, root, max_bytes).leaves


def _leaves(tree: Any) -> dict[str, Any]:
    pairs = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array))[0]
    return {jax.tree_util.keystr(where): leaf for where, leaf in pairs}


def _plain(leaf: Any) -> np.ndarray:
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _like(array: np.ndarray, leaf: Any) -> Any:
    if isinstance(leaf, np.ndarray):
        return array
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    return jnp.asarray(array)


def _plain_all(leaves: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: _plain(leaf) for name, leaf in leaves.items()}


def _entry(array: np.ndarray) -> dict[str, Any]:
    return {"shape": array.shape, "dtype": str(array.dtype), "sha256": _digest(array)}


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


class _Saved(NamedTuple):
    """The content of a file."""

    leaves: dict[str, np.ndarray]
    statics: dict[str, np.ndarray]
    structure: Any

    def tree(self, path) -> Any:
        why = self.structure.get("missing", "") if isinstance(self.structure, dict) else ""
        if self.structure is _ABSENT or why:
            raise ValueError(
                f"io.load: {path} has the arrays only ({why or 'an early version wrote it'}), "
                "need the structure as well. Give a tree of the same structure as `like`."
            )
        try:
            return built(self.structure, self.leaves | self.statics)
        except Damaged as why:
            raise _damaged("io.load", path, why) from why


def _read(where: str, path, root, max_bytes: int) -> _Saved:
    """The arrays by name, equal to their checksums."""
    target = _files.inside(where, path, root)
    content = _files.read(where, target, max_bytes)
    try:
        packed = read(content, max_bytes)
        header = _header(where, target, packed.pop(_HEADER, None))
        parts = [
            {
                name: _checked(name, packed.get(f"{kind}{k}"), entry)
                for k, (name, entry) in enumerate(header.get(group, {}).items())
            }
            for kind, group in (("leaf", "leaves"), ("static", "statics"))
        ]
    except TooLarge as size:
        raise ValueError(
            f"{where}: {target} unpacks to {size} bytes, the limit is {max_bytes}. Raise "
            "`max_bytes` if you trust it and have the memory."
        ) from None
    except Damaged as why:
        raise _damaged(where, target, why) from why
    return _Saved(*parts, header.get("structure", _ABSENT))


def _damaged(where: str, path, why: Exception) -> ValueError:
    return ValueError(
        f"{where}: {path} is damaged ({why}), need a file of io.save. Write it again."
    )


def _header(where: str, target, text: np.ndarray | None) -> dict[str, Any]:
    """The table of the arrays in the file."""
    try:
        header = json.loads(b"" if text is None else text.tobytes())
    except (ValueError, RecursionError) as error:
        raise Damaged(f"header: {error}") from error
    known = isinstance(header, dict) and all(
        isinstance(header.get(key, {} if key == "statics" else None), dict)
        for key in ("leaves", "statics")
    )
    version = header.get("format") if known else None
    if type(version) is not int:
        raise Damaged("no header of io.save")
    if version > FORMAT:
        raise ValueError(
            f"{where}: {target} has format {version}, this version reads up to {FORMAT}. "
            "Update sorojax."
        )
    return header


def _checked(name: str, array: np.ndarray | None, entry: Any) -> np.ndarray:
    if array is None or not isinstance(entry, dict):
        raise Damaged(f"`{name}` is missing")
    dtype = entry.get("dtype")
    if array.dtype.kind == "V" and dtype in _EXTENDED:  # of which NumPy keeps the bytes only
        array = array.view(jnp.dtype(dtype))
    same = str(array.dtype) == dtype and list(array.shape) == entry.get("shape")
    if not same or _digest(array) != entry.get("sha256"):
        raise Damaged(f"`{name}` differs from its checksum")
    return array


def _need_same(path, found: dict[str, np.ndarray], wanted: dict[str, Any]) -> None:
    missing, extra = wanted.keys() - found.keys(), found.keys() - wanted.keys()
    if missing or extra:
        raise ValueError(
            f"io.load: {path} holds {sorted(found)}, `like` needs {sorted(wanted)}. Give a "
            "tree of the structure that was saved."
        )
    for name, array in found.items():
        like = _plain(wanted[name])
        if array.shape != like.shape or array.dtype != like.dtype:
            raise ValueError(
                f"io.load: {path} holds `{name}` as {array.dtype} of shape {array.shape}, "
                f"`like` needs {like.dtype} of shape {like.shape}. Give a tree of the shapes "
                "and types that were saved."
            )
