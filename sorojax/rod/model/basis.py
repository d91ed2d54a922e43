"""Strain bases: the modes of each active strain, orthonormal or as a user gives them, by
functions of s or by samples."""

import abc
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.math.quadrature import Quadrature, array_module, gauss_legendre

Points: TypeAlias = Float[Array, " points"] | np.ndarray

STRAINS = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")


class AbstractModes(eqx.Module):
    """Shape functions of one strain over the normalised arc length s in [0, 1].

    `count` is the number of modes. Modes that jump or kink name the places in `breaks`:
    the rod then integrates between them.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        count: ClassVar[int]

    @property
    @abc.abstractmethod
    def resolution(self) -> int:
        """Number of Gauss nodes between breaks that resolves the modes."""

    @property
    def breaks(self) -> tuple[float, ...]:
        """Where the modes are not smooth, rising inside (0, 1)."""
        return ()

    @property
    def least(self) -> int:
        """Gauss nodes between breaks below which modes cannot be distinguished."""
        return -(-self.count // (len(self.breaks) + 1))

    @abc.abstractmethod
    def __call__(self, s: Points) -> Float[Array, "points modes"]:
        """Values at `s`; a NumPy `s` may give NumPy values, which become constants."""


@displayed
class StrainBasis(eqx.Module):
    """`modes` of each active strain by name; a strain that is not named has no coordinate.

    The coordinates are ordered by strain (`kappa_x kappa_y kappa_z sigma_x sigma_y
    sigma_z`), then by mode: [1/m] for curvatures, [-] for stretch and shear, times the
    value of the mode.
    """

    modes: dict[str, AbstractModes]

    def __check_init__(self):
        unknown = sorted(self.modes.keys() - set(STRAINS))
        if unknown or not self.modes:
            raise ValueError(
                f"StrainBasis: got the strains {unknown or 'none'}, need one or more of "
                f"{', '.join(STRAINS)}. Curvatures are kappa, stretch is sigma_x."
            )
        for name, modes in self.modes.items():
            if isinstance(modes, int | float | str | list | tuple):
                raise ValueError(
                    f"StrainBasis: `{name}` is {modes!r}, need modes such as Chebyshev(3). "
                    f"To choose a number of modes write chebyshev({name}=3)."
                )

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active strains, in coordinate order."""
        return tuple(name for name in STRAINS if name in self.modes)

    @property
    def num_dof(self) -> int:
        return sum(modes.count for modes in self.modes.values())

    @property
    def resolution(self) -> int:
        """Number of Gauss nodes between breaks that resolves all modes."""
        return max(modes.resolution for modes in self.modes.values())

    @property
    def breaks(self) -> tuple[float, ...]:
        """Where any of the modes is not smooth."""
        return merged(*(modes.breaks for modes in self.modes.values()))

    def __or__(self, other: "StrainBasis") -> "StrainBasis":
        """Both bases together; `other` wins where both name a strain."""
        return StrainBasis({**self.modes, **other.modes})

    def __call__(self, s: Points) -> Any:
        """Values at `s`, (active, points, dof), zero outside a strain's own columns."""
        rows, offset = [], 0
        for name in self.active:
            modes = self.modes[name]
            values, behind = modes(s), self.num_dof - offset - modes.count
            rows.append(array_module(values).pad(values, ((0, 0), (offset, behind))))
            offset += modes.count
        is_traced = any(isinstance(row, jax.Array) for row in rows)
        return jnp.stack(rows) if is_traced else np.stack(rows)


def columns(basis: StrainBasis, name: str) -> slice:
    """Where the coordinates of strain `name` lie in q.

    Args:
        basis: The strain basis.
        name: Of an active strain, `kappa_z` for example.

    Returns:
        A slice of q.
    """
    if name not in basis.modes:
        raise ValueError(
            f"columns: the strain `{name}` is not active, need one of "
            f"{', '.join(basis.active)}. Add it to the basis to give it coordinates."
        )
    start = 0
    for other in basis.active[: basis.active.index(name)]:
        start += basis.modes[other].count
    return slice(start, start + basis.modes[name].count)


def each_count(where: str, counts: dict[str, Any]) -> dict[str, int]:
    """Numbers of modes per strain, checked."""
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(
                f"{where}: `{name}` must be a number of modes, 1 or more, got {count!r}. "
                "Leave the strain out to keep it at rest."
            )
    return {name: int(count) for name, count in counts.items()}


def merged(*breaks: tuple[float, ...]) -> tuple[float, ...]:
    """All the breaks, rising; those closer than rounding are one."""
    found: list[float] = []
    for place in sorted(place for some in breaks for place in some):
        if not found or place - found[-1] > 1e-9:
            found.append(place)
    return tuple(found)


def checked_breaks(where: str, breaks: Any) -> tuple[float, ...]:
    """`breaks` as numbers that rise strictly inside (0, 1)."""
    numbers = np.asarray(breaks, float).reshape(-1)
    fits = np.all(np.isfinite(numbers)) and np.all(np.diff(numbers) > 0)
    if not fits or (numbers.size and not 0 < numbers[0] <= numbers[-1] < 1):
        raise ValueError(
            f"{where}: the breaks are {numbers.tolist()}, need numbers that rise strictly "
            "inside (0, 1). Divide arc lengths [m] by the length of the rod."
        )
    return tuple(numbers.tolist())


class SampledModes(AbstractModes):
    """Data-driven modes, linear between samples and constant beyond the first and last.

    A mode is differentiable in its values. Sampled modes need as many Gauss nodes as
    their ripples, not as their number; `fitted` makes smooth ones of them.
    """

    s: Float[Array, " samples"] = eqx.field(converter=real)
    values: Float[Array, "samples modes"] = eqx.field(converter=real)

    def __check_init__(self):
        do = "Give s in [0, 1] and one column per mode, as `values[sample, mode]`."
        _check.shape("SampledModes", "values", self.values, (len(self.s), None), do)
        _check.finite("SampledModes", "values", self.values, "Check the snapshots.")
        if _check.is_concrete(self.s) and not _is_grid(np.asarray(self.s)):
            raise ValueError(
                "SampledModes: `s` must rise strictly inside [0, 1], got "
                f"{np.array2string(np.asarray(self.s), threshold=6)}. Divide the arc "
                "length [m] by the length of the backbone."
            )

    @property
    def count(self) -> int:
        return self.values.shape[1]

    @property
    def resolution(self) -> int:
        return min(48, max(8, self.s.shape[0] // 4))

    def __call__(self, s):
        return _interpolated(self.s, self.values, jnp.asarray(s, dtype=self.s.dtype))


@jax.jit
def _interpolated(s: Array, values: Array, at: Array) -> Float[Array, "points modes"]:
    """Linear between samples, constant beyond the first and last."""
    return jax.vmap(jnp.interp, (None, None, 1), 1)(at, s, values)


def _as_function(given: Any) -> Any:
    """A pytree that can be called, so that the numbers in a module stay differentiable."""
    if isinstance(given, list | tuple):
        return _Stacked(tuple(_as_function(one) for one in given))
    return given if isinstance(given, eqx.Module) else jax.tree_util.Partial(given)


class _Stacked(eqx.Module):
    """One column per function."""

    functions: tuple[Callable, ...]

    def __call__(self, s):
        rows = [f(s) for f in self.functions]
        if any(np.shape(row) != np.shape(s) for row in rows):
            shapes = ", ".join(str(np.shape(row)) for row in rows)
            raise ValueError(
                f"functions: {np.size(s)} points gave values of shapes {shapes}, need "
                f"{np.shape(s)} of each mode. Return one value per point, of a constant mode "
                "np.ones_like(s)."
            )
        xp = jnp if any(isinstance(row, jax.Array) for row in rows) else np
        return xp.stack([xp.asarray(row) for row in rows], axis=1)


class Functions(AbstractModes):
    """Modes by a user function of s: points in, (points, modes) out.

    Attributes:
        function: A function of an array of points. An `eqx.Module` is differentiable in
            its numbers.
        count: Number of modes.
        nodes: Gauss nodes between joints that resolve the modes; None for count + 6.
        joints: Where the modes jump or kink.
    """

    function: Callable = eqx.field(converter=_as_function)
    count: int = eqx.field(static=True)
    nodes: int | None = eqx.field(static=True, default=None)
    joints: tuple[float, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        checked_breaks("Functions", self.joints)
        shape = np.shape(self.function(np.array([0.25, 0.5, 0.75])))
        if shape != (3, self.count) or self.count < 1:
            raise ValueError(
                f"Functions: 3 points gave values of shape {shape}, need (3, {self.count}). "
                "Stack the modes along axis 1, or give one function per mode."
            )

    @property
    def breaks(self) -> tuple[float, ...]:
        return self.joints

    @property
    def resolution(self) -> int:
        return max(8, self.count + 6) if self.nodes is None else self.nodes

    def __call__(self, s):
        return self.function(s)


def functions(
    *,
    nodes: int | None = None,
    breaks: Sequence[float] = (),
    **modes: Callable | Sequence[Callable],
) -> StrainBasis:
    """Modes of your own per strain: `functions(kappa_z=[lambda s: s, lambda s: s**2])`.

    Args:
        nodes: Gauss nodes between breaks that resolve them; 8 or more by default.
        breaks: Where they jump or kink, in (0, 1).
        modes: A function from points to (points, modes), or one function per mode.

    Returns:
        The basis; a coordinate has the unit of its strain, [1/m] or [-].

    Raises:
        ValueError: If a function gives another shape.
    """
    joints = checked_breaks("functions", breaks)
    own = {name: _as_function(f) for name, f in modes.items()}
    return StrainBasis({name: _functions(f, nodes, joints) for name, f in own.items()})


def _functions(function: Any, nodes: int | None, joints: tuple[float, ...]) -> Functions:
    shape = np.shape(function(np.array([0.25, 0.5, 0.75])))
    if shape[:1] != (3,) or len(shape) > 2:
        raise ValueError(
            f"functions: 3 points gave values of shape {shape}, need (3,) or (3, modes). "
            "Return one value per point, of a constant mode np.ones_like(s)."
        )
    count = shape[1] if len(shape) == 2 else 1
    return Functions(function=function, count=count, nodes=nodes, joints=joints)


def _is_grid(s: np.ndarray) -> bool:
    rises = s.ndim == 1 and s.size > 1 and bool(np.all(np.diff(s) > 0))
    return rises and s[0] >= 0 and s[-1] <= 1 + 1e-12


# Combinations of modes: orthonormal ones, and smooth ones fitted to samples


class Combined(AbstractModes):
    """Linear combinations of other modes, one per column of `mix`."""

    inner: AbstractModes
    mix: Float[Array, "inner modes"] | np.ndarray

    def __check_init__(self):
        shape = jnp.shape(self.mix)
        if len(shape) != 2 or shape[0] != self.inner.count or shape[1] < 1:
            raise ValueError(
                f"Combined: `mix` has shape {shape}, need ({self.inner.count}, modes). Give "
                "one row per mode of `inner`."
            )

    @property
    def count(self) -> int:
        return self.mix.shape[1]

    @property
    def breaks(self) -> tuple[float, ...]:
        return self.inner.breaks

    @property
    def resolution(self) -> int:
        return self.inner.resolution

    def __call__(self, s):
        values = self.inner(s)
        if isinstance(values, jax.Array) or isinstance(self.mix, jax.Array):
            return jnp.asarray(values) @ jnp.asarray(self.mix, values.dtype)
        return values @ self.mix


def orthonormalise(basis: StrainBasis) -> StrainBasis:
    """The modes of each strain made orthonormal: integral of f_i f_j over [0, 1] = delta_ij.

    They span what the modes of `basis` span, and mode k uses the first k of them only.

    Args:
        basis: The strain basis.

    Returns:
        The basis that spans the same strains.

    Raises:
        ValueError: If the modes of a strain depend on each other.
    """
    return StrainBasis({name: _orthonormal(name, modes) for name, modes in basis.modes.items()})


def _orthonormal(name: str, modes: AbstractModes) -> Combined:
    s, w = gauss_legendre(_exact_rule(modes))
    values = modes(s)
    # QR keeps twice the digits of a Cholesky factor of the Gram matrix.
    if is_traced(values):
        factor = jnp.linalg.qr(jnp.sqrt(jnp.asarray(w, values.dtype))[:, None] * values)[1]
        return Combined(modes, jnp.linalg.inv(factor * jnp.sign(jnp.diagonal(factor))[:, None]))
    factor = np.linalg.qr(np.sqrt(w)[:, None] * np.asarray(values, np.float64))[1]
    _check_independent(name, np.diag(factor))
    mix = np.linalg.inv(factor * np.sign(np.diag(factor))[:, None])
    is_on_device = isinstance(values, jax.Array)
    return Combined(modes, jnp.asarray(mix, values.dtype) if is_on_device else mix)


def fitted(basis: StrainBasis, to: AbstractModes) -> StrainBasis:
    """`basis` with its sampled modes replaced by the nearest combinations of `to`.

    Smooth modes need fewer Gauss nodes, and keep the order of the rotations. The distance
    is that of least squares at the samples, by trapezoidal weights.

    Args:
        basis: Modes; those that are not sampled stay as they are.
        to: What to combine, e.g. `Legendre(12)` or `BSpline((0.25, 0.5, 0.75))`.

    Returns:
        The basis with the same strains and as many modes of each.

    Raises:
        ValueError: If there are fewer samples than modes in `to`.
    """
    return StrainBasis({name: _fit(name, modes, to) for name, modes in basis.modes.items()})


def _fit(name: str, modes: AbstractModes, to: AbstractModes) -> AbstractModes:
    if not isinstance(modes, SampledModes):
        return modes
    s = np.asarray(modes.s)
    if len(s) < to.count:
        raise ValueError(
            f"fitted: `{name}` has {len(s)} samples, need {to.count} or more for the "
            f"{to.count} modes of {type(to).__name__}. Take fewer modes."
        )
    gaps = np.pad(np.diff(s), 1)
    root = np.sqrt((gaps[1:] + gaps[:-1]) / 2)[:, None]
    shapes, dtype = to(s), modes.values.dtype
    if is_traced(shapes):
        inverse = jnp.linalg.pinv(jnp.asarray(root, shapes.dtype) * shapes)
    else:
        inverse = np.linalg.pinv(root * np.asarray(shapes, np.float64))
    return Combined(to, jnp.asarray(inverse, dtype) @ (jnp.asarray(root, dtype) * modes.values))


def _exact_rule(modes: AbstractModes) -> Quadrature:
    """A rule exact for products of the modes, to rounding if they are no polynomials."""
    if isinstance(modes, SampledModes):
        s = np.clip(np.asarray(modes.s), 0.0, 1.0)
        return Quadrature(2, merged(tuple(s[(s > 0) & (s < 1)].tolist())))
    if isinstance(modes, Combined):
        return _exact_rule(modes.inner)
    return Quadrature(2 * modes.resolution + 16, modes.breaks)


def _check_independent(name: str, diagonal: np.ndarray) -> None:
    least = np.abs(diagonal).min() / np.abs(diagonal).max()
    if not least > 1e-12:
        raise ValueError(
            f"orthonormalise: the {len(diagonal)} modes of `{name}` depend on each other (to "
            f"{least:.0e}), need independent ones. Leave some out."
        )


# B-splines: local, positive modes of any smoothness


class BSpline(AbstractModes):
    """Clamped B-splines of one `degree`; they are positive and sum to 1.

    Attributes:
        knots: Inner knots, rising inside (0, 1); one that is repeated lowers the
            smoothness there, degree + 1 times lets the strain jump.
        degree: 0 or more; the splines have degree - 1 derivatives at a simple knot.

    Reference:
        de Boor, A Practical Guide to Splines, 2001, chapter IX.
    """

    knots: tuple[float, ...] = eqx.field(static=True)
    degree: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        if self.degree < 0:
            raise ValueError(f"BSpline: `degree` is {self.degree}, need 0 or more. 3 is usual.")
        knots = np.asarray(self.knots, float)
        repeats = np.unique(knots, return_counts=True)[1].max(initial=0)
        inside = np.all((knots > 0) & (knots < 1)) and np.all(np.diff(knots) >= 0)
        if not inside or repeats > self.degree + 1:
            raise ValueError(
                f"BSpline: the inner knots are {knots.tolist()}, need numbers that rise inside "
                f"(0, 1), none more than degree + 1 = {self.degree + 1} times. The ends are "
                "added for you."
            )

    @property
    def count(self) -> int:
        return len(self.knots) + self.degree + 1

    @property
    def breaks(self) -> tuple[float, ...]:
        return merged(self.knots)

    @property
    def least(self) -> int:
        return self.degree + 1

    @property
    def resolution(self) -> int:
        spans = len(self.breaks) + 1
        return max(4, self.degree + 2, -(-8 // spans))

    def __call__(self, s):
        p = self.degree
        t = np.concatenate([np.zeros(p + 1), self.knots, np.ones(p + 1)]).tolist()
        rows = [self._indicator(s, t[k], t[k + 1]) for k in range(len(t) - 1)]
        for d in range(1, p + 1):
            rows = [
                _rise(s, t[k], t[k + d]) * rows[k]
                + (1 - _rise(s, t[k + 1], t[k + d + 1])) * rows[k + 1]
                for k in range(len(rows) - 1)
            ]
        return array_module(s).stack(rows, axis=1)

    def _indicator(self, s, low: float, high: float):
        if low == high:
            return s * 0
        inside = (s >= low if low > 0 else s == s) & (s < high if high < 1 else s == s)
        return inside.astype(s.dtype)


def _rise(s, low: float, high: float):
    """From 0 to 1 between two knots; a spline between equal knots is zero already."""
    return s * 0 if low == high else (s - low) / (high - low)


def bspline(
    *, degree: int = 3, knots: Sequence[float] | None = None, **modes: int
) -> StrainBasis:
    """A strain basis of clamped B-splines per strain, as `bspline(kappa_z=6, degree=3)`.

    Args:
        degree: Polynomial degree between knots.
        knots: Inner knots in (0, 1); equally spaced by default.
        **modes: Number of splines by strain, inner knots + degree + 1; names as in
            `chebyshev`.

    Returns:
        The basis; a coordinate has the unit of its strain, [1/m] or [-].

    Raises:
        ValueError: If a strain is unknown, none is named, or a number of splines does not fit
            degree and knots.

    Example:
        >>> basis = rod.bspline(kappa_z=4, degree=2)
        >>> basis.breaks, basis.num_dof
        ((0.5,), 4)

    Reference:
        de Boor, A Practical Guide to Splines, 1978, for the recursion.
    """
    basis = {}
    for name, count in each_count("bspline", modes).items():
        inner = count - degree - 1
        if inner < 0 or (knots is not None and inner != len(knots)):
            given = "" if knots is None else f" and {len(knots)} inner knots"
            need = degree + 1 + (0 if knots is None else len(knots))
            raise ValueError(
                f"bspline: `{name}` asks for {count} splines of degree {degree}{given}, need "
                f"{need}{' or more' if knots is None else ''}. Change the count or `degree`."
            )
        own = np.arange(1, inner + 1) / (inner + 1) if knots is None else knots
        basis[name] = BSpline(knots=tuple(float(k) for k in own), degree=degree)
    return StrainBasis(basis)
