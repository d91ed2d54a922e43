"""Random trees of operators keep their promises; queries, sampling and bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from sorojax import sdf
from sorojax.sdf.query import value_and_normal_at
from sorojax.sdf.trimesh.tree import order_by_halving

pytestmark = pytest.mark.quick

POINTS = np.random.default_rng(3).uniform(-2, 2, (256, 2))
number = st.floats(-0.8, 0.8).map(lambda v: round(v, 3))
length = st.floats(0.2, 0.9).map(lambda v: round(v, 3))
point = st.tuples(number, number).map(list)
LEAVES = st.one_of(
    st.builds(sdf.Circle, point, length),
    st.builds(lambda p, a, b: sdf.Rectangle(p, [p[0] + a, p[1] + b]), point, length, length),
    st.builds(
        lambda p, r, n: sdf.translate(sdf.Star(r, r / 2, n), p),
        point,
        length,
        st.integers(3, 6),
    ),
)


def grow(parts):
    two = st.tuples(parts, parts)
    return st.one_of(
        two.map(lambda s: s[0] | s[1]),
        two.map(lambda s: s[0] & s[1]),
        two.map(lambda s: s[0] - s[1]),
        st.builds(lambda s, k: sdf.SmoothUnion(*s, k, sdf.Cubic()), two, length),
        st.builds(lambda s, k: sdf.SmoothDifference(*s, k), two, length),
        st.builds(lambda s, k: sdf.SmoothUnion(*s, k, sdf.Chamfer()), two, length),
        st.builds(sdf.rotate, parts, number, point),
        st.builds(sdf.offset, parts, length),
        st.builds(lambda s, t: sdf.shell(s, t / 4), parts, length),
        st.builds(lambda s, a, b: sdf.stretch(s, [2 * a, 2 * b]), parts, length, length),
        st.builds(sdf.scale, parts, length),
        st.builds(lambda s: sdf.mirror(s, [1, 2]), parts),
        st.builds(lambda s: sdf.polar_repeat(s, 3), parts),
    )


TREES = st.recursive(LEAVES, grow, max_leaves=3)


@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(TREES)
def test_random_trees_keep_their_promises(shape):
    p = jnp.asarray(POINTS)
    f, g = jax.tree.map(np.asarray, eqx.filter_jit(sdf.query.value_and_gradient)(shape, p))
    assert np.isfinite(f).all() and np.isfinite(g).all()
    assert (np.linalg.norm(g, axis=1) <= shape.lipschitz * (1 + 1e-9)).all()
    # Two points of different sign have surface between them, and so has any third.
    gap = np.linalg.norm(POINTS[:, None] - POINTS, axis=2)
    opposite = (f[:, None] < 0) != (f < 0)
    reach = np.where(opposite, gap, np.inf).min(axis=1)
    assert (np.abs(f) <= shape.lipschitz * reach + 1e-12).all()
    assert (np.abs(f[:, None] - f) <= shape.lipschitz * gap * (1 + 1e-9) + 1e-12).all()
    lower, upper = map(np.asarray, shape.bounding_box())
    inside = POINTS[f < 0]
    assert (inside >= lower - 1e-12).all() and (inside <= upper + 1e-12).all()


@settings(max_examples=10, deadline=None, derandomize=True, database=None)
@given(point, number, length)
def test_transforms_commute_with_evaluation(shift, angle, factor):
    star, p = sdf.Star(0.9, 0.4, 5), jnp.asarray(POINTS)
    c, s = np.cos(angle), np.sin(angle)
    turn = jnp.array([[c, -s], [s, c]])
    moved = sdf.translate(sdf.rotate(sdf.scale(star, factor), angle), shift)
    image = factor * p @ turn.T + jnp.array([shift])
    assert jnp.allclose(moved(image), factor * star(p), rtol=0, atol=1e-12)


def test_values_that_are_known():
    assert jnp.allclose(sdf.Box([-1] * 3, [1] * 3)(jnp.array([2.0, 2, 1])), 2**0.5)
    balls = [sdf.Sphere([c, 0, 0], 1) for c in (0, 1.2)]
    both, either = balls[0] & balls[1], balls[0] | balls[1]
    assert jnp.allclose(either(jnp.array([0.6, 0.3, 0])), -0.329179607)
    assert jnp.allclose(both(jnp.array([0.6, 1.2, 0])), 0.341640786)
    assert either.exactness == (True, False) and both.exactness == (False, True)
    blends = (sdf.Quadratic(), sdf.Cubic(), sdf.Circular(), sdf.Exponential(), sdf.Chamfer())
    for blend in blends:
        equal = jnp.array(0.1)
        sharp = equal * 2**0.5 if isinstance(blend, sdf.Chamfer) else equal
        assert jnp.allclose(blend(equal, equal, 0.3), sharp - 0.3 * blend.dip)


def test_second_moments_have_closed_forms_and_derivatives():
    square = sdf.rotate(sdf.Rectangle([-1, -1], [1, 1]), np.pi / 4)
    plate = sdf.translate(square - sdf.Circle([0, 0], 0.5), [0.3, -0.2])
    assert jnp.allclose(jnp.trace(sdf.second_moments(plate)), 2.568491896, rtol=1e-6)
    slope = jax.grad(lambda r: jnp.trace(sdf.second_moments(sdf.Circle([1, 0], r))))(0.7)
    assert jnp.allclose(slope, 2 * np.pi * 0.7**3, rtol=1e-5)


def test_curvature_and_frame_of_curved_bodies():
    p = jnp.array([[0.8, 0.7, 0.2], [-0.3, 0.2, 0.9]])
    ball = sdf.Sphere([0, 0, 0], 0.5)
    r = jnp.linalg.norm(p, axis=1)
    assert jnp.allclose(sdf.curvature(ball, p), 1 / r)
    assert jnp.allclose(sdf.gaussian_curvature(ball, p), 1 / r**2)
    assert jnp.allclose(
        sdf.curvature(sdf.Circle([0, 0], 0.5), p[:, :2]), 1 / jnp.linalg.norm(p[:, :2], axis=1)
    )
    axes = sdf.frame(ball, p)
    assert jnp.allclose(axes @ axes.mT, jnp.eye(3)[None], atol=1e-14)
    assert jnp.allclose(jnp.linalg.det(axes), 1)
    waist = jnp.array([[0.5, 0, 0]])  # inside of a torus: a saddle
    assert jnp.allclose(sdf.gaussian_curvature(sdf.Torus(0.8, 0.3), waist), -1 / 0.3 / 0.5)


def test_closest_point_of_a_bound_and_its_derivatives():
    p = jnp.array([[1.2, 0.5], [0.3, 0.9], [-0.6, 0.35]])

    @jax.jit
    def foot(a, p):
        return sdf.closest_point(sdf.stretch(sdf.Circle([0, 0], 1), jnp.stack([a, 0.5 * a])), p)

    exact = sdf.project(sdf.Ellipsoid([1.0, 0.5]), p)
    assert jnp.allclose(foot(jnp.array(1.0), p), exact, rtol=0, atol=1e-8)
    step = 1e-6
    central = (foot(jnp.array(1 + step), p) - foot(jnp.array(1 - step), p)) / (2 * step)
    for jacobian in (jax.jacfwd, jax.jacrev):
        assert jnp.allclose(jacobian(foot)(jnp.array(1.0), p), central, rtol=0, atol=1e-7)


def test_sampling_is_even_and_needs_a_key(getkey):
    ring = sdf.Ring(0.5, 1)
    p = sdf.sample_interior(ring, 4000, key=getkey())
    assert p.shape == (4000, 2) and (ring(p) < 0).all()
    assert jnp.abs(p.mean(axis=0)).max() < 0.05
    q = sdf.sample_boundary(ring, 4000, key=getkey())
    assert jnp.abs(ring(q)).max() < 1e-12
    outer = jnp.mean(jnp.linalg.norm(q, axis=1) > 0.75)
    assert jnp.abs(outer - 2 / 3) < 0.03
    nodes = sdf.grid(ring, 0.3)
    assert nodes.shape == (8, 8, 2) and jnp.allclose(nodes[-1, -1], 1)
    with pytest.raises(TypeError):
        sdf.sample_interior(ring, 10)


def test_many_points_compile_once_per_power_of_two(getkey):
    shape = sdf.Torus(0.7, 0.2) | sdf.Sphere([0, 0, 0], 0.3)
    every = np.asarray(jax.random.normal(getkey(), (128, 3)))
    one_by_one = jax.jit(lambda p: (shape(p), sdf.normal(shape, p)))
    value, normal = (np.asarray(a) for a in one_by_one(every))
    for count in (0, 1, 100, 128):
        p = every[:count]
        f, n = (np.asarray(a) for a in sdf.value_and_normal(shape, p))
        assert np.allclose(f, value[:count]) and np.allclose(sdf.evaluate(shape, p), f)
        assert np.allclose(n, normal[:count]) and n.shape == (count, 3)
        apart = value_and_normal_at(shape, tuple(p.T))
        assert np.array_equal(apart[0], f) and np.array_equal(np.stack(apart[1], -1), n)


def torus_mesh(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    i, j = (a.ravel() for a in np.mgrid[:n, :m])
    u, v = 2 * np.pi * i / n, 2 * np.pi * j / m
    r = 0.8 + 0.3 * np.cos(v)
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    corners = np.stack([r * np.cos(u), r * np.sin(u), 0.3 * np.sin(v)], axis=1)
    return corners, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_mesh_by_its_tree_is_as_by_every_face():
    vertices, faces = torus_mesh(12, 6)
    mesh = sdf.TriangleMesh(vertices, faces)
    p = np.random.default_rng(0).uniform(-1.3, 1.3, (700, 3))
    p[: len(vertices)] = 1.4 * vertices  # closest to corners
    p = jnp.asarray(p)

    @eqx.filter_jit
    def values(mesh, p):
        return sdf.query.value_and_gradient(mesh, p)

    moved = eqx.tree_at(lambda m: m.vertices, mesh, 1.1 * mesh.vertices[:, ::-1])
    for held in (mesh, moved):
        tree = held.tree
        every = eqx.tree_at(
            lambda m: m.tree, held, None, is_leaf=lambda t, tree=tree: t is tree
        )
        (f, g), (exact, slope) = values(held, p), values(every, p)
        assert jnp.allclose(f, exact, rtol=0, atol=1e-12)
        random = slice(len(vertices), None)  # the others may be as close to several faces
        assert jnp.allclose(g[random], slope[random], rtol=0, atol=1e-12)
    listed = sdf.TriangleMesh(vertices, faces, lists=True)
    q = jnp.where(jnp.arange(len(p))[:, None] < 650, p, 20 * p)  # some far outside
    plain = eqx.filter_jit(lambda mesh, p: mesh(p))
    for held in (listed, eqx.tree_at(lambda m: m.vertices, listed, moved.vertices)):
        exact = plain(eqx.tree_at(lambda m: m.tree, held, mesh.tree), q)
        assert jnp.allclose(plain(held, q), exact, rtol=0, atol=1e-12)
    loose = sdf.TriangleMesh(
        vertices[faces[:, ::-1]].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    )
    assert loose.tree is not None
    assert jnp.allclose(values(loose, p)[0], values(mesh, p)[0], rtol=0, atol=1e-12)
    assert sdf.TriangleMesh(vertices, faces[1:]).tree is None
    fine = sdf.isosurface(sdf.Sphere([0, 0, 0], 1), 0.1)
    with pytest.warns(UserWarning, match="leave gaps.*weld="):
        sdf.TriangleMesh(fine.vertices, fine.triangles[1:])


def test_middle_of_a_dense_ball_where_every_triangle_may_be_closest(getkey):
    vertices, faces = sdf.isosurface(sdf.Sphere([0.0, 0, 0], 1.0), size=0.04)
    mesh = sdf.TriangleMesh(vertices, faces, lists=True)
    assert len(faces) > 10_000 and not bool(jnp.all(mesh.tree.cells.whole))
    reach = jnp.repeat(jnp.array([1e-6, 0.1, 0.5, 0.9, 1.0, 1.5, 9.0]), 30)
    way = jax.random.normal(getkey(), (len(reach), 3))
    p = reach[:, None] * way / jnp.linalg.norm(way, axis=1, keepdims=True)
    found = eqx.filter_jit(jax.vmap(jax.value_and_grad(lambda p, mesh: mesh(p)), (0, None)))
    every = eqx.tree_at(lambda m: m.tree, mesh, None, is_leaf=lambda t: t is mesh.tree)
    for f, exact in zip(found(p, mesh), found(p, every), strict=True):
        assert jnp.allclose(f, exact, rtol=0, atol=1e-12)


def test_filled_up_rows_of_a_tree_name_no_triangle_more_than_twice(getkey):
    # 65 triangles fill 128 places: sixty-three copies of one made points near it slow.
    order = order_by_halving(np.asarray(jax.random.normal(getkey(), (65, 3))))
    assert set(np.bincount(order)) == {1, 2}


@pytest.mark.stress(37)
def test_parameters_have_finite_derivatives_at_ties_and_can_be_batched():
    p = jnp.array([[0.0, 0, 0], [0.5, 0.5, 0.5], [1, 0, 0], [0.3, 0.3, 0], [0.75, 0.75, 0.75]])

    def field(theta):
        block = sdf.Box(-jnp.stack([theta[0]] * 3), jnp.stack([theta[0]] * 3))
        ball = sdf.Sphere(jnp.zeros(3), theta[1])
        cut = (ball & block) - sdf.InfiniteCylinder(theta[2])
        return (cut | sdf.Pyramid(theta[1], theta[1]))(p)

    theta = jnp.array([0.75, 1.0, 0.5])
    slopes = jax.jit(lambda t: (jax.jacfwd(field)(t), jax.jacfwd(jax.jacrev(field))(t)))(theta)
    assert all(jnp.isfinite(s).all() for s in slopes)
    many = theta[None] * jnp.array([[1.0], [1.1], [0.9]])
    batched = jax.jit(jax.vmap(field))(many)
    assert jnp.allclose(batched, jnp.stack([field(t) for t in many]), rtol=0, atol=1e-14)


def test_new_numbers_do_not_retrace():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def value(shape, p):
        return shape(p)

    for k in (0.5, 1.0, 1.5):
        twisted = sdf.twist(sdf.Box([-1] * 3, [1, 1, k]), k)
        assert jnp.isfinite(value(twisted, jnp.zeros((4, 3)))).all()


@pytest.mark.parametrize(
    ("build", "remedy"),
    [
        (lambda: sdf.Star(np.nan, 0.5, 5), "above zero"),
        (lambda: sdf.Circle([np.nan, 0], 1), "Give real numbers"),
        (lambda: sdf.Polygon([[0, 0], [1, 1], [1, 0], [0, 1]]), "join several polygons"),
        (lambda: sdf.Polygon([[0, 0], [2, 0], [1, 0], [1, 1]]), "join several polygons"),
        (lambda: sdf.area(sdf.Circle([0, 0], 1) & sdf.Circle([5, 0], 1)), "overlap"),
        (lambda: sdf.SmoothUnion(sdf.Circle([0, 0], 1), sdf.Circle([0, 0], 1), 0), "sharp"),
        (lambda: sdf.bend(sdf.Box([-1] * 3, [1] * 3), 2), "Lower"),
        (lambda: sdf.taper(sdf.Box([-1] * 3, [1] * 3), 2), "Lower"),
        (lambda: sdf.image(np.zeros((4, 4)), 1.0), "threshold"),
        (lambda: sdf.RoundCone([0, 0], [0.1, 0], 1, 0.5), "Use a Circle"),
        (lambda: sdf.TriangleMesh(np.zeros((4, 3)), [[0, 1, 9]] * 4), "from zero"),
        (lambda: sdf.grid_repeat(sdf.Circle([0, 0], 1), [1, 1], (2,)), "one per axis"),
        (lambda: sdf.elongate(sdf.Circle([0, 0], 1), [-1, 1]), "shorten"),
        (lambda: sdf.text(" ", 1), "Write something"),
        (lambda: sdf.extrude(sdf.Sphere([0, 0, 0], 1), 1), "plane shape"),
    ],
)
def test_bad_input_names_the_remedy(build, remedy):
    with pytest.raises(ValueError, match=remedy):
        build()
