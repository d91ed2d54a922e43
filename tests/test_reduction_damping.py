"""Damping from motion: the matrix that made it, noise, what cannot be told."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, reduction, rod as R
from sorojax.math.ode.steppers import TripleJump

BODY = R.rod(
    SE2(),
    R.chebyshev(kappa_z=2, sigma_x=1),
    R.circle(6e-3),
    length=0.1,
    young_modulus=1e5,
    poisson_ratio=0.3,
    density=1000.0,
    nodes=6,
)
SHARES = np.array([[0.012, 0.004, 0.0], [0.004, 0.009, 0.0], [0.0, 0.0, 0.003]])
SIZE = np.sqrt(np.diag(np.asarray(R.stiffness_matrix(BODY))))
TRUE = SIZE[:, None] * SHARES * SIZE  # retardation times of the modes [s]


def forces(share):
    """Weight, and a share of the damping."""
    return R.Gravity(), reduction.ConstantDamping(share * TRUE)


@pytest.fixture(scope="module")
def swing():
    q = jnp.array([6.0, -4.0, 0.05])
    return R.rollout(BODY, q, 0 * q, forces(1.0), step=5e-4, saves=1000, stepper=TripleJump())


@pytest.mark.parametrize("rates", [True, False])
def test_the_damping_that_made_a_motion_is_found(swing, rates):
    fit = reduction.identify_damping(
        BODY, swing.time, swing.q, forces(0.0), v=swing.v if rates else None
    )
    found = np.asarray(fit.damping.coefficients) / SIZE[:, None] / SIZE
    assert np.allclose(found, SHARES, rtol=0, atol=2e-5 * SHARES.max())
    assert fit.error < 1e-4


def test_noise_and_a_motion_without_damping_add_no_energy(swing):
    noise = np.random.default_rng(0).standard_normal(swing.q.shape)
    seen = np.asarray(swing.q) + 1e-4 * noise * np.ptp(np.asarray(swing.q), axis=0)
    fit = reduction.identify_damping(BODY, swing.time, seen, forces(0.0), window=61)
    found = np.asarray(fit.damping.coefficients) / SIZE[:, None] / SIZE
    assert np.allclose(found, SHARES, rtol=0, atol=0.05 * SHARES.max())
    # what already is among the forces is not there once more
    none = reduction.identify_damping(BODY, swing.time, swing.q, forces(1.5)).damping
    assert np.linalg.eigvalsh(none.coefficients)[0] >= -1e-15
    assert np.abs(none.coefficients).max() < 1e-6 * np.abs(TRUE).max()


def test_bad_input_names_the_remedy(swing):
    t, q = swing.time[:100], swing.q[:100]
    with pytest.raises(ValueError, match="one row of all coordinates"):
        reduction.identify_damping(BODY, t, q[:, :2])
    with pytest.raises(ValueError, match="got 30 samples.*Sample for longer"):
        reduction.identify_damping(BODY, t[:30], q[:30])
    with pytest.raises(ValueError, match="need equal ones"):
        reduction.identify_damping(BODY, t**2, q)
    alike = swing.v.at[:, 1].set(2 * swing.v[:, 0])
    with pytest.raises(ValueError, match="`kappa_z` move in fewer ways"):
        reduction.identify_damping(BODY, swing.time, swing.q, forces(0.0), v=alike)
