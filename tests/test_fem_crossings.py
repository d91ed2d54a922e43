"""Sides of a deformed body that pass through each other, and that a print tells of them."""

import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh

RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3)
PLANE = [mesh.Quad4(), mesh.Quad8()]
SPACE = [mesh.Hex8(), mesh.Tet4()]


def fork(element) -> fem.Problem:
    """Two prongs side by side, 1 apart, on a base, held below."""
    dim = element.dim
    block = (mesh.rectangle if dim == 2 else mesh.box)(
        [0] * dim, [3] + [4] * (dim - 1), divisions=(3,) + (4,) * (dim - 1), element=element
    )
    kept = mesh.cells_where(block, lambda p: (p[1] < 1) | (p[0] < 1) | (p[0] > 2))
    prongs = mesh.submesh(block, kept)
    below = np.flatnonzero(np.asarray(prongs.points)[:, 1] == 0)
    kinematics = fem.PlaneStrain(1.0) if dim == 2 else fem.Solid()
    return fem.problem(prongs, RUBBER, kinematics=kinematics, supports=(fem.Fixed(below),))


def bent(problem, way: float, aside: float = 0.03):
    """The right prong bent to the left by `way` at its end, and turned out of line a little."""
    x = problem.mesh.points
    share = jnp.where(x[:, 0] > 1.5, jnp.clip((x[:, 1] - 1) / 3, 0, 1), 0.0)
    u = jnp.zeros_like(x).at[:, 0].set(-way * share**2)
    return u.at[:, 1:].set(aside * share[:, None])


def crossing_by_hand(problem, u):
    """Pairs of sides of Quad4 that cross, each with each, by the crossing of their lines."""
    facets, x = mesh.boundary_facets(problem.mesh), np.asarray(problem.mesh.points + u)
    found = []
    for i, (a, b) in enumerate(facets):
        for k, (c, d) in enumerate(facets[:i]):
            if {a, b} & {c, d}:
                continue
            lines = np.stack([x[b] - x[a], x[c] - x[d]], axis=1)
            if abs(np.linalg.det(lines)) > 1e-12:
                at = np.linalg.solve(lines, x[c] - x[a])
                if np.all((at > 0) & (at < 1)):
                    found.append((k, i))
    return sorted(found)


@pytest.mark.parametrize("element", PLANE + SPACE, ids=lambda e: e.name)
def test_prongs_cross_where_one_is_bent_through_the_other(element):
    problem = fork(element)
    assert len(fem.self_crossings(problem, bent(problem, 0.9))) == 0
    pairs = fem.self_crossings(problem, bent(problem, 1.4))
    assert len(pairs) > 0
    facets, x = mesh.boundary_facets(problem.mesh), np.asarray(problem.mesh.points)
    side = np.sign(x[facets[pairs]][..., 0].mean(axis=2) - 1.5)
    assert np.all(side[:, 0] * side[:, 1] < 0)  # of one prong each


def test_pairs_in_the_plane_are_those_of_all_with_all():
    problem = fork(mesh.Quad4())
    for way in np.linspace(0.95, 2.5, 7):
        u = bent(problem, way)
        assert fem.self_crossings(problem, u).tolist() == [
            list(pair) for pair in crossing_by_hand(problem, u)
        ]


def test_prongs_that_touch_do_not_cross():
    problem = fork(mesh.Quad4())
    x = problem.mesh.points
    u = jnp.zeros_like(x).at[:, 0].set(jnp.where((x[:, 0] == 2.0) & (x[:, 1] > 1), -1.0, 0.0))
    assert len(fem.self_crossings(problem, u)) == 0


def test_a_print_tells_of_a_body_that_passes_through_itself():
    problem = fork(mesh.Quad4())
    for way, told in ((0.9, False), (1.4, True)):
        found = fem.Solution(problem, bent(problem, way), Status.successful, None)
        assert ("passes through itself" in str(found)) == told
    facets, x = mesh.boundary_facets(problem.mesh), np.asarray(problem.mesh.points)
    left, right = (facets[np.all(x[facets, 0] == at, axis=1)] for at in (1.0, 2.0))
    touching = fem.SelfContact(left, others=right, stiffness=1e6)
    held = fem.problem(
        problem.mesh, RUBBER, kinematics=problem.kinematics, supports=problem.supports,
        loads=(touching,),
    )  # fmt: skip
    kept = fem.Solution(held, bent(problem, 1.4), Status.successful, None)
    assert "passes through itself" not in str(kept)
