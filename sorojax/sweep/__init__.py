"""Sweeps: one function over many designs, on one machine or many, resumable."""

from sorojax._arguments import check_package as _check_package
from sorojax.sweep.executors import Serial as Serial, dask_local as dask_local
from sorojax.sweep.store import Store as Store
from sorojax.sweep.sweep import Swept as Swept, sweep as sweep

_check_package(__name__)
