"""Tendon-driven silicone tentacle: poses that a fit of physical parameters has not seen.

`benchmarks/validation/tentacle.py` says what is fitted. Every pair of the 14 poses is left out
once; a quick run leaves out seven pairs. The error is the median over pairs of the mean
distance of the four markers [mm], not knowing in which recording marker 2 slipped.
"""

import numpy as np

from benchmarks.harness import Row, measure_calls, quick
from benchmarks.validation import tentacle
from benchmarks.validation.report import BAR, PEERS
from sorojax.units import mm

PAIRS = tuple((k, k + 7) for k in range(7))


def rows():
    found = tentacle.fit()
    p = found.parameters
    timing = measure_calls(lambda: tentacle.fit((0,), p).misfit, repeats=3)
    left = tentacle.leave_pairs_out(p, PAIRS if quick("84 of 91 pairs") else None)
    settings = {
        "pairs": len(left.pairs),
        "parameters": len(found.names),
        "worst_mm": float(left.unknown.max() / mm),
        "known_median_mm": float(np.median(left.known) / mm),
        "known_worst_mm": float(left.known.max() / mm),
        "fitted_mm": float(tentacle.errors(p, tentacle.read()).mean() / mm),
        "young_modulus_kPa": float(p["young_modulus"] / 1e3),
    }
    yield Row(
        "sorojax",
        settings,
        **timing.columns(),
        error=float(np.median(left.unknown) / mm),
        reference=f"motion capture of 4 markers [mm]; {PEERS}",
        bar=BAR,
        bar_on="error",
    )
