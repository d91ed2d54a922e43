"""Names of JAX that it does not promise to keep, looked up where they may be missing."""

import importlib
import os
from typing import Any

#: In the environment: "all", or dotted names separated by commas, that are then not looked up.
SWITCH = "SOROJAX_WITHOUT_JAX_NAMES"


def optional(module: str, name: str) -> Any:
    """`name` of `module`, or `None` where this JAX has no such name or it is switched off."""
    without = os.environ.get(SWITCH, "").replace(" ", "").split(",")
    if "all" in without or f"{module}.{name}" in without:
        return None
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        return None


def every(*names: tuple[str, str]) -> tuple[dict[str, Any], str]:
    """Modules' names with what they stand for, and "on", or "off: why" if one is missing."""
    found = {name: optional(module, name) for module, name in names}
    missing = [(module, name) for module, name in names if found[name] is None]
    return found, f"off: {reason(*missing[0])}" if missing else "on"


def reason(module: str, name: str) -> str:
    """Why `optional(module, name)` is `None`, for people."""
    try:
        getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        return f"this jax has no {module}.{name}"
    return f"{SWITCH} leaves it out"
