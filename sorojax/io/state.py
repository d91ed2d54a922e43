"""States, motions and results in files: every bit back, nothing executed."""

import hashlib
import json
import os
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.io import _archive, _files, _structure

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
        tree: Any pytree.
        root: Folder that the file must lie in.

    Raises:
        ValueError: If there is nothing that could be written.
    """
    target = _files.inside("io.save", path, root)
    numbers = _leaves(tree)
    try:
        structure, arrays = _structure.described(tree)
        others = {name: array for name, array in arrays.items() if name not in numbers}
    except _structure.NotPlain as why:
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
    _files.write(target, lambda file: _archive.write(file, packed))


def load(
    path: str | os.PathLike,
    like: Any = None,
    *,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> Any:
    """Read what `save` wrote.

    Args:
        path: File name.
        like: A tree of the same structure; its numbers are replaced, the rest is kept. If
            omitted the tree is built as it was saved, without any constructor or function.
        root: Folder that the file must lie in.
        max_bytes: Larger files, and files that unpack to more, are refused.

    Raises:
        ValueError: If the file is damaged or newer than this version; without `like`, if it
            holds more than data of sorojax; or its names, shapes or types are not those of
            `like`.

    Example:
        `io.save("s.npz", fem.solve(problem))`, later `view.show(io.load("s.npz"))`
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
    """What a file holds."""

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
            return _structure.built(self.structure, self.leaves | self.statics)
        except _archive.Damaged as why:
            raise _damaged("io.load", path, why) from why


def _read(where: str, path, root, max_bytes: int) -> _Saved:
    """The arrays by name, equal to their checksums."""
    target = _files.inside(where, path, root)
    content = _files.read(where, target, max_bytes)
    try:
        packed = _archive.read(content, max_bytes)
        header = _header(where, target, packed.pop(_HEADER, None))
        parts = [
            {
                name: _checked(name, packed.get(f"{kind}{k}"), entry)
                for k, (name, entry) in enumerate(header.get(group, {}).items())
            }
            for kind, group in (("leaf", "leaves"), ("static", "statics"))
        ]
    except _archive.TooLarge as size:
        raise ValueError(
            f"{where}: {target} unpacks to {size} bytes, the limit is {max_bytes}. Raise "
            "`max_bytes` if you trust it and have the memory."
        ) from None
    except _archive.Damaged as why:
        raise _damaged(where, target, why) from why
    return _Saved(*parts, header.get("structure", _ABSENT))


def _damaged(where: str, path, why: Exception) -> ValueError:
    return ValueError(
        f"{where}: {path} is damaged ({why}), need a file of io.save. Write it again."
    )


def _header(where: str, target, text: np.ndarray | None) -> dict[str, Any]:
    """What the file says of its arrays."""
    try:
        header = json.loads(b"" if text is None else text.tobytes())
    except (ValueError, RecursionError) as error:
        raise _archive.Damaged(f"header: {error}") from error
    known = isinstance(header, dict) and all(
        isinstance(header.get(key, {} if key == "statics" else None), dict)
        for key in ("leaves", "statics")
    )
    version = header.get("format") if known else None
    if type(version) is not int:
        raise _archive.Damaged("no header of io.save")
    if version > FORMAT:
        raise ValueError(
            f"{where}: {target} has format {version}, this version reads up to {FORMAT}. "
            "Update sorojax."
        )
    return header


def _checked(name: str, array: np.ndarray | None, entry: Any) -> np.ndarray:
    if array is None or not isinstance(entry, dict):
        raise _archive.Damaged(f"`{name}` is missing")
    dtype = entry.get("dtype")
    if array.dtype.kind == "V" and dtype in _EXTENDED:  # of which NumPy keeps the bytes only
        array = array.view(jnp.dtype(dtype))
    same = str(array.dtype) == dtype and list(array.shape) == entry.get("shape")
    if not same or _digest(array) != entry.get("sha256"):
        raise _archive.Damaged(f"`{name}` differs from its checksum")
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
