"""Every kernel in single precision: what it is asked, and the digits that it keeps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import csg
from benchmarks.blocks import bent, block
from benchmarks.fingers import LENGTH, finger, random_states
from benchmarks.hands import hand
from sorojax import fem, material, mesh, rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.sdf.query import value_and_normal_at


class Kernel(NamedTuple):
    """A kernel and its arguments in double precision; the largest error that it may have in
    single precision, over `unit`, or over the largest entry of the result if that is None."""

    function: Callable[..., Any]
    args: tuple
    bound: float
    unit: float | None = None


def narrow(tree: Any) -> Any:
    """The same in single precision."""

    def cast(x: Any) -> Any:
        return x.astype(jnp.float32) if eqx.is_inexact_array(x) else x

    return jax.tree.map(cast, tree)


def compiled(kernel: Kernel, single: bool = True) -> Callable[[], Any]:
    """The kernel with its arguments in one precision, to be compiled at its first call."""
    function, args = eqx.filter_jit(kernel.function), kernel.args
    args = narrow(args) if single else args
    return lambda: function(*args)


def error(kernel: Kernel) -> float:
    """Largest difference of the two precisions, over the unit of the kernel.

    Raises:
        TypeError: If something of the result is not of single precision.
    """
    got, want = compiled(kernel)(), compiled(kernel, single=False)()
    worst = 0.0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        if a.dtype != jnp.float32:
            raise TypeError(
                f"single.error: got {a.dtype} of a kernel, need float32 throughout."
            )
        a, b = np.asarray(a, np.float64), np.asarray(b)
        unit = kernel.unit or np.abs(b).max() or 1.0
        worst = max(worst, float(np.abs(a - b).max() / unit))
    return worst


def _finger():
    (q,), (v,) = random_states(1)
    return finger(8), jnp.asarray(q), jnp.asarray(v)


def _accelerate(body, q, v):
    t: Any = jnp.zeros((), q.dtype)
    return R.forward_dynamics(body, q, v, (R.Gravity(),), t=t)


def _pressed(body, floor, q, v):
    return R.vector_field(body, (floor,))(jnp.zeros((), q.dtype), (q, v))[1]


def _missed(body, target, q):
    return R.inverse_kinematics(body, target, q, iterations=10).error


def _rod_kernels() -> dict[str, Callable[[], Kernel]]:
    def contact():
        body, q, v = _finger()
        law = LinePenalty(stiffness=5e7, smoothing=6e-6)
        ground = sdf.HalfSpace([0.0, 0.0, -0.01], [0.0, 0.0, 1.0])
        floor = R.ObstacleContact(obstacle=ground, radius=6e-3, law=law, points=16)
        return Kernel(_pressed, (body, floor, q, v), 1e-3)

    def reach():
        body, q, _ = _finger()
        target = R.Pose(R.tip_pose(body, 0.5 * q))
        return Kernel(_missed, (body, target, jnp.zeros_like(q)), 1e-4, LENGTH)

    def jacobian():
        body, q, _ = _finger()
        return Kernel(R.jacobian, (body, q, jnp.array([0.5, 1.0])), 2e-6)

    return {
        "rod.tip_pose": lambda: Kernel(R.tip_pose, _finger()[:2], 1e-6),
        "rod.jacobian": jacobian,
        "rod.mass_matrix": lambda: Kernel(R.mass_matrix, _finger()[:2], 2e-6),
        "rod.forward_dynamics": lambda: Kernel(_accelerate, _finger(), 8e-4),
        "rod contact": contact,
        "rod.inverse_kinematics": reach,
    }


def _stress(rubber):
    draw = np.random.default_rng(0).normal(size=(3, 3))
    stress = material.first_piola_kirchhoff_stress
    return lambda: Kernel(stress, (rubber, jnp.asarray(np.eye(3) + 0.2 * draw)), 1e-6, 5e6)


def _stiffness(problem, prepared, u):
    return linearise(problem, prepared, u, u).values


def _forces(problem, prepared, u):
    return linearise(problem, prepared, u, u).residual


def _body(element, function, bound: float):
    def make():
        problem = block(element, (6,) * element.dim)
        u = bent(problem.mesh.points)
        if function is fem.potential_energy:
            return Kernel(function, (problem, u), bound)
        return Kernel(function, (problem, prepare(problem), u), bound)

    return make


def _sdf(normal: bool):
    def normals(shape, *x):
        return jnp.stack(value_and_normal_at(shape, x)[1])

    def make():
        points = jnp.asarray(csg.points(np.float64)[:4096])
        if normal:
            return Kernel(normals, (csg.solid(), *points.T), 1e-6, 1.0)
        return Kernel(sdf.evaluate, (csg.solid(), points), 5e-7, 1.0)

    return make


def _network() -> Kernel:
    def rate(network, state):
        t = jnp.zeros((), jax.tree.leaves(state)[0].dtype)
        return network.vector_field(t, state)

    network = hand()
    return Kernel(rate, (network, network.initial_state()), 2e-3)


#: Those that a device without double precision would run. The bounds are some ten units of
#: rounding times what the kernel multiplies them by: the condition of its mass matrix (four
#: units, `tests/test_rod.py`), the stiffness of its contact, or, of forces of a solid, what the
#: rounding of 1 + grad u becomes by lambda + 2 mu on a face, over the largest force. A field
#: needs 8.4 units at worst: coordinates, squares, their sums and root at 2.1 from the centre.
KERNELS: dict[str, Callable[[], Kernel]] = {
    "sdf value": _sdf(normal=False),
    "sdf normal": _sdf(normal=True),
    **_rod_kernels(),
    "material.NeoHookean": _stress(material.NeoHookean(1e5, 5e6)),
    "material.Ogden": _stress(material.Ogden((6e4, 3e2, -5e3), (1.7, 4.3, -2.2), 5e6)),
    "fem tangent, Quad4": _body(mesh.Quad4(), _stiffness, 1e-6),
    "fem tangent, Tet10": _body(mesh.Tet10(), _stiffness, 1e-6),
    "fem forces, Quad4": _body(mesh.Quad4(), _forces, 1.2e-5),
    "fem forces, Tet10": _body(mesh.Tet10(), _forces, 1.2e-5),
    "fem energy, Tet10": _body(mesh.Tet10(), fem.potential_energy, 1e-5),
    "network of five fingers": _network,
}


def kernel(name: str) -> Kernel:
    """The kernel called `name`, with its arguments."""
    return KERNELS[name]()
