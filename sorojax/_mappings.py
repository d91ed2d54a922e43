"""Memory mappings of compiled programs. XLA takes some hundred for a program of many kernels,
Linux allows a process 65,530, and beyond them JAX ends it without a word.

JAX tells of each program that it compiles or reads (`jax.monitoring`).
"""

from pathlib import Path

import jax

from sorojax import _check

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_COMPILED = "/jax/core/compile/backend_compile_duration"
_EVERY = 64  # programs between two looks, of 10 ms each
_SHARE = 0.7  # of what is allowed

_state = {"programs": 0, "warned": False, "watching": False}


def count() -> int:
    """Mappings of this process; 0 where the system does not tell."""
    return _MAPS.read_bytes().count(b"\n") if _MAPS.exists() else 0


def watch() -> None:
    """From now on warn when programs have taken most of what is allowed."""
    if not _state["watching"] and _MAPS.exists():
        _state["watching"] = True
        jax.monitoring.register_event_duration_secs_listener(_after)


def _after(event: str, duration_secs: float, **_: object) -> None:
    del duration_secs
    if event == _COMPILED:
        _state["programs"] += 1
        if _state["programs"] % _EVERY == 0:
            look()


def look(allowed: int | None = None) -> None:
    """Warn, once until programs are dropped, if more than a share of `allowed` is taken."""
    if allowed is None:
        allowed = int(_MOST.read_text()) if _MOST.exists() else 65_530
    taken = count()
    if taken <= _SHARE * allowed:
        _state["warned"] = False
    elif not _state["warned"]:
        _state["warned"] = True
        _check.warn(
            f"jax: the compiled programs of this process take {taken} memory mappings, need "
            f"less than {allowed}, the limit of the system, beyond which JAX ends the process. "
            "Call jax.clear_caches() from time to time; what is needed again is compiled again "
            "or, after sorojax.enable_compilation_cache(), read from disk."
        )
