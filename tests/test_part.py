"""From densities to a part: volumes, boundaries, copies, files, and what it performs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import design, fem, io, material, mesh, sdf
from sorojax._progress import silent

GRID = mesh.rectangle([0, 0], [1.0, 1.0], divisions=(16, 16), element=mesh.Quad4())


def centres(grid):
    return np.asarray(grid.points)[np.asarray(grid.cells)].mean(axis=1)


def disc(grid, radius, centre):
    """Densities that fall from 1 to 0 over a cell around a circle or sphere."""
    cell = float(design.field.cell_sizes(grid)[0]) ** (1 / grid.element.dim)
    away = np.linalg.norm(centres(grid) - centre, axis=1) - radius
    return np.clip(0.5 - away / cell, 0, 1)


def test_a_disc_comes_back_with_its_area_and_its_boundary():
    density = disc(GRID, 0.3, [0.5, 0.5])
    made = design.part(GRID, density)
    wanted = density.mean()
    assert made.volume == pytest.approx(wanted, rel=1e-6)
    assert made.wanted == pytest.approx(wanted, rel=1e-12)
    assert float(sdf.area(made.cell)) == pytest.approx(wanted, rel=1e-3)
    radius = np.sqrt(wanted / np.pi)
    angle = np.linspace(0, 2 * np.pi, 60)
    rim = 0.5 + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.abs(made.shape(jnp.asarray(rim))).max() < 0.08 / 16
    assert made.dropped == 0 and 0 < made.threshold < 1
    # a smooth field: no corner along the rim, where the mesher would put nodes
    assert not any(curve.corner.any() for curve in sdf.contour(made.shape, 0.02))
    smaller = design.part(GRID, density, volume=0.2)
    assert float(sdf.area(smaller.cell)) == pytest.approx(0.2, rel=1e-3)


def test_islands_and_pinholes_are_dropped_and_the_domain_cuts():
    density = disc(GRID, 0.4, [0.0, 0.5])
    for place, value in (([0.1875, 0.5], 0.0), ([0.875, 0.875], 1.0)):
        away = np.linalg.norm(centres(GRID) - place, axis=1)
        density[np.argsort(away)[:4]] = value
    made = design.part(GRID, density, detail=0.15)
    assert 0 < made.dropped < 0.08
    (outline,) = sdf.contour(made.cell, 0.02)
    assert outline.corner.sum() == 2 and np.abs(outline.points[outline.corner, 0]).max() < 1e-9
    assert made.volume == pytest.approx(density.mean(), rel=1e-3)
    assert len(sdf.contour(design.part(GRID, density, keep=None, detail=0.0).cell, 0.02)) == 3


def test_copies_have_no_seam():
    density = disc(GRID, 0.45, [0.0, 0.5])
    folds = (design.Mirror(0, 0.0), design.Repeat(0, 2), design.Mirror(1, 1.0))
    made = design.part(GRID, density, folds=folds, keep=None)
    lower, upper = made.shape.bounding_box()
    assert np.allclose(lower, [-1, 0]) and np.allclose(upper, [3, 2])
    curves = sdf.contour(made.shape, 0.03)
    assert len(curves) == 4 and not any(curve.corner.any() for curve in curves)
    assert float(sdf.area(made.shape)) == pytest.approx(8 * made.volume, rel=1e-3)
    inside = jnp.array([[0.2, 0.6], [-0.2, 0.6], [2.2, 1.4], [1.8, 1.4]])
    assert np.ptp(made.shape(inside)) < 1e-3 and np.all(made.shape(inside) < -0.1)


def test_a_ball_in_space_prints():
    grid = mesh.box([0, 0, 0], [1.0, 1.0, 1.0], divisions=(8, 8, 8), element=mesh.Hex8())
    density = disc(grid, 0.45, [0.0, 0.5, 0.5])
    made = design.part(grid, density, folds=(design.Mirror(0, 0.0),), spacing=0.1)
    surface = sdf.isosurface(design.solid(made), 0.08)
    report = sdf.surface_report(surface)
    assert report.watertight and report.num_shells == 1 and report.genus == 0
    # flat triangles of 0.08 lie inside a ball of 0.45: 2 % less
    assert report.volume == pytest.approx(2 * made.volume, rel=0.03)


def test_wrong_calls_are_refused():
    whole = mesh.triangulate(sdf.Circle([0, 0], 1.0), size=0.4)
    with pytest.raises(ValueError, match="Pass it as `domain`"):
        design.part(whole, np.ones(whole.num_cells) * 0.5)
    with pytest.raises(ValueError, match="share between 0 and 1"):
        design.part(GRID, np.ones(256), volume=1.5)
    with pytest.raises(ValueError, match="need `whole`"):
        design.part(
            GRID,
            disc(GRID, 0.3, [0, 0]),
            folds=(design.Mirror(0, 0.0),),
            domain=sdf.Circle([0, 0], 2.0),
        )
    with pytest.raises(ValueError, match="shape \\(3,\\)"):
        design.part(GRID, np.ones(3))
    with pytest.raises(ValueError, match="thickness"):
        design.solid(design.part(GRID, disc(GRID, 0.3, [0.5, 0.5])))
    with pytest.raises(ValueError, match="2-D or 3-D grid"):
        design.SplineField(np.zeros(4), [0.0], 0.1)


RUBBER = material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3)
LENGTH, HEIGHT = 30.0, 10.0


def beam(cells):
    """A cantilever under a force spread over the middle fifth of its end."""
    end = mesh.nodes_where(
        cells, lambda p: (p[0] > LENGTH - 1e-9) & (jnp.abs(p[1] - HEIGHT / 2) < 1 + 1e-9)
    )
    return fem.problem(
        cells,
        RUBBER,
        kinematics=fem.PlaneStress(1.0),
        formulation=fem.Displacement(),
        supports=(fem.Fixed(mesh.nodes_where(cells, lambda p: p[0] < 1e-9)),),
        loads=(fem.Force(end, [0.0, -1.0]),),
    )


@pytest.fixture(scope="module")
def layout():
    grid = mesh.rectangle([0, 0], [LENGTH, HEIGHT], divisions=(30, 10), element=mesh.Quad4())
    model = design.linear(beam(grid))
    smooth, interpolation = design.cone_filter(grid, 2.4), design.Simp(3.0, 1e-6)

    def density(x, sharpness):
        return design.heaviside_projection(smooth(x), sharpness)

    loss = jax.jit(lambda x, b: design.compliance(model, interpolation(density(x, b))))
    volume = jax.jit(lambda x, b: jnp.mean(density(x, b)) - 0.5)
    with silent():
        found = design.minimise(
            loss,
            jnp.full(300, 0.5),
            constraints=(volume,),
            steps=48,
            optimiser=design.MMA(0.0, 1.0, move=0.2),
            schedule=lambda k: (jnp.asarray(min(2.0 ** (k // 8), 32.0)),),
        )
    return grid, np.asarray(density(found.design, 32.0)), float(found.objective)


def stiffness(cells):
    model = design.linear(beam(cells))
    return float(design.compliance(model, jnp.ones(cells.num_cells)))


def test_a_layout_becomes_a_part_that_performs_as_promised(layout, tmp_path):
    grid, density, promised = layout
    made = design.part(grid, density, folds=(design.Mirror(0, 0.0),))
    assert made.volume == pytest.approx(LENGTH * HEIGHT * 0.5, rel=2e-3)
    surface = sdf.isosurface(design.solid(made, 5.0), 0.5, "dual_contouring")
    report = design.reanalyse(made, stiffness, promised, size=0.8, order=2, surface=surface)
    assert report.ratio == pytest.approx(1.0, abs=0.05)
    assert report.quality.area == pytest.approx(made.volume, rel=2e-3)
    assert report.quality.watertight and report.surface.watertight
    assert report.surface.num_shells == 1
    assert report.surface.volume == pytest.approx(2 * 5.0 * made.volume, rel=0.01)
    assert "watertight" in str(report) and "promised" in str(report)
    io.export_surface(tmp_path / "beam.stl", surface)
    back = io.import_surface(tmp_path / "beam.stl")
    assert sdf.surface_report(back).watertight
