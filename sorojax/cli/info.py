"""`sorojax info`: installed versions and devices."""

import os
import platform
from importlib import metadata

PACKAGES = (
    "jax", "jaxlib", "equinox", "diffrax", "optimistix", "optax",
    "numpy", "scipy", "scikit-image", "matplotlib",
)  # fmt: skip
OPTIONAL = ("mkl", "pyvista", "opencv-python-headless", "pyrealsense2")


def info() -> dict[str, str]:
    """Versions, devices, precision, solvers, cache and fast paths, as text by name."""
    import jax

    from sorojax import __version__
    from sorojax._cache import cache_directory
    from sorojax._jax import fast_paths
    from sorojax.math.linalg.sparse import available_solvers

    facts = {"python": f"{platform.python_version()} on {platform.platform()}"}
    facts["sorojax"] = __version__
    facts |= {name: _version(name) for name in PACKAGES + OPTIONAL}
    facts["jax"] += f", {_tested(facts['jax'], facts['jaxlib'])} with sorojax {__version__}"
    facts["devices"] = ", ".join(str(device) for device in jax.devices())
    facts["cores"] = str(_cores())
    facts["float64"] = "on" if jax.numpy.result_type(float) == "float64" else "off"
    facts["solvers"] = ", ".join(f"{k} ({v})" for k, v in available_solvers().items())
    facts["compilation cache"] = str(cache_directory())
    facts |= {f"fast path {name}": state for name, state in fast_paths().items()}
    return facts


def _tested(jax: str, jaxlib: str) -> str:
    """Whether this pair was tested; every version of JAX is tested with its own jaxlib."""
    from sorojax._jax.versions import is_tested

    return "tested" if is_tested(jax) and jaxlib == jax else "not tested"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
