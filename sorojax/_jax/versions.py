"""Which versions of JAX sorojax runs on and was tested with. Imports no JAX."""

import importlib.util
import re
import sys
from importlib import metadata

OLDEST = "0.10.2"
TESTED = ("0.10.2", "0.12.0.1")
_COMMAND = f"pip install --upgrade 'jax>={OLDEST}'"


def check() -> None:
    """Look at the installed JAX without importing it.

    Raises:
        ImportError: If it is missing, too old, or older than its jaxlib.
    """
    if wrong := _wrong(installed("jax"), installed("jaxlib")):
        raise ImportError(f"sorojax: {wrong}. Install it: {_COMMAND}")


def installed(name: str) -> str | None:
    """The version of a package; `None` if there is none, "" if it is unknown."""
    if known := getattr(sys.modules.get(name), "__version__", None):
        return known  # a millisecond less than to read its files
    try:
        return metadata.version(name) or ""
    except metadata.PackageNotFoundError:
        return None if importlib.util.find_spec(name) is None else ""


def is_tested(jax: str) -> bool:
    """Whether this release of sorojax was tested with a version of JAX."""
    return _release(jax) in map(_release, TESTED)


def _wrong(jax: str | None, jaxlib: str | None) -> str | None:
    for name, version in (("jax", jax), ("jaxlib", jaxlib)):
        if version is None:
            return f"found no {name}, need jax {OLDEST} or newer with its jaxlib"
    own, lib = _release(jax or ""), _release(jaxlib or "")
    if own and own < _release(OLDEST):  # an unknown version is taken as it is
        return f"found jax {jax}, need jax {OLDEST} or newer"
    if own and own < lib:
        return f"found jaxlib {jaxlib} beside jax {jax}, need a jax as new"
    return None


def _release(version: str) -> tuple[int, ...]:
    """0.12.0.1 of "0.12.0.1", 0.12 of "0.12.0.dev20261101" and "0.12rc1", as numbers."""
    numbers = re.match(r"\d+(\.\d+)*", version)
    release = [int(number) for number in numbers[0].split(".")] if numbers else []
    while release and release[-1] == 0:
        release.pop()
    return tuple(release)
