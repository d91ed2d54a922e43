"""Bending frequencies D2 of the finger without rotary inertia, in units of Euler-Bernoulli."""

import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import LENGTH, finger
from benchmarks.harness import Row, measure_calls
from sorojax import replace
from sorojax.math.lie import SE2
from sorojax.rod import chebyshev, mass_matrix, rod, stiffness_matrix

EXACT = (3.5160152685, 22.0344915646)  # roots of cos x cosh x = -1, squared
BARS = {1: 1e-7, 2: 2e-5}
REFERENCE = "Euler-Bernoulli cantilever, relative"


def frequencies(beam):
    """omega L^2 sqrt(rho A / (E I)), rising."""
    zero = jnp.zeros(beam.basis.num_dof)
    mass, stiffness = np.asarray(mass_matrix(beam, zero)), np.asarray(stiffness_matrix(beam))
    lower = np.linalg.inv(np.linalg.cholesky(mass))
    values = np.linalg.eigvalsh(lower @ stiffness @ lower.T)
    material, section = beam.material, beam.section
    bending = material.young_modulus * section.second_moment_z
    return np.sqrt(values * float(material.density * section.area / bending)) * LENGTH**2


def rows():
    spatial = finger(8)
    for modes in (3, 4, 5, 6):
        beam = rod(
            SE2(),
            chebyshev(kappa_z=modes),
            spatial.section,
            spatial.material,
            length=LENGTH,
            nodes=modes + 8,
        )
        # The rotary inertia goes with the section, the stiffness with E I: scale them apart.
        thin = replace(beam, lambda r: r.section.second_moment_z, 1e-15)
        ratio = beam.section.second_moment_z / 1e-15
        thin = replace(
            thin, lambda r: r.material.young_modulus, beam.material.young_modulus * ratio
        )
        timing = measure_calls(lambda: mass_matrix(thin, jnp.zeros(modes)), 3)  # noqa: B023
        found = frequencies(thin)
        for number in (1, 2):
            error = abs(float(found[number - 1]) / EXACT[number - 1] - 1)
            yield Row(
                "sorojax",
                {"modes": modes, "frequency": number},
                **timing.columns(),
                error=error,
                reference=REFERENCE,
                bar=BARS[number] if modes == 6 else None,
                bar_on="error",
            )
