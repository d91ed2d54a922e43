"""sorojax: a JAX-native differentiable soft-robot framework.

`import sorojax as sj`, then `sj.sdf`, `sj.mesh`, `sj.material`, `sj.contact`, `sj.fem`,
`sj.rod`, `sj.coupling`, `sj.reduction`, `sj.systems`, `sj.design`, `sj.robots`, `sj.io`,
`sj.view`, `sj.vision`, `sj.sweep`, `sj.envs`. Importing sets no JAX flag; mechanics needs
`jax.config.update("jax_enable_x64", True)`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sorojax._jax import versions as _versions

_versions.check()  # before anything imports JAX

from sorojax import units
from sorojax._arguments import public as _public
from sorojax._cache import enable_compilation_cache
from sorojax._edit import replace
from sorojax._jax import devices as _devices
from sorojax._jax.jit import compiled, jit
from sorojax._jax.low_latency import enable_low_latency
from sorojax._progress import listen, silent

_devices.leave_out_absent()
for _name in ("compiled", "jit", "listen"):
    globals()[_name] = _public(__name__, _name, globals()[_name])

__version__ = "0.2.0"

_FLOORS = (
    "contact", "coupling", "design", "envs", "fem", "io", "material", "math", "mesh",
    "reduction", "robots", "rod", "sdf", "sweep", "systems", "view", "vision",
)  # fmt: skip
_CLASSES = {"SE2": "math.lie", "SE3": "math.lie", "Status": "math.status"}
__all__ = [
    "SE2", "SE3", "Status", "compiled", "enable_compilation_cache", "enable_low_latency", "jit",
    "listen", "replace", "silent", "units",
    "contact", "coupling", "design", "envs", "fem", "io", "material", "math", "mesh",
    "reduction", "robots", "rod", "sdf", "sweep", "systems", "view", "vision",
]  # fmt: skip

if TYPE_CHECKING:
    from sorojax import (
        contact,
        coupling,
        design,
        envs,
        fem,
        io,
        material,
        math,
        mesh,
        reduction,
        robots,
        rod,
        sdf,
        sweep,
        systems,
        view,
        vision,
    )
    from sorojax.math.lie import SE2, SE3
    from sorojax.math.status import Status


def __getattr__(name: str) -> Any:
    """A floor is imported when it is first asked for, and the classes that stand here too."""
    if name in _FLOORS:
        return importlib.import_module(f"sorojax.{name}")
    if name in _CLASSES:
        found = getattr(importlib.import_module(f"sorojax.{_CLASSES[name]}"), name)
        globals()[name] = found
        return found
    raise AttributeError(f"module 'sorojax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
