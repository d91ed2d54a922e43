"""An accelerator that is asked for or installed and does not work: the CPU and one warning.

Rests on the wording of what JAX logs of a plug-in that cannot be loaded, without which its
traceback is shown too, on `jax.extend.backend.clear_backends`, and on
`jax._src.xla_bridge._plugins_registered`, without which a plug-in whose import raises stops
the CPU as well.
"""

import contextlib
import importlib.util
import logging
import os
import pkgutil
import re
import warnings
from collections.abc import Iterator
from importlib import metadata

import jax

from sorojax._jax.optional import optional

_BY_PLUG_IN = ("gpu", "cuda", "rocm", "oneapi")
_LOGGER = "jax._src.xla_bridge"
_DO = (
    "For an accelerator install a plug-in that fits (NVIDIA: pip install --upgrade "
    "'jax[cuda13]'), without one set JAX_PLATFORMS=cpu."
)


def leave_out_absent() -> None:
    """Take accelerators out of `jax_platforms` if no plug-in of JAX is installed at all.

    JAX would look for them at its first array only, and end there with an error. This starts
    nothing and, where no accelerator is named, looks at nothing else.
    """
    asked = _asked()
    absent = [name for name in asked.split(",") if name in _BY_PLUG_IN]
    if absent and not _any_plug_in():
        left = ",".join(name for name in asked.split(",") if name not in absent) or "cpu"
        jax.config.update("jax_platforms", left)
        _warn(f"JAX_PLATFORMS={asked}", "no plug-in of JAX is installed", left)


def start(failed: Exception | None = None) -> bool:
    """Start JAX; where a plug-in fails, on what works and with one warning.

    Args:
        failed: What the first use of JAX ended with, if this is the second: then JAX may leave
            the plug-in out by itself, and says nothing.

    Returns:
        Whether a plug-in failed.
    """
    asked, said = _asked(), []
    with _errors_of_plug_ins(said):
        try:
            if failed is not None and str(failed).startswith("Unable to initialize"):
                raise failed
            jax.devices()
        except Exception as error:  # whatever a plug-in raises
            said.append(_in_short(str(error)))
            _start_cpu()
    if said and asked != "cpu":
        got = f"JAX_PLATFORMS={asked}" if asked else "a plug-in of JAX"
        _warn(got, said[0], jax.default_backend())
    return bool(said)


def _asked() -> str:
    return jax.config.jax_platforms or ""  # pyright: ignore[reportAttributeAccessIssue]


def _any_plug_in() -> bool:
    """Whether JAX will find a plug-in, be it a broken one."""
    found = importlib.util.find_spec("jax_plugins")
    places = found.submodule_search_locations if found else None
    return bool(
        any(pkgutil.iter_modules(places or []))
        or metadata.entry_points(group="jax_plugins")
        or os.environ.get("PJRT_NAMES_AND_LIBRARY_PATHS")
    )


@contextlib.contextmanager
def _errors_of_plug_ins(said: list[str]) -> Iterator[None]:
    """Gather in `said` what JAX logs, with tracebacks, of broken plug-ins."""

    def pass_on(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        if not text.startswith("Jax plugin configuration error: "):
            return not (said and "may be present on this machine" in text)
        error = record.exc_info[1] if record.exc_info else None
        said.append(_in_short(str(error or text.partition(": ")[2])))
        return False

    logger = logging.getLogger(_LOGGER)
    logger.addFilter(pass_on)
    try:
        yield
    finally:
        logger.removeFilter(pass_on)


def _start_cpu() -> None:
    jax.config.update("jax_platforms", "cpu")
    if (clear := optional("jax.extend.backend", "clear_backends")) is not None:
        clear()
    if (bridge := optional("jax._src", "xla_bridge")) is not None:
        bridge._plugins_registered = True
    jax.devices()


def _in_short(error: str) -> str:
    """One line of an error of JAX, without advice that is not needed any more."""
    if not error.strip():  # an assertion
        return "no such device found"
    if "not in the list of known backends" in error:
        return "no plug-in of JAX that works brings it"
    return re.sub(r" \((set JAX_PLATFORMS|you may need).*", "", error).strip().splitlines()[0]


def _warn(got: str, wrong: str, used: str) -> None:
    used = "the CPU" if used == "cpu" else used
    warnings.warn(
        f"sorojax: {got} failed ({wrong}), using {used}. {_DO}",
        stacklevel=4,  # where sorojax is imported or a command is run
    )
