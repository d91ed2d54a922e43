"""Sweeps: one function over many designs, on one machine or many, resumable."""

from sorojax._arguments import check_package as _check_package
from sorojax.sweep.sweep import (
    Serial as Serial,
    Store as Store,
    Swept as Swept,
    dask_local as dask_local,
    sweep as sweep,
)

_check_package(__name__)
