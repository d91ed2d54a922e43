"""Signed distances: closed forms, slopes at kinks, derivatives, measures, contours."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import sdf
from sorojax.sdf.operations.booleans import Intersection, Union

SQUARE = sdf.Rectangle([-1, -1], [1, 1])
SHAPES = [
    sdf.Circle([0, 0], 1),
    SQUARE,
    sdf.Rectangle([-1, -1], [1, 1], 0.3),
    sdf.HalfPlane([0, 0], [1, 2]),
    sdf.Polygon([[-1, -1], [1, -1], [1, 1], [-1, 1]]),
    SQUARE | sdf.Circle([1, 0], 0.5),
    SQUARE & sdf.Circle([1, 0], 0.5),
    SQUARE - sdf.Circle([1, 0], 0.5),
    sdf.SmoothUnion(SQUARE, sdf.Circle([1, 0], 0.5), 0.2),
    sdf.repeat(SQUARE, [3, 0], 4),
    sdf.shell(sdf.rotate(sdf.scale(sdf.offset(SQUARE, 0.1), 2), 0.3), 0.2),
]
evaluate = eqx.filter_jit(lambda shape, p: shape(p))
KINKS = [[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [1.0, 0.0], [1.5, 0.0], [-1.0, -1.0], [2.5, 0.0]]


@pytest.mark.parametrize("shape", [SQUARE, SHAPES[4]])
def test_box_distance_is_euclidean_at_corners_and_inside(shape):
    p = jnp.array([[2.0, 2.0], [0.0, 0.25], [1.5, 0.0], [1.0, 0.3]])
    assert jnp.allclose(
        evaluate(shape, p), jnp.array([2**0.5, -0.75, 0.5, 0]), rtol=0, atol=1e-15
    )


@pytest.mark.versions
def test_operators_and_their_aliases_agree():
    a, b = SQUARE, sdf.Circle([1, 0], 0.5)
    p = jnp.array([[0.9, 0.1], [1.2, 0.2], [0.0, 0.0], [2.0, 2.0]])
    assert jnp.array_equal((a | b)(p), (a + b)(p))
    assert jnp.array_equal((a & b)(p), (a / b)(p))
    assert jnp.array_equal((a - b)(p), jnp.maximum(a(p), -b(p)))


def test_smooth_union_dips_by_a_quarter_of_k_at_equal_distance():
    blend = sdf.SmoothUnion(sdf.Circle([-1, 0], 0.5), sdf.Circle([1, 0], 0.5), 0.2)
    assert jnp.allclose(blend(jnp.zeros(2)), 0.5 - 0.05, rtol=1e-14)


@pytest.mark.parametrize("step", [[3.0, 0.0], [1.5, 0.5]])
def test_repeat_is_the_union_of_its_copies(step, getkey):
    part = sdf.Polygon([[0, 0], [2, 0], [0.2, 1.4]])
    copies = sdf.union(*(sdf.translate(part, i * jnp.array(step)) for i in range(6)))
    row = sdf.repeat(part, step, 6)
    p = jax.random.uniform(getkey(), (2000, 2), minval=-5, maxval=20)
    assert jnp.allclose(evaluate(row, p), evaluate(copies, p), rtol=0, atol=1e-12)


def test_repeat_has_one_tree_in_and_out_of_a_trace():
    def row(width, separate=None):
        part = sdf.Rectangle(jnp.zeros(2), jnp.stack([width, width]))
        return sdf.repeat(part, [3.0, 0.0], 4, separate=separate)

    for separate in (True, False):
        inside = jax.jit(lambda w, separate=separate: row(w, separate))(jnp.array(1.0))
        outside = row(jnp.array(1.0), separate)
        assert jax.tree.structure(inside) == jax.tree.structure(outside)
    with pytest.raises(ValueError, match="separate=True"):
        jax.jit(row)(jnp.array(1.0))


def test_grid_repeat_is_the_union_of_its_copies(getkey):
    part = sdf.Polygon([[0, 0], [2, 0], [0.2, 1.4]])
    moves = [jnp.array([1.5 * i, 0.9 * j]) for i in range(3) for j in range(2)]
    copies = sdf.union(*(sdf.translate(part, move) for move in moves))
    p = jax.random.uniform(getkey(), (2000, 2), minval=-2, maxval=7)
    grid = sdf.grid_repeat(part, [1.5, 0.9], (3, 2))
    assert jnp.allclose(evaluate(grid, p), evaluate(copies, p), rtol=0, atol=1e-12)


def test_elongated_disc_is_a_rounded_rectangle_inside_too(getkey):
    p = jax.random.uniform(getkey(), (2000, 2), minval=-3, maxval=3)
    drawn = sdf.elongate(sdf.Circle([0, 0], 0.5), [3.0, 2.0])
    assert jnp.allclose(
        evaluate(drawn, p),
        evaluate(sdf.Rectangle([-2, -1.5], [2, 1.5], 0.5), p),
        rtol=0,
        atol=1e-14,
    )


def test_text_has_the_area_and_the_holes_of_its_letters():
    letters = sdf.text("O8", 0.1)
    assert len(letters.starts) == 5
    x, y = np.asarray(letters.vertices).T
    ends = [*letters.starts[1:], len(x)]
    areas = [
        0.5 * (x[a:b] * np.roll(y[a:b], -1) - y[a:b] * np.roll(x[a:b], -1)).sum()
        for a, b in zip(letters.starts, ends, strict=True)
    ]
    assert jnp.allclose(sdf.area(letters), abs(sum(areas)), rtol=1e-5)
    middle = jnp.array([[0.5 * (x[: ends[0]].min() + x[: ends[0]].max()), 0.0365]])
    assert letters(middle) > 0.02 > letters(jnp.array([[1.0, 1.0]])) - 2


@pytest.mark.parametrize("order", [sdf.Pyramid(1.4, 1.2), sdf.OctetLattice(0.8, 0.1)])
def test_slope_at_a_tie_of_two_coordinates_is_that_of_one_side(order):
    p = jnp.array([[0.5, 0.5, 0.5], [0.3, 0.3, 0.1], [0.1, 0.27, 0.27], [0.25, 0.1, 0.25]])
    _, slope = eqx.filter_jit(sdf.query.value_and_gradient)(order, p)
    assert jnp.allclose(jnp.linalg.norm(slope, axis=1), 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.stress(37)
def test_first_and_second_derivatives_are_finite_at_kinks(shape):
    @eqx.filter_jit
    def derivatives(shape, p):
        return sdf.normal(shape, p), jax.vmap(jax.jacfwd(jax.grad(shape)))(p)

    assert all(jnp.isfinite(d).all() for d in derivatives(shape, jnp.array(KINKS)))


@pytest.mark.parametrize("shape", SHAPES)
def test_field_respects_its_lipschitz_constant_and_transformations(shape, getkey):
    p = jax.random.uniform(getkey(), (500, 2), minval=-3, maxval=9)
    q = p + 0.1 * jax.random.normal(getkey(), (500, 2))
    bound = shape.lipschitz * jnp.linalg.norm(p - q, axis=1)
    f = evaluate(shape, p)
    assert (jnp.abs(f - evaluate(shape, q)) <= bound + 1e-12).all()
    assert jnp.allclose(jax.jit(jax.vmap(shape))(p), f, rtol=0, atol=1e-14)
    assert jax.eval_shape(shape, p.astype(jnp.float32)).dtype == jnp.float32


@pytest.mark.versions
def test_project_lands_on_the_surface_and_is_differentiable():
    @jax.jit
    def foot(radius, p):
        return sdf.project(sdf.Rectangle([-2, -1], [2, 1], radius), p)

    p = jnp.array([[2.3, 1.2], [1.9, 0.8], [1.0, 1.4], [2.2, 0.1]])
    x = foot(0.5, p)
    assert jnp.abs(sdf.Rectangle([-2, -1], [2, 1], 0.5)(x)).max() < 1e-15
    step = 1e-6
    exact = jax.jacfwd(foot)(0.5, p)
    central = (foot(0.5 + step, p) - foot(0.5 - step, p)) / (2 * step)
    assert jnp.allclose(exact, central, rtol=0, atol=1e-8)
    assert jnp.allclose(jax.jacrev(foot)(0.5, p), exact, rtol=0, atol=1e-12)
    spread = jnp.ones_like(p)
    _, exact = jax.jvp(lambda p: foot(0.5, p), (p,), (spread,))
    central = (foot(0.5, p + step) - foot(0.5, p - step)) / (2 * step)
    assert jnp.allclose(exact, central, rtol=0, atol=1e-8)


def test_area_and_centroid_have_closed_forms_and_derivatives():
    ring = sdf.Circle([2, 1], 1) - sdf.Circle([2, 1], 0.5)
    assert jnp.allclose(sdf.area(ring), 0.75 * jnp.pi, rtol=1e-6)
    assert jnp.allclose(sdf.centroid(ring), jnp.array([2.0, 1.0]), rtol=1e-9)
    ell = sdf.Polygon([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
    assert jnp.allclose(sdf.area(ell), 3, rtol=1e-6)
    assert jnp.allclose(sdf.centroid(ell), 5 / 6, rtol=1e-6)
    slope = jax.grad(lambda r: sdf.area(sdf.Circle([0, 0], r)))(0.7)
    assert jnp.allclose(slope, 2 * jnp.pi * 0.7, rtol=1e-5)


def test_contour_locates_corners_and_keeps_the_inside_on_the_left():
    shape = sdf.rotate(SQUARE, 0.3) - sdf.Circle([0, 0], 0.5)
    outer, hole = sorted(sdf.contour(shape, 0.05), key=lambda c: -len(c.points))
    c, s = np.cos(0.3), np.sin(0.3)
    want = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ np.array([[c, s], [-s, c]])
    found = outer.points[outer.corner]
    gap = np.linalg.norm(found[:, None] - want, axis=2).min(axis=1)
    assert len(found) == 4 and gap.max() < 1e-12
    assert not hole.corner.any()
    for curve, sign in ((outer, 1), (hole, -1)):
        x, y = curve.points.T
        doubled = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
        assert np.sign(doubled) == sign
        assert np.abs(np.asarray(shape(jnp.asarray(curve.points)))).max() < 1e-14


@pytest.mark.versions
def test_numbers_do_not_retrace():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def value(shape, p):
        return shape(p)

    shape = SQUARE - sdf.Circle([0, 0], 0.5)
    for radius in (0.4, 0.6, 1):
        edited = sj.replace(shape, lambda s: s.removed.radius, radius)
        assert jnp.allclose(value(edited, jnp.zeros(2)), radius)


def test_messages_name_the_remedy():
    with pytest.raises(ValueError, match="needs"):
        SQUARE(jnp.zeros(3))
    with pytest.raises(ValueError, match="above zero"):
        sdf.Circle([0, 0], -1)
    with pytest.raises(ValueError, match="Intersect it"):
        sdf.area(sdf.HalfPlane([0, 0], [1, 0]))
    apart = sdf.Circle([0, 0], 1) & sdf.Circle([1.5, 1.5], 1)
    for verb in (sdf.area, lambda shape: sdf.contour(shape, 0.1)):
        with pytest.raises(ValueError, match="empty"):
            verb(apart)


def test_a_combination_of_one_shape_is_that_shape():
    ball = sdf.Sphere([0.0, 0.0, 0.0], 1.0)
    for both in (Intersection((ball,)), Union((ball,))):
        assert both.dim == 3 and both(jnp.zeros(3)) == -1.0
