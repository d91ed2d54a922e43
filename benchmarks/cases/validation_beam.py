"""Dragon Skin 10 beam: its swing with a weight at the tip, from the drop and the swing without.

Young's modulus comes from the drop, a viscosity from the damping ratio without load. Elastic
numbers have bars, 1 mm for drops and 5 % for the frequency; the damping ratio has none, as the
losses of a viscosity fall with the frequency and those of the rubber do not.
"""

import numpy as np

from benchmarks.harness import Row, measure_calls
from benchmarks.validation import beam

DROP_BAR, FREQUENCY_BAR = 1.0, 0.05  # mm, relative


def rows():
    young, viscosity = beam.fitted()
    body = beam.kelvin_voigt(young, viscosity)
    for load in beam.FILES:
        repeats = beam.measured(load)
        swing, *_ = beam.predict(body, load)
        timing = measure_calls(lambda x=load: beam.predict(body, x)[1], repeats=2)
        drops = np.mean([x.drops for x in repeats], axis=0)
        drop = float(np.abs(swing.drops - drops).max())
        frequency = swing.frequency / float(np.mean([x.frequency for x in repeats])) - 1
        settings = {
            "load_N": load, "young_modulus_Pa": round(young),
            "viscosity_Pa_s": round(viscosity, 1), "largest_drop_error_mm": drop,
            "frequency_Hz": swing.frequency, "frequency_error": frequency,
            "damping_ratio": swing.ratio,
            "measured_ratio": float(np.mean([x.ratio for x in repeats])),
        }  # fmt: skip
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=max(drop / DROP_BAR, abs(frequency) / FREQUENCY_BAR),
            reference="motion capture of a released beam; largest error over its bar",
            bar=1.0,
            bar_on="error",
        )
