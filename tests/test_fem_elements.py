"""Every element with every kinematics and formulation: patch, derivatives, invariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from patches import POLYGON, patch
from scipy.optimize import brentq

from sorojax import fem, material, mesh
from sorojax.fem.equilibrium.linear import linearise, prepare

pytestmark = pytest.mark.quick

RUBBER = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.49)
D, P0, P1 = fem.Displacement(), fem.ConstantPressure(), fem.LinearPressure()
STRAIN, STRESS, AXIAL = fem.PlaneStrain(0.5), fem.PlaneStress(0.1), fem.Axisymmetric()
PLANE = (
    (mesh.Tri3(), (D,)),
    (mesh.Tri6(), (D, P0)),
    (mesh.Tri7(), (P1, D, P0)),
    (mesh.Quad4(), (P0, D)),
    (mesh.Quad8(), (D, P0)),
    (mesh.Quad9(), (P1, D, P0)),
    (POLYGON, (P0, D)),
)
SPACE = (
    (mesh.Tet4(), (D,)),
    (mesh.Tet10(), (P0, D)),
    (mesh.Tet15(), (P1, D, P0)),
    (mesh.Hex8(), (P0, D)),
)


def _cases():
    """The first formulation of each element in plane strain and in space, and some cells of
    the other kinematics; the rest of the table is slow to compile."""
    for element, formulations in PLANE:
        for formulation in formulations:
            first = formulation is formulations[0]
            yield element, STRAIN, formulation, not first
            often = element == POLYGON or isinstance(element, mesh.Quad4 | mesh.Tri3)
            yield element, AXIAL, formulation, not often
        yield element, STRESS, D, not isinstance(element, mesh.Quad4)
    for element, formulations in SPACE:
        for formulation in formulations:
            yield element, fem.Solid(), formulation, formulation is not formulations[0]


CASES = [
    pytest.param(
        element,
        kinematics,
        formulation,
        marks=pytest.mark.slow if slow else (),
        id=f"{element.name}-{type(kinematics).__name__}-{type(formulation).__name__}",
    )
    for element, kinematics, formulation, slow in _cases()
]


def _look(problem, prepared, states, directions, tilted):
    """Force and tangent as assembled at the first state, and the energy, its slope and
    its curvature at all; stresses of the second."""
    state = linearise(problem, prepared, states[0], states[0])

    def slope(u):
        return jax.value_and_grad(lambda u: fem.potential_energy(problem, u))(u)

    def at(u, v):
        return jax.jvp(slope, (u,), (v,))

    (energy, force), (_, change) = jax.vmap(at)(states, directions)
    return (
        state.residual,
        state.values,
        energy,
        force,
        change,
        fem.cauchy_stress(problem, tilted),
    )


# LLVM's optimiser would take most of the time of these tests.
_look_fast = jax.jit(
    _look,
    compiler_options={
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
    },
)


def _dense(system, values) -> np.ndarray:
    upper = np.zeros((system.size, system.size))
    upper[np.asarray(system.rows), np.asarray(system.cols)] = values
    return upper + np.triu(upper, 1).T


def _turn(kinematics) -> np.ndarray:
    if isinstance(kinematics, fem.Axisymmetric):
        return np.eye(2)
    a, b = np.cos(0.7), np.sin(0.7)
    plane = np.array([[a, -b], [b, a]])
    if kinematics.dim == 2:
        return plane
    tilt = np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
    return np.block([[plane, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]]) @ tilt


def _gradient(kinematics) -> np.ndarray:
    """A displacement gradient with 20 % strain that is an equilibrium."""
    if isinstance(kinematics, fem.Axisymmetric):
        return np.diag([0.2, -0.15])
    G = np.array([[0.2, 0.1, 0.05], [-0.05, -0.1, 0.08], [0.0, 0.06, 0.15]])
    return G[: kinematics.dim, : kinematics.dim]


def _homogeneous_stress(kinematics, G) -> np.ndarray:
    F = np.eye(3)
    F[: len(G), : len(G)] += G
    if isinstance(kinematics, fem.Axisymmetric):
        F[2, 2] = F[0, 0]

    def stress(out):
        F[2, 2] = out
        return np.asarray(material.cauchy_stress(RUBBER, jnp.asarray(F)))

    if not isinstance(kinematics, fem.PlaneStress):
        return stress(F[2, 2])
    return stress(brentq(lambda out: stress(out)[2, 2], 0.5, 2.0, xtol=1e-15))


@pytest.mark.parametrize(("element", "kinematics", "formulation"), CASES)
def test_element(element, kinematics, formulation):
    cells = patch(element, (1.0, 0.0, 0.0))
    edge = np.unique(mesh.boundary_facets(cells))
    problem = fem.problem(
        cells,
        RUBBER,
        kinematics=kinematics,
        supports=(fem.Fixed(edge),),
        formulation=formulation,
    )
    random = np.random.default_rng(0)
    X = np.asarray(cells.points)
    linear = X @ _gradient(kinematics).T
    bent = 0.5 * linear + 0.01 * random.standard_normal(X.shape)
    turn = _turn(kinematics)
    shift = np.array([0.0, 0.3, -0.2])[: X.shape[1]]
    turned = (X + bent) @ turn.T + shift - X
    rigid = X @ turn.T + shift - X
    states = jnp.asarray(np.stack([bent, linear, turned, rigid]))
    v = jnp.asarray(random.standard_normal(states.shape))
    prepared = prepare(problem)
    residual, values, energy, force, change, sigma = map(
        np.asarray, _look_fast(problem, prepared, states, v, states[1])
    )
    tangent = _dense(problem.space.system, values)
    unit = np.abs(force[0]).max()

    # assembled force = dE/du, assembled tangent = dR/du
    assert np.abs(residual - force[0].ravel()).max() < 1e-12 * unit
    product = tangent @ np.asarray(v[0]).ravel()
    assert np.abs(product - change[0].ravel()).max() < 1e-12 * np.abs(change[0]).max()

    # patch: free nodes are in balance, so a Newton step leaves them where they are
    free = np.ones(X.shape, bool)
    free[edge] = False
    free = free.ravel()
    stiff = np.abs(tangent).max()
    assert free.any() and np.abs(force[1]).max() > 1e-4 * stiff
    step = np.linalg.solve(tangent[np.ix_(free, free)], force[1].ravel()[free])
    assert np.abs(step).max() < 1e-12

    # a rotation turns the forces, leaves the energy, and costs none at rest
    assert np.isclose(energy[2], energy[0], rtol=1e-12)
    assert np.abs(force[2] - force[0] @ turn.T).max() < 1e-11 * unit
    assert abs(energy[3]) < 1e-14 and np.abs(force[3]).max() < 1e-13 * stiff

    # stress of the homogeneous state, at every node of every cell
    wanted = _homogeneous_stress(kinematics, _gradient(kinematics))
    assert np.abs(sigma - wanted).max() < 1e-11 * np.abs(wanted).max()


def _problem(element, kinematics=None, formulation=None, rubber=RUBBER):
    cells = patch(element)
    kinematics = kinematics or (STRAIN if element.dim == 2 else None)
    edge = np.unique(mesh.boundary_facets(cells))
    return fem.problem(
        cells,
        rubber,
        kinematics=kinematics,
        supports=(fem.Fixed(edge),),
        formulation=formulation,
    )


@pytest.mark.parametrize(
    ("element", "kinematics", "formulation", "message"),
    [
        (mesh.Tri3(), STRAIN, P0, "constant pressure in Tri3 is the displacement element"),
        (mesh.Tet4(), None, P0, "constant pressure in Tet4 is the displacement element"),
        (mesh.Tri6(), STRAIN, P1, "linear pressure in Tri6 is not stable"),
        (mesh.Quad4(), AXIAL, P1, "linear pressure in Quad4 is not stable"),
        (mesh.Quad8(), STRAIN, P1, "linear pressure in Quad8 is not stable"),
        (mesh.Hex8(), None, P1, "linear pressure in Hex8 is not stable"),
        (mesh.Tet10(), None, P1, "linear pressure in Tet10 is not stable"),
        (mesh.Quad4(), STRESS, P0, "plane stress has no pressure of its own"),
        (mesh.Tri7(), STRESS, P1, "plane stress has no pressure of its own"),
    ],
)
def test_unstable_pairs_are_refused(element, kinematics, formulation, message):
    with pytest.raises(ValueError, match=message):
        _problem(element, kinematics, formulation)


@pytest.mark.parametrize(
    ("element", "poisson_ratio", "remedy"),
    [
        (mesh.Tri3(), 0.49, "order=2 cells"),
        (mesh.Tet4(), 0.49, "order=2 cells"),
        (mesh.Tri6(), 0.4999, "mesh.enrich"),
        (mesh.Quad8(), 0.4999, "mesh.enrich"),
        (mesh.Tet10(), 0.4999, "mesh.enrich"),
    ],
)
def test_cells_that_lock_are_refused_unless_asked_for(element, poisson_ratio, remedy):
    stiff = material.neo_hookean(young_modulus=1.0, poisson_ratio=poisson_ratio)
    with pytest.raises(ValueError, match=f"would lock at a Poisson ratio .*{remedy}"):
        _problem(element, rubber=stiff)
    assert isinstance(_problem(element, formulation=D, rubber=stiff).formulation, type(D))
    soft = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3)
    _problem(element, rubber=soft)


@pytest.mark.parametrize("element", [mesh.Tri7(), mesh.Quad9(), mesh.Tet15()])
def test_richer_cells_take_linear_pressures_by_default(element):
    stiff = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.4999)
    assert isinstance(_problem(element, rubber=stiff).formulation, fem.LinearPressure)
    if element.dim == 2:
        assert isinstance(_problem(element, STRESS).formulation, fem.Displacement)


@pytest.mark.parametrize("element", [mesh.Quad4(), POLYGON, mesh.Hex8()])
def test_linear_cells_take_constant_pressures_by_default(element):
    stiff = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.4999)
    assert isinstance(_problem(element, rubber=stiff).formulation, fem.ConstantPressure)
