"""Sweeps: one function over many designs, on one machine or many, resumable."""

from sorojax._arguments import check_package as _check_package
from sorojax.sweep.sweep import Serial, Store, dask_local, sweep

__all__ = [
    "Serial",
    "Store",
    "dask_local",
    "sweep",
]

_check_package(__name__)
