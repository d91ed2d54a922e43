"""Rods and assemblies: tubes with their real section, threads, directors, contact forces, and
given forces, moments and weight as arrows and arcs.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import _check, rod as R
from sorojax.rod import Assembly, Rod, Section
from sorojax.rod.model.link import is_massless
from sorojax.sdf import AbstractSdf, Surface as Triangles
from sorojax.view import style
from sorojax.view.draw.loads import turning
from sorojax.view.draw.rod_loads import (
    acting,
    contact_parts,
    outlines_of,
    part_and_force,
    section_outline,
    size_of,
    thread_parts,
)
from sorojax.view.draw.shapes import shape_scene, surface_scene
from sorojax.view.picture import Picture, plotted, spread
from sorojax.view.raster.glyphs import circle, tube
from sorojax.view.raster.scene import Arrows, Dots, Lines, Part, Scene, Surface, short
from sorojax.view.rigging.frames import pose_rows
from sorojax.view.rigging.rig import Rig, ellipsoid, pose as posed_rig
from sorojax.view.rigging.skin import bind, carried

_ALONG = 9  # arrows of a force per length
_LENGTH, _RADIUS = 0.2, 0.07  # of the body: the longest arrow, an arc

Poses = Mapping[str, Float[np.ndarray, "stations h h"]]


def wrench_parts(
    poses: Poses, s: Float[np.ndarray, " stations"], forces: Sequence[Any], size: float
) -> list[Part]:
    """The wrenches and the gravity among `forces`.

    Args:
        poses: Of the sections of every part, by name; "" where there is one rod.
        s: Where along a part they are, in [0, 1].
        forces: As given to the verbs of rods.
        size: Of the body [m]; arrows of one force share one scale, those of different
            forces do not compare.
    """
    parts: list[Part] = []
    for force in forces:
        name, inner = part_and_force(force)
        if isinstance(inner, R.Gravity):
            chosen = [poses[name]] if name else poses.values()
            parts += _weight(inner, [np.asarray(pose) for pose in chosen], size)
        elif isinstance(inner, R.TipWrench | R.PointWrench | R.LineWrench) and name in poses:
            parts += _wrench(inner, np.asarray(poses[name]), s, size)
    return parts


def _weight(gravity: R.Gravity, poses: list[np.ndarray], size: float) -> list[Part]:
    dim = poses[0].shape[1] - 1
    earth = np.zeros(dim)
    earth[-1] = -9.81
    value = earth if gravity.acceleration is None else np.asarray(gravity.acceleration)
    strength = float(np.linalg.norm(value))
    if not strength > 0:
        return []
    middle = np.mean([pose[:, :dim, dim].mean(axis=0) for pose in poses], axis=0)
    vector = value * (_LENGTH * size / strength)
    return [Arrows(middle[None], vector[None], style.GREY, f"gravity: {strength:.3g} m/s$^2$")]


def _wrench(force: Any, poses: np.ndarray, s: np.ndarray, size: float) -> list[Part]:
    """Arrows of the force and an arc of the moment, where they act."""
    dim = poses.shape[1] - 1
    spread = isinstance(force, R.LineWrench)
    at = np.linspace(0, 1, _ALONG) if spread else np.atleast_1d(float(getattr(force, "s", 1.0)))
    rows = _values(force.wrench, at)
    nearest = np.argmin(np.abs(at[:, None] - s[None]), axis=1)
    places = np.stack([np.interp(at, s, poses[:, k, dim]) for k in range(dim)], axis=1)
    moments, pulls = rows[:, :-dim], rows[:, -dim:]
    if getattr(force, "follower", False):
        turn = poses[nearest, :dim, :dim]
        pulls = np.einsum("sij,sj->si", turn, pulls)
        moments = np.einsum("sij,sj->si", turn, moments) if dim == 3 else moments
    per = "/m" if spread else ""
    parts: list[Part] = []
    strength = np.linalg.norm(pulls, axis=1)
    if (most := float(strength.max())) > 0:
        name = f"force: {short(most, 'N' + per)}"
        parts.append(Arrows(places, pulls * (_LENGTH * size / most), style.LOAD, name))
    strength = np.linalg.norm(moments, axis=1)
    if (most := float(strength.max())) > 0:
        name = f"moment: {short(most, 'N' if spread else 'N m')}"
        for k in np.flatnonzero(strength > 1e-9 * most):
            axis = moments[k] if dim == 3 else float(moments[k, 0])
            radius = _RADIUS * size * float(strength[k]) / most
            parts += turning(places[k], axis, radius, style.COLOURS[4], name)
    return parts


def _values(wrench: Any, at: np.ndarray) -> np.ndarray:
    """One row of components per place."""
    if callable(wrench):
        return np.asarray(jax.vmap(wrench)(jnp.asarray(at)))
    return np.broadcast_to(np.asarray(wrench), (len(at), *np.shape(wrench)))


# Rods and assemblies: tubes with their real section, threads, directors, contact forces


_STATIONS = 61
_SEE_THROUGH = 0.45

Shapes = Mapping[str, AbstractSdf | Triangles]


def rod_scene(
    model: Rod | Assembly,
    q: Float[Any, "*states coordinates"] | None = None,
    *,
    forces: Sequence[Any] = (),
    section: AbstractSdf | None = None,
    shapes: Shapes | None = None,
    colours: Mapping[str, str] | None = None,
    directors: bool = False,
    title: str = "",
) -> Scene:
    """A rod or an assembly of rods and links at coordinates `q`.

    Args:
        model: The rod or assembly.
        q: Coordinates; at rest if omitted. Several rows draw several states, the last in
            full.
        forces: As given to its verbs: tendons and chambers are drawn in their place,
            contacts as arrows with what is touched, wrenches and weight as arrows and arcs.
        section: Plane shape of the section (y, z), where constants do not tell it.
        shapes: Bodies of parts by name, a solid shape or triangles in the frame of the
            link or of the base of the rod at rest, which carries them as a skin; "rod" is the
            name of a single rod. Without one a rod is what its section sweeps, a link the
            ellipsoid of its inertia, and a frame without mass nothing.
        colours: Of parts by name, as matplotlib takes them.
        directors: Draw the axes of some sections, x red, y green, z blue.
        title: Title of the figure.
    """
    rest = R.rest(model)
    rows = np.atleast_2d(np.asarray(rest if q is None else q))
    do = f"Give one row per state: the model has {len(rest)} coordinates."
    _check.shape("view.show", "q", rows, (None, len(rest)), do)
    parts: list[Part] = []
    for k, row in enumerate(rows):
        last = k == len(rows) - 1
        shade = 0.0 if last else 0.75 - 0.5 * k / len(rows)
        parts += _state(
            model, row, forces if last else (), section, shapes, directors and last, shade,
            colours or {},
        )  # fmt: skip
    return Scene(tuple(parts), title=title)


def _state(
    model, q, forces, section, shapes, directors: bool, shade, colours: Mapping[str, str]
) -> list[Part]:
    s = np.linspace(0.0, 1.0, _STATIONS)
    poses = R.forward_kinematics(model, jnp.asarray(q, float), s)
    bodies: dict[str, Any] = {"": model}
    if isinstance(model, Assembly):
        bodies = dict(zip(model.names, [part.body for part in model.parts], strict=True))
    where = poses if isinstance(poses, dict) else {"": poses}
    found = acting(model, forces)
    inside = any(found.threads.values())
    opacity = _SEE_THROUGH if inside or directors else 1.0
    parts: list[Part] = []
    for name, body in bodies.items():
        pose = np.asarray(where[name])
        colour = style.pale(colours.get(name or "rod", style.BODY), shade)
        skin = (shapes or {}).get(name or "rod")
        if isinstance(body, Rod):
            if skin is None:
                parts += _rod(body, pose, s, section, colour, opacity)
            else:
                parts.append(_skinned(body, pose, skin, colour, opacity))
            parts += thread_parts(body, found.threads.get(name, ()), pose, s)
            if directors:
                parts += director_parts(pose[::10], 0.06 * float(body.length))
        else:
            parts += _link(name, body, pose[0], shapes, colour)
    parts += contact_parts(model, q, found)
    return parts + wrench_parts(where, s, forces, size_of(model))


def _rod(body: Rod, pose, s, section, colour: str, opacity: float) -> list[Part]:
    outer, hole = outlines_of(body, s, section)
    dim = pose.shape[1] - 1
    centres, turn = pose[:, :dim, dim], pose[:, :dim, :dim]
    if dim == 2:
        return _band(centres, turn[:, :, 1], outer[:, :, 0], hole, colour, opacity)
    across = np.swapaxes(turn[:, :, 1:], 1, 2)
    points, triangles = tube(centres, across, outer, inner=hole)
    return [Surface(points, triangles, colour, opacity=opacity)]


def _skinned(body: Rod, pose, shape, colour: str, opacity: float) -> Surface:
    """A shape that the rod carries, its sections at `pose`."""
    if pose.shape[1] != 4:
        raise ValueError(
            "view.show: got a shape for a planar rod, need a rod in SE3(). Draw it by a rod in "
            "space with the same coordinates."
        )
    surface = _surface_of(shape)
    skin = bind(surface.points, body, stations=_STATIONS)
    table = pose_rows(jnp.asarray(pose), np.array([_STATIONS - 1]))
    return Surface(np.asarray(carried(skin, table)), surface.triangles, colour, opacity=opacity)


def _surface_of(shape: AbstractSdf | Triangles) -> Surface:
    make: Any = shape_scene if isinstance(shape, AbstractSdf) else surface_scene
    return make(shape).parts[0]


def _band(centres, across, y, hole, colour: str, opacity: float) -> list[Part]:
    """A planar rod as what one sees from its side."""
    left = centres + y.max(axis=1)[:, None] * across
    right = centres + y.min(axis=1)[:, None] * across
    points, count = np.concatenate([left, right]), len(centres)
    a = np.arange(count - 1)
    triangles = np.concatenate(
        [np.stack([a + 1, a, a + count], 1), np.stack([a + 1, a + count, a + count + 1], 1)]
    )
    ring = np.concatenate([left, right[::-1], left[:1]])
    parts: list[Part] = [Surface(points, triangles, colour), Lines([ring], style.INK, 0.9)]
    if hole is not None:
        inner = hole[:, :, 0].max(axis=1)[:, None] * across
        parts.append(Lines([centres + inner, centres - inner], style.GREY, 0.8, dashed=True))
    if opacity < 1:
        parts.append(Lines([centres], style.GREY, 0.7, dashed=True))
    return parts


def _link(name: str, body, pose: np.ndarray, shapes: Shapes | None, colour: str) -> list[Part]:
    dim = pose.shape[0] - 1
    turn, place = pose[:dim, :dim], pose[:dim, dim]
    shape = (shapes or {}).get(name)
    if shape is not None:
        surface = _surface_of(shape)
        return [Surface(surface.points @ turn.T + place, surface.triangles, colour)]
    if is_massless(body):
        return []
    if dim == 2:
        centre = np.zeros(2) if body.center is None else np.asarray(body.center)
        radius = np.sqrt(2 * float(body.inertia) / float(body.mass))  # of a disc
        ring = turn @ centre + place + radius * circle(60)[[*range(60), 0]]
        fan = np.stack([np.arange(1, 59), np.arange(2, 60), np.zeros(58, int)], axis=1)
        return [Surface(ring, fan, colour), Lines([ring], style.INK, 0.9), Dots(place[None])]
    points, triangles = ellipsoid(body, 36, thinnest=0.2)
    return [Surface(points @ turn.T + place, triangles, colour)]


def director_parts(poses: Float[np.ndarray, "sections h h"], length: float) -> list[Part]:
    """The axes of some sections, `length` [m] long."""
    dim = poses.shape[1] - 1
    starts = poses[:, :dim, dim]
    return [
        Arrows(starts, length * poses[:, :dim, k], style.AXES[k], name=f"director {'xyz'[k]}")
        for k in range(dim)
    ]


# Bodies of networks and robots, where a search ended, rigs, sections


_POSES = 5  # that are drawn of a path


def body_scene(body: Any, q: Any = None, **options: Any) -> Scene:
    """The rod or assembly of a block with its forces, at its start; options of a rod."""
    model = body.rod if hasattr(body, "rod") else body.assembly
    q = body.q if q is None else q
    return rod_scene(model, q, **({"forces": body.forces} | options))


def model_scene(model: Any, q: Any = None, **options: Any) -> Scene:
    """The body of a model of a robot; options of a rod. Its `network` is a diagram."""
    return body_scene(model.network.blocks["body"], q, **options)


def posed_scene(found: Any, *, model: Rod | Assembly, title: str = "", **options: Any) -> Scene:
    """A rod or an assembly where a search ended: at rest under its forces, or at a target.

    Args:
        found: From `rod.equilibrium`, `rod.inverse_kinematics` or a path of them.
        model: What was searched.
        title: Title of the figure; how the search ended if omitted.
        **options: As of a rod.
    """
    q = np.asarray(found.q)
    if q.ndim == 2 and len(q) > _POSES:
        q = q[spread(len(q), _POSES)]
    return rod_scene(model, q, title=title or _outcome(found), **options)


def _outcome(found: Any) -> str:
    """The error or the load factor that a search ended with."""
    if getattr(found, "error", None) is not None:
        return f"error {float(found.error):.3g}"
    factors = np.asarray(getattr(found, "factors", ()))
    is_row = factors.ndim == 1 and factors.size > 0
    return f"load factor to {float(factors[-1]):.4g}" if is_row else ""


def rig_scene(
    rig: Rig, q: Float[Any, " coordinates"] | None = None, *, title: str = ""
) -> Scene:
    """The surface of a rig at coordinates `q`, at rest if omitted."""
    triangles = np.asarray(rig.triangles)
    surface = Surface(np.asarray(posed_rig(rig, q)), triangles)
    text = f"{len(triangles)} triangles on {type(rig.model).__name__.lower()}"
    return Scene((surface,), title=title or text)


def show_section(section: Section, *, title: str = "") -> Picture:
    """A cross-section with its constants; of the middle node if it varies."""
    outer, hole = section_outline(section)
    figure = style.new_figure(5.0, 4.4)
    axes = figure.add_subplot()
    axes.fill(*(1e3 * outer.T), color=style.BODY, ec=style.INK, lw=1.0)
    if hole is not None:
        axes.fill(*(1e3 * hole.T), color="white", ec=style.INK, lw=1.0)
    style.dress_plane(
        axes, 1e3 * outer.min(axis=0), 1e3 * outer.max(axis=0), "local y [mm]", "local z [mm]"
    )
    facts = [f"A {1e6 * float(np.median(section.area)):.4g} mm$^2$"]
    for name, constant in (
        ("$I_y$", section.second_moment_y),
        ("$I_z$", section.second_moment_z),
        ("J", section.torsion_constant),
    ):
        facts.append(f"{name} {1e12 * float(np.median(constant)):.4g} mm$^4$")
    axes.set_title("   ".join(facts), fontsize=style.SMALL - 1, color=style.INK)
    return plotted(figure, [axes], title)
