"""Newton's last steps by the factor of an earlier one: same answers, same stability."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh
from sorojax.fem.equilibrium import newton as kept_factor
from sorojax.units import MPa, kPa

RUBBER = material.neo_hookean(young_modulus=1 * MPa, poisson_ratio=0.45, density=1000.0)


@pytest.fixture(scope="module")
def column():
    """Clamped below, pushed down at the top where it may move sideways."""
    grid = mesh.rectangle([0, 0], [0.01, 0.08], divisions=(3, 24), element=mesh.Quad4())
    below = grid.node_sets["bottom"]
    loads = (fem.Traction(grid.facet_sets["top"], [0.0, -1 * kPa], name="push"),)
    return fem.problem(
        grid, RUBBER, kinematics=fem.PlaneStrain(1.0), supports=(fem.Fixed(below),), loads=loads
    )


def pushed(column, values):
    """Displacements of a path, its factorisations, iterations and negative eigenvalues."""
    before = column.space.system.solver.num_factorisations
    path = fem.solve_path(column, push=jnp.asarray(values))
    assert path.status == Status.successful
    steps = [step for stats in path.stats for step in stats.steps]
    return (
        np.asarray(path.displacements),
        column.space.system.solver.num_factorisations - before,
        sum(step.iterations for step in steps),
        [step.negative_eigenvalues for step in steps],
    )


SIDEWAYS = [[3 * kPa * k, -0.2 * kPa * k] for k in (1, 2)]
#: The column buckles between the third and the fourth.
DOWN = [[0.0, -1 * kPa * k] for k in (1, 2, 3, 4, 5)]


@pytest.mark.parametrize("loads", [SIDEWAYS, DOWN])
def test_kept_factors_change_no_answer(column, loads, monkeypatch):
    u, many, iterations, negative = pushed(column, loads)
    # other loads between them: the solver knows the factors of known values
    pushed(column, [[1.0, 1.0], [2.0, 1.0]])
    for name in ("_WORTH", "_WORTH_PROBING", "_WORTH_PROBING_3D"):
        monkeypatch.setattr(kept_factor, name, 0)
    v, few, more, signs = pushed(column, loads)
    assert np.abs(v - u).max() < 1e-8 * np.abs(u).max()
    assert more <= iterations and few < many and signs == negative


class Identity:
    negative_eigenvalues = 0

    def solve(self, b):
        return b


def test_a_factor_serves_as_long_as_the_body_moves_little():
    u = np.ones((50_000, 2))
    kept = kept_factor.KeptFactor(np.zeros(u.size, bool), 2, 1e-9)
    assert kept.near(u, 1e-3, 1e-2) is None  # nothing kept
    kept.renew(Identity(), u)  # type: ignore[arg-type]
    assert kept.near(1.5 * u, 1e-3, 0.5) is None
    probed = kept.near(1.05 * u, 1e-3, 0.05)
    assert probed is not None and probed.start is not None
    # the guess is as large as the step to come, the error far below what that leaves
    assert np.abs(probed.start).max() == pytest.approx(0.05**2 * 1.05)
    assert probed.tolerance == pytest.approx(3e-6)
    close = kept.near(1.0001 * u, 1e-8, 1e-4)
    assert close is not None and close.start is None and close.tolerance == 3e-3
