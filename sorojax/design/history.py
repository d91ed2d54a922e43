"""The designs of a run, for pictures and films of it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.design.minimise import Step
from sorojax.mesh.mesh import Mesh


class History:
    """The designs of a run: give it to `minimise` as `on_step`.

    `densities` has one row per kept step, beside `steps` and `objectives`. With the `mesh` of
    the cells, `view.show(history)` draws some of them and `view.animate(history)` all.

    Args:
        density: From a `Step` to the densities of its design.
        every: Steps from one that is kept to the next.
        mesh: The cells.
    """

    def __init__(
        self, density: Callable[[Step], Any], every: int = 1, *, mesh: Mesh | None = None
    ):
        self._density, self._every, self._mesh = density, every, mesh
        self.steps: list[int] = []
        self.objectives: list[float] = []
        self._rows: list[np.ndarray] = []

    def __call__(self, step: Step) -> None:
        if (step.count - 1) % self._every:
            return
        self.steps.append(step.count)
        self.objectives.append(float(step.objective))
        self._rows.append(np.asarray(self._density(step)))

    @property
    def mesh(self) -> Mesh:
        """The cells.

        Raises:
            ValueError: If none was given.
        """
        if self._mesh is None:
            raise ValueError(
                "design.History: got no mesh, need that of the cells for a picture. Make it "
                "with mesh=."
            )
        return self._mesh

    @property
    def densities(self) -> Float[np.ndarray, "kept cells"]:
        return np.stack(self._rows) if self._rows else np.zeros((0, 0))
