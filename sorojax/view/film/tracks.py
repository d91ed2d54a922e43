"""From results that move to the scenes of a film."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.design import History
from sorojax.fem.equilibrium.solve import Path
from sorojax.fem.stability.modal import Modes
from sorojax.mesh import Mesh
from sorojax.rod import Assembly, Rod
from sorojax.rod.dynamics.rollout import Trajectory as RodTrajectory
from sorojax.sdf import AbstractSdf
from sorojax.systems import AssemblyBody, Network, RodBody, Trajectory
from sorojax.view.draw.bodies import body_scenes, problems_of
from sorojax.view.draw.meshes import AMPLITUDE, Body, on_triangles, scaled_mode, shell
from sorojax.view.draw.rods import rod_scene
from sorojax.view.film.animation import Track
from sorojax.view.raster.scene import Scale, Scene, Surface, robust_scale


def track_of(result: Any, **options: Any) -> Track:
    """The scenes of a result; options are those of the kind of result."""
    if isinstance(result, Track):
        return result
    if isinstance(result, Path | fem.Trajectory):
        return _body_track(result, **options)
    if isinstance(result, Modes):
        return _mode_track(result, **options)
    if isinstance(result, History):
        return _layout_track(result, **options)
    if isinstance(result, RodTrajectory):
        return _rod_track(np.asarray(result.time), np.asarray(result.q), **options)
    if isinstance(result, Trajectory):
        return _network_track(result, **options)
    raise TypeError(
        f"view.animate: got a {type(result).__name__}, need a Trajectory, Path, Modes, "
        "History or Track. Make a Track of scenes for what else moves."
    )


def positions_track(
    mesh: Mesh,
    positions: Float[Any, "instants nodes dim"],
    time: Float[Any, " instants"],
    *,
    field: Float[Any, "instants values"] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    name: str = "",
) -> Track:
    """A film of a mesh whose nodes are at `positions` [m], e.g. a skin or measured points."""
    body, moved = Body(mesh), np.asarray(positions)
    rows = None if field is None else np.asarray(field)
    scale = None if rows is None else robust_scale(label, list(rows), limits=limits)

    def scene(k: int) -> Scene:
        return Scene(tuple(body.parts(moved[k], None if rows is None else rows[k])), scale)

    flat = moved.reshape(-1, moved.shape[-1])
    box = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    return Track(np.asarray(time, float), scene, scale, extent=box, name=name)


def _body_track(result: Any, *, loads: bool = False, **options: Any) -> Track:
    """A body in motion, or along a load path with the value of the load in the place of
    time."""
    points, moved = np.asarray(result.problem.mesh.points), np.asarray(result.displacements)
    problems = problems_of(result, range(len(moved)))
    scene, scale = body_scenes(problems, moved, loads=loads, **options)
    flat = np.concatenate([points, (points + moved).reshape(-1, points.shape[1])])
    box = flat.min(axis=0), flat.max(axis=0)
    time, unit = _clock(result)
    return Track(time, scene, scale, unit, extent=None if loads else box)


def _layout_track(history: History, *, name: str = "") -> Track:
    """Densities step by step, black where there is material."""
    mesh, rows = history.mesh, history.densities
    points, seen = np.asarray(mesh.points), shell(mesh)
    scale = Scale("density [-]", 0.0, 1.0, colours="Greys")

    def scene(k: int) -> Scene:
        body = Surface(points, seen.triangles, values=on_triangles(mesh, seen, rows[k]))
        return Scene((body,), scale)

    box = points.min(axis=0), points.max(axis=0)
    return Track(np.asarray(history.steps, float), scene, scale, "steps", box, name)


def _clock(result: Any) -> tuple[np.ndarray, str]:
    """Times of a motion; along a path its number where the load does not just rise."""
    if isinstance(result, fem.Trajectory):
        return np.asarray(result.time), "s"
    if result.pressures is not None:
        volumes = 1e6 * np.asarray(result.values)
        return (volumes, "ml") if np.all(np.diff(volumes) > 0) else _steps(len(volumes))
    values = np.asarray(result.values, float)
    if values.ndim == 1 and np.all(np.diff(values) > 0):
        load = next((x for x in result.problem.loads if x.name == result.name), None)
        if isinstance(load, fem.Pressure):
            return values / 1e3, "kPa"
        return values, result.name or "of the load"
    return _steps(len(values))


def _steps(count: int) -> tuple[np.ndarray, str]:
    return np.arange(count, dtype=float), "steps"


def _mode_track(modes: Modes, *, mode: int = 0, share: float = 0.12, cycles: int = 2) -> Track:
    """One mode swinging `cycles` times, a second each."""
    body = Body(modes.problem.mesh)
    points = np.asarray(modes.problem.mesh.points) + np.asarray(modes.displacement)
    swing, amplitude = scaled_mode(points, np.asarray(modes.shapes[mode]), share)
    time = np.arange(40 * cycles + 1) / 40

    def scene(k: int) -> Scene:
        moved = points + np.sin(2 * np.pi * time[k]) * swing
        return Scene(tuple(body.parts(moved, amplitude)), AMPLITUDE)

    both = np.concatenate([points + swing, points - swing])
    name = f"mode {mode + 1}: {float(modes.frequencies[mode]):.4g} Hz, slowed down"
    return Track(time, scene, AMPLITUDE, "", (both.min(axis=0), both.max(axis=0)), name)


def _rod_track(
    time: np.ndarray, q: np.ndarray, *, model: Rod | Assembly | None = None, **options: Any
) -> Track:
    if model is None:
        raise ValueError(
            "view.animate: the trajectory of a rod holds coordinates only. Pass model=, the "
            "rod or assembly that moved."
        )
    held = model

    @functools.lru_cache(maxsize=4)
    def scene(k: int) -> Scene:
        return rod_scene(held, q[k], **options)

    return Track(time, scene)


def _network_track(
    film: Trajectory,
    *,
    network: Network | None = None,
    model: Rod | Assembly | None = None,
    block: str | None = None,
    skin: AbstractSdf | Mesh | None = None,
    **options: Any,
) -> Track:
    """The body of a network, `block` of them; with a `skin` drawn as the plane body that
    the rod carries."""
    if network is None and model is None:
        raise ValueError(
            "view.animate: a Trajectory holds states only. Pass network=, what was simulated, "
            "or model=, the rod."
        )
    blocks = {} if network is None else network.blocks
    bodies = {k: part for k, part in blocks.items() if isinstance(part, RodBody | AssemblyBody)}
    moving = (k for k, state in film.state.items() if isinstance(state, dict) and "q" in state)
    name = block or next(iter(bodies), None) or next(moving)
    if model is None:
        if name not in bodies:
            raise ValueError(
                f"view.animate: the network has the bodies {', '.join(bodies) or 'none'}, got "
                f"block={block!r}. Pass block= or model=."
            )
        part: Any = bodies[name]
        model = part.rod if isinstance(part, RodBody) else part.assembly
        options.setdefault("forces", part.forces)
    time, q = np.asarray(film.time), np.asarray(film.state[name]["q"])
    if skin is not None:
        assert isinstance(model, Rod)
        return _skinned(model, skin, time, q)
    return _rod_track(time, q, model=model, **options)


def _skinned(rod: Rod, skin: AbstractSdf | Mesh, time, q) -> Track:
    """A plane body that starts where the rod does and lies along x."""
    import jax
    import jax.numpy as jnp

    from sorojax.math.lie import homogeneous
    from sorojax.mesh import triangulate
    from sorojax.view.rigging.skin import bind, deform

    if isinstance(skin, Mesh):
        mesh = skin
    else:
        lower, upper = (np.asarray(corner) for corner in skin.bounding_box())
        mesh = triangulate(skin, size=float(np.max(upper - lower)) / 60)
    points = np.asarray(mesh.points)
    middle = (points[:, 1].min() + points[:, 1].max()) / 2
    start = np.array([points[:, 0].min(), middle])
    bound = bind(mesh.points, rod, base=homogeneous(jnp.eye(2), jnp.asarray(start)))
    moved = jax.vmap(lambda row: deform(bound, rod, row))(jnp.asarray(q))
    return positions_track(mesh, np.asarray(moved), time)
