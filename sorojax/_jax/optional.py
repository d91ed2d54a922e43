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


def reason(module: str, name: str) -> str:
    """Why `optional(module, name)` is `None`, for people."""
    try:
        getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        return f"this jax has no {module}.{name}"
    return f"{SWITCH} leaves it out"
