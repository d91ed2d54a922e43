"""Strain bases: which strains of a rod are active, and the shapes they may take."""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._display import displayed

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
    """Modes of each active strain; a strain that is not named has no coordinate.

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
            xp = jnp if isinstance(values, jax.Array) else np
            rows.append(xp.pad(values, ((0, 0), (offset, behind))))
            offset += modes.count
        is_traced = any(isinstance(row, jax.Array) for row in rows)
        return jnp.stack(rows) if is_traced else np.stack(rows)


def columns(basis: StrainBasis, name: str) -> slice:
    """Where the coordinates of strain `name` lie in q."""
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
