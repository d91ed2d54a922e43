"""The crawler of finite elements that a task reduces, and its training."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, fem, mesh, robots, systems
from sorojax._display import displayed
from sorojax.contact import DirectionalCoulomb
from sorojax.envs import solids
from sorojax.envs.tasks.crawl import MARKERS
from sorojax.material import neo_hookean
from sorojax.systems.blocks.modal_basis import coordinates
from sorojax.units import MPa, kPa, mm

CRAWLER = robots.Crawler(110 * mm, num_groups=2, foot_height=2 * mm)
PORTS, LENGTH = CRAWLER.ports, float(CRAWLER.length)
MAX_PRESSURE = 8 * kPa  # of the default supply, and of the training
FORWARD, BACKWARD = 0.3, 0.9  # coefficients of friction of the bristles of its feet
_SOFT, _STIFF, _POISSON, _DENSITY = 0.2 * MPa, 1 * MPa, 0.4, 1070.0  # body, sole
_VISCOUS = 1e-3  # retardation time of the rubber [s]
_SIZE, _MODES = 3 * mm, 20
_STEP, _LONG = 2e-3, 1.6  # of the motions of the training [s]
_RATE, _LAG = 1.25, np.pi / 2  # Hz, of gaits; between the groups, either way
_HELD, _DELAY, _DRAWN = 0.2, 0.05, 3  # [s] of drawn commands, and how many such motions
_EVERY = 4  # frames


@displayed
class SolidCrawler(eqx.Module):
    """A trained crawler: `solid_crawler()`.

    Attributes:
        mesh: Of the whole crawler, whose rear is at x = 0.
        reduced: The body in a few shapes, with the force of a few points, in contact.
        weight: Force on the modal coordinates by an acceleration of one along each axis.
    """

    mesh: mesh.Mesh
    reduced: systems.SampledBody
    weight: Float[Array, "2 modes"]

    def _text(self) -> str:
        return f"SolidCrawler: {self.mesh.num_cells} cells\n  {self.reduced!r}"


def solid_crawler(
    size: float = _SIZE, *, modes: int = _MODES, tolerance: float = 1e-2, keep: bool = True
) -> SolidCrawler:
    """The soft crawler of `SolidCrawl`, trained once and kept on this computer.

    The side view of a `robots.Crawler`, 110 mm long, in plane strain, free to move on three
    feet with bristles. It is trained on motions in which its two groups of chambers are filled
    in turns, from the rear and from the front, and at random.

    Args:
        size: Of the sides of its cells [m].
        modes: Number of shapes.
        tolerance: Of the choice of points, as of `systems.sampled_body`.
        keep: Read what an earlier call has kept, and keep what is trained; in
            `$SOROJAX_CACHE/trained`, by default `~/.cache/sorojax/trained`.

    Returns:
        The crawler. Reports the progress of a training.

    Raises:
        ValueError: If the size is not positive or there are too few shapes.
    """
    _check.positive("solid_crawler", "size", size, "m", "3e-3 is that of the task.")
    settings = size, modes, tolerance
    return solids.kept("solid_crawler", settings, Path(__file__), _trained, keep)


def full_crawler(
    size: float = _SIZE,
    *,
    stiffness: float = 1.0,
    density: float = 1.0,
    friction: float = 1.0,
    slope: float = 0.0,
) -> systems.FemBody:
    """The whole crawler, with factors of its rubber and its friction, on a floor that rises by
    `slope` [rad]."""
    rubbers = [
        neo_hookean(
            young_modulus=stiffness * young,
            poisson_ratio=_POISSON,
            density=density * _DENSITY,
        )
        for young in (_SOFT, _STIFF)
    ]
    bristles = DirectionalCoulomb(FORWARD * friction, BACKWARD * friction, [1.0, 0.0])
    problem = robots.crawler_problem(
        CRAWLER, size=size, rubbers=(rubbers[0], rubbers[1]), friction=bristles
    )
    down = -9.81 * jnp.asarray([np.sin(slope), np.cos(slope)])
    problem = eqx.tree_at(lambda p: p.loads[0].value, problem, down)
    top = float(CRAWLER.foot_height + CRAWLER.height)
    ends = {
        f"marker_{k}": mesh.nearest_node(problem.mesh, [LENGTH * k / (MARKERS - 1), top])
        for k in range(MARKERS)
    }
    damping = fem.Rayleigh(stiffness=_VISCOUS)
    return systems.FemBody(problem, damping, driven=PORTS, markers=ends)


def _trained(size: float, modes: int, tolerance: float) -> SolidCrawler:
    commands = [_gait(lag) for lag in (_LAG, -_LAG)] + [_drawn(k) for k in range(_DRAWN)]
    return trained_on(full_crawler(size), commands, modes, tolerance)


def trained_on(
    full: systems.FemBody,
    commands: Sequence[Float[Array, "ports times"]],
    modes: int,
    tolerance: float,
) -> SolidCrawler:
    """The crawler in shapes of motions under pressures [Pa] every 2 ms."""
    motions = []
    for pressures in commands:
        given = dict(zip(PORTS, pressures, strict=True))
        long = _STEP * (pressures.shape[1] - 1)
        motion = fem.simulate(full.problem, long, _STEP, damping=full.damping, **given)
        motions.append(motion.displacements[::_EVERY])
    reduced = systems.sampled_body(full, motions=motions, modes=modes, tolerance=tolerance)
    points = full.problem.mesh.points
    axes = [jnp.broadcast_to(axis, points.shape) for axis in jnp.eye(2)]
    # a translation is among the shapes, so its coordinates are the force of its acceleration
    weight = jnp.stack([coordinates(full, reduced.body.basis, axis) for axis in axes])
    return SolidCrawler(full.problem.mesh, reduced, weight)


def _times() -> np.ndarray:
    return _STEP * np.arange(round(_LONG / _STEP) + 1)


def _gait(lag: float) -> Float[Array, "ports times"]:
    """Half waves of pressure [Pa], one port after the other."""
    phase = 2 * np.pi * _RATE * _times()[None] - lag * np.arange(len(PORTS))[:, None]
    return jnp.asarray(MAX_PRESSURE * np.maximum(np.sin(phase), 0.0))


def _drawn(seed: int) -> Float[Array, "ports times"]:
    """Pressures [Pa] that follow commands drawn at random by a lag."""
    draw, count = np.random.default_rng(seed), round(_LONG / _HELD)
    wanted = MAX_PRESSURE * draw.uniform(0.0, 1.0, (count, len(PORTS)))
    number = np.minimum((_times() / _HELD).astype(int), count - 1)
    pressure = [np.zeros(len(PORTS))]
    for k in number[1:]:
        pressure.append(wanted[k] + (pressure[-1] - wanted[k]) * np.exp(-_STEP / _DELAY))
    return jnp.asarray(np.transpose(pressure))
