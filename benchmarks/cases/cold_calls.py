"""First calls of common verbs in fresh processes: without a cache, and with one that is filled.

Scenes are built before; what they compile (a mesh, say) is no part of the first call. Second
calls compile nothing. Other codes have some of these tasks, or a plain one of the same size.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks import cold_peers
from benchmarks.cold import CALLS, FROM_CACHE, counted, measured
from benchmarks.harness import quick

FEW = ("rod.equilibrium", "fem.solve", "systems.simulate")


def rows():
    few = quick("gradients, lanes, layouts")
    for name, (_, bar) in CALLS.items():
        if few and name not in FEW:
            continue
        with tempfile.TemporaryDirectory() as cache:
            empty, filled = (measured(name, Path(cache)) for _ in range(2))
            programs = counted(name, Path(cache))
        counts = {"programs": programs.count, "operations": programs.operations}
        bars = {"empty": bar, "filled": FROM_CACHE}
        for row in cold_peers.three("sorojax", name, empty, filled, counts):
            yield replace(row, bar=bars.get(row.settings["cache"]))
    if not quick("other codes"):
        yield from cold_peers.rows()
