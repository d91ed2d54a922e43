"""Every primitive, lattice and operator: distance, slope, box and derivatives."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from sorojax import sdf
from sorojax._jax.jit import once
from sorojax.sdf.sampling import value_and_gradient

pytestmark = pytest.mark.quick

TRIANGLE = sdf.triangle([0.3, -0.2], [0.9, 0.1], [0.5, 0.3])
BAR = sdf.Box([-1, -0.2, -0.3], [1, 0.3, 0.3])
TALL = sdf.Box([-0.5, -0.3, -0.8], [0.4, 0.3, 0.8])
DISC, BLOCK = sdf.Circle([-0.4, 0], 0.5), sdf.Rectangle([0, -0.3], [0.8, 0.4])
SEEDS = np.random.default_rng(0).uniform(-1.5, 1.5, (12, 3))
ROWS, COLUMNS = np.mgrid[:40, :40]
DIAMOND = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
FACES = [[i, (i + 1) % 4, 4] for i in range(4)] + [[(i + 1) % 4, i, 5] for i in range(4)]
PLANE = {
    "polygon": sdf.RegularPolygon(1, 5), "star": sdf.Star(1, 0.5, 5), "ring": sdf.Ring(0.5, 1),
    "arc": sdf.Arc(0.8, 2, 0.2), "pie": sdf.Pie(1, 1), "wide_pie": sdf.Pie(1, 2.5),
    "vesica": sdf.Vesica(0.8, 1.6), "squircle": sdf.Squircle(1, 4), "triangle": TRIANGLE,
    "trapezoid": sdf.trapezoid(1.4, 0.6, 1), "slab": sdf.Slab([0, 0.1], [0, 1], 0.3),
    "strut": sdf.Strut([-0.5, -0.5], [0.5, 0.6], 0.3), "stadium": sdf.stadium(2, 0.6),
    "uneven_capsule": sdf.RoundCone([-0.3, -0.3], [0.6, 0.6], 0.5, 0.2),
    "polyline": sdf.Polyline([[-1, -1], [0, 0.5], [1, -1]], 0.1),
    "bezier": sdf.Bezier([[-1, -1], [0, 1.5], [1, -0.2]], 0.1),
    "parabola": sdf.Parabola(1.3, 0.8, 0.2), "ellipse": sdf.Ellipsoid([1, 0.4]),
    "spline": sdf.Spline([[-1, -1], [-0.5, 0.5], [0.5, -0.5], [1, 0.8]], 0.1),
    "foam": sdf.VoronoiFoam(SEEDS[:, :2], 0.1), "mirror": sdf.mirror(TRIANGLE, [1, 0.5]),
    "image": sdf.image((COLUMNS - 20) ** 2 + (ROWS - 18) ** 2 < 120, 0.05, [-1, -1]),
    "outlines": sdf.outlines([[[-1, -1], [1, -1], [0.8, 1], [-1, 0.7]],
                              [[-0.5, -0.5], [-0.4, 0.4], [0.5, -0.3]]]),
    "grid": sdf.grid_repeat(TRIANGLE, [0.7, 0.3], (2, 3)),
    "elongate": sdf.elongate(TRIANGLE, [0.3, 0.4]), "polar": sdf.polar_repeat(TRIANGLE, 13),
    "morph": sdf.morph(BLOCK, DISC, 0.4), "stretch": sdf.stretch(sdf.Star(1, 0.5, 5), [1, 0.5]),
    "displace": sdf.displace(DISC, sdf.Waves(0.1, 0.5)),
    "cubic": sdf.SmoothUnion(DISC, BLOCK, 0.3, sdf.Cubic()),
    "circular": sdf.SmoothUnion(DISC, BLOCK, 0.3, sdf.Circular()),
    "exponential": sdf.SmoothUnion(DISC, BLOCK, 0.1, sdf.Exponential()),
    "chamfer": sdf.SmoothUnion(DISC, BLOCK, 0.3, sdf.Chamfer()),
    "smooth_cut": sdf.SmoothDifference(DISC, BLOCK, 0.2, sdf.Cubic()),
    "smooth_both": sdf.SmoothIntersection(sdf.Circle([0, 0], 0.8), BLOCK, 0.2),
}  # fmt: skip
SOLID = {
    "half_space": sdf.HalfSpace([0, 0.1, 0], [0, 1, 1]),
    "strut": sdf.Strut([-0.5, -0.5, 0], [0.5, 0.6, 0.3], 0.3),
    "capsule": sdf.Capsule([-0.5, -0.5, 0], [0.5, 0.6, 0.3], 0.3),
    "round_cone": sdf.RoundCone([-0.3, -0.3, 0], [0.6, 0.6, 0.1], 0.5, 0.2),
    "polyline": sdf.Polyline([[-1, -1, 0], [0, 0.5, 0.3], [1, -1, -0.5]], 0.2),
    "bezier": sdf.Bezier([[-1, -1, 0], [0, 1.5, 0.3], [1, -0.2, 0.4]], 0.1),
    "helix": sdf.Helix(0.6, 0.4, 2.3, 0.1), "ellipsoid": sdf.Ellipsoid([1, 0.4, 0.7]),
    "frame": sdf.BoxFrame([1.2, 1.4, 2], 0.3), "torus": sdf.Torus(0.8, 0.3),
    "capped_torus": sdf.CappedTorus(0.8, 0.3, 1.2), "pipe": sdf.InfiniteCylinder(0.7),
    "cylinder": sdf.Cylinder(0.8, 1, 0.2), "capped_cone": sdf.CappedCone(0.9, 0.3, 1.2),
    "cone": sdf.Cone(0.9, 1.6), "prism": sdf.HexagonalPrism(0.9, 1),
    "octahedron": sdf.Octahedron(1), "pyramid": sdf.Pyramid(1.4, 1.2),
    "mesh": sdf.TriangleMesh(DIAMOND, FACES), "extrude": sdf.extrude(TRIANGLE, 0.8),
    "revolve": sdf.revolve(sdf.Circle([0.8, 0.1], 0.3)), "turn": sdf.turn(BAR, [1, 2, 3], 0.7),
    "twist": sdf.twist(TALL, 2), "taper": sdf.taper(TALL, 0.5), "bend": sdf.bend(BAR, 1.2),
    "bent_back": sdf.bend(BAR, -1.2), "straight": sdf.bend(BAR, 0),
    "bcc": sdf.BccLattice(0.8, 0.1), "octet": sdf.OctetLattice(0.8, 0.1),
    "kelvin": sdf.KelvinLattice(0.8, 0.1), "foam": sdf.VoronoiFoam(SEEDS, 0.1),
    "gyroid": sdf.Gyroid(0.8, 0.1), "schwarz": sdf.SchwarzP(0.8, 0.1),
    "diamond": sdf.Diamond(0.8, 0.1), "neovius": sdf.Neovius(0.8, 0.1),
    "lidinoid": sdf.Lidinoid(0.8, 0.1), "iwp": sdf.Iwp(0.8, 0.1),
    "heights": sdf.HeightMap(
        0.2 * np.sin(ROWS / 5) * np.cos(COLUMNS / 4), [-1, -1], [0.05, 0.05]
    ),
}  # fmt: skip
GALLERY = {2: PLANE, 3: SOLID}
CASES = [(dim, name) for dim, shapes in GALLERY.items() for name in shapes]


def kinks(dim: int) -> np.ndarray:
    eye = np.eye(dim)
    return np.concatenate([np.zeros((1, dim)), eye, -eye, eye / 2, np.full((1, dim), 0.5)])


@once
def looked_at(shape, p):
    """Value, slope and change of the slope along one direction, in one program."""
    way = jnp.broadcast_to(jnp.array([1.0, 0.7, -0.4])[: shape.dim], p.shape)
    (f, g), (_, change) = jax.jvp(lambda p: value_and_gradient(shape, p), (p,), (way,))
    return f, g, change


@pytest.mark.stress(90)
@pytest.mark.parametrize(("dim", "name"), CASES)
def test_change_of_the_slope_is_that_of_its_differences(dim, name):
    shape, h = GALLERY[dim][name], 1e-5
    p = np.random.default_rng(2).uniform(-1.6, 1.6, (2048, dim))
    way = np.array([1.0, 0.7, -0.4])[:dim]
    back, ahead = (
        np.asarray(looked_at(shape, jnp.asarray(p + k * h * way))[1]) for k in (-1, 1)
    )
    seen, change = (ahead - back) / (2 * h), np.asarray(looked_at(shape, jnp.asarray(p))[2])
    size = np.linalg.norm(change, axis=1)
    smooth = np.linalg.norm(seen, axis=1) < 0.1 / h  # no kink lies between
    error = np.linalg.norm(seen - change, axis=1)
    assert smooth.mean() > 0.98
    assert np.quantile(error[smooth] / (1 + size[smooth]), 0.98) < 1e-5


@pytest.mark.parametrize(("dim", "name"), CASES)
def test_shape_is_a_distance_or_an_honest_bound(dim, name):
    shape = GALLERY[dim][name]
    rng = np.random.default_rng(1)
    p = rng.uniform(-1.6, 1.6, (2048, dim))
    p[: len(kinks(dim))] = kinks(dim)
    q = p + rng.normal(size=p.shape) * rng.choice([0.01, 0.1, 1], (len(p), 1))
    (f, g, second), (other, _, _) = (
        jax.tree.map(np.asarray, looked_at(shape, jnp.asarray(x))) for x in (p, q)
    )
    assert np.isfinite(f).all() and np.isfinite(g).all() and np.isfinite(second).all()
    slope = np.linalg.norm(g, axis=1)
    away = slice(len(kinks(dim)), None)  # off the kinks, almost surely
    assert (slope[away] <= shape.lipschitz * (1 + 1e-9)).all()
    gap = np.linalg.norm(p - q, axis=1)
    assert (np.abs(f - other) <= shape.lipschitz * gap * (1 + 1e-9) + 1e-12).all()
    lower, upper = map(np.asarray, shape.bounding_box())
    inside = p[f < 0]
    assert len(inside) and (inside >= lower - 1e-12).all() and (inside <= upper + 1e-12).all()
    for level in (0.1, 0.5):
        lower, upper = map(np.asarray, shape.level_box(level))
        below = p[f < level]
        assert (below >= lower - 1e-12).all() and (below <= upper + 1e-12).all()
    for exact, side in zip(shape.exactness, (f[away] > 1e-9, f[away] < -1e-9), strict=True):
        if exact:
            assert np.abs(slope[away][side] - 1).max(initial=0) < 1e-9
    check_reach(shape, p[away], f[away], g[away])


def check_reach(shape, p, f, g):
    """From the tip of an exact distance along its slope lies the surface; none is nearer."""
    if shape.exactness.outside:
        foot = p - f[:, None] * g
        outside = (f > 0) & (np.linalg.norm(g, axis=1) > 0.5)
        at_foot = np.asarray(looked_at(shape, jnp.asarray(foot))[0])
        assert np.abs(at_foot[outside]).max() < 1e-7
        nearest = cKDTree(foot[outside]).query(p)[0]
        assert (np.abs(f) <= shape.lipschitz * nearest + 1e-7).all()


@pytest.mark.parametrize("lattice", [sdf.Gyroid, sdf.SchwarzP, sdf.Diamond])
def test_lattice_slope_bound_is_proven(lattice):
    """Branch and bound: no cell of a period may hold a slope 2 % above the bound."""
    gradient = jax.jit(jax.grad(lambda p: lattice(1, 0.1).surface(*p).sum()))
    half, second = np.pi / 16, 4.0  # no second derivative of these sums exceeds 4
    axis = -np.pi + half * (2 * np.arange(16) + 1)
    centers = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), -1).reshape(-1, 3)
    while len(centers):
        rows = 1 << (len(centers) - 1).bit_length()
        padded = np.pad(centers, ((0, rows - len(centers)), (0, 0)))
        g = np.asarray(gradient(jnp.asarray(padded.T))).T[: len(centers)]
        most = np.linalg.norm(g, axis=1) + second * half * np.sqrt(3)
        centers = centers[most > 1.02 * lattice.bound]
        centers = (centers[:, None] + half * corner).reshape(-1, 3)
        half /= 2
        assert half > 1e-4


@pytest.mark.parametrize(
    "lattice",
    [sdf.Gyroid, sdf.SchwarzP, sdf.Diamond, sdf.Neovius, sdf.Lidinoid, sdf.Iwp],
)
def test_lattice_slope_climbs_to_its_bound(lattice):
    def square(p):
        return jnp.sum(jax.grad(lambda p: lattice(1, 0.1).surface(*p).sum())(p) ** 2, axis=0)

    @jax.jit
    def climb(p):
        rate = 1 / (40 * lattice.bound**2)
        up = jax.grad(lambda p: square(p).sum())
        return square(jax.lax.fori_loop(0, 1500, lambda _, p: p + rate * up(p), p)) ** 0.5

    top = climb(jnp.asarray(np.random.default_rng(0).uniform(0, 6.3, (3, 512)))).max()
    assert 0.98 < top / lattice.bound < 1 + 1e-9


@pytest.mark.parametrize("sense", [1, -1])
def test_gradient_on_an_outline_points_out(sense):
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[::sense]
    frame = sdf.outlines([square, 0.25 + square[::-1] / 2, 0.4 + square / 5])
    sides = np.array([[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5]])
    out = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    for place, way in ((sides, out), (0.25 + sides / 2, -out), (0.4 + sides / 5, out)):
        assert np.allclose(sdf.gradient(frame, jnp.asarray(place)), way)


def test_one_outline_is_a_shape():
    square = sdf.outlines([np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])])
    assert np.isclose(square(jnp.array([0.5, 0.4])), -0.4)


class Lens(sdf.AbstractSdf):
    """What the docstring of the base asks for, and no more: a field that is a bound."""

    half: float
    dim: ClassVar[int] = 2

    def distance(self, x, y):
        return (jnp.abs(x) + jnp.abs(y) - self.half) / 2

    def bounding_box(self):
        return jnp.full(2, -self.half), jnp.full(2, self.half)


def test_a_hole_can_be_cut_into_a_shape_of_ones_own():
    lower, upper = (Lens(1.0) - sdf.Circle([0.0, 0.0], 0.2)).bounding_box()
    assert np.array_equal([lower, upper], [[-1.0, -1.0], [1.0, 1.0]])
    assert not np.isfinite(Lens(1.0).level_box(0.1)[0]).any()  # a bound may stay small
