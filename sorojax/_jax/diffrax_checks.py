"""Runs of diffrax without its checks of arguments, for arguments that are right.

diffrax checks the instants at which to save by a call of the host, and JAX keeps no program
with such a call in its cache. Rests on the name `eqxi` in `diffrax._integrate`; without it
the checks stay, and adaptive runs are compiled in every process.
"""

import contextlib
import importlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

from sorojax._jax.optional import optional, reason

_NAME = "diffrax._integrate", "eqxi"
_internal = optional(*_NAME)
_left_out: ContextVar[bool] = ContextVar("left_out", default=False)


class _Internal:
    """`equinox.internal`, as diffrax sees it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_internal, name)

    def error_if(self, x: Any, *args: Any, **kwargs: Any) -> Any:
        return x if _left_out.get() else _internal.error_if(x, *args, **kwargs)


if _internal is not None:
    importlib.import_module(_NAME[0]).eqxi = _Internal()  # type: ignore[attr-defined]


@contextlib.contextmanager
def left_out() -> Iterator[None]:
    """What diffrax traces in this context has no checks of its arguments; checks within
    fields, events and controllers stay."""
    before = _left_out.set(True)
    try:
        yield
    finally:
        _left_out.reset(before)


def status() -> str:
    """Whether they can be left out, for `sorojax info`."""
    return "on" if _internal is not None else f"off: {reason(*_NAME)}"
