"""The cells of bellows, fingers and the bending actuator."""

from sorojax.material import AbstractHyperelastic
from sorojax.robots.bending import BendingActuator
from sorojax.robots.finger import Finger
from sorojax.robots.models_cell import Cell, unit_cell
from sorojax.robots.parts import Bellows, LaidAlong


def bending_cell(
    robot: BendingActuator, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """From the middle of a chamber to the middle of the gap behind it."""
    if robot.num_bellows < 2:
        raise ValueError("robots.model: one bellows has no period, need two. Add bellows.")
    end = (robot.num_bellows + 1) // 2 * robot.pitch
    span = (float(end - robot.pitch / 2), float(end))
    fine = float(robot.wall_thickness) / 2 if size is None else size
    return unit_cell(robot.body(), robot.chambers(), span, material, size=fine, mirrors=(1,))


def bellows_cell(
    bellows: Bellows, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """From the middle of a fold to the middle of the gap behind it, laid along x."""
    return _fold(bellows, bellows.solid(), material, size, (1, 2))


def finger_cell(
    finger: Finger, material: AbstractHyperelastic, size: float | None = None
) -> Cell:
    """The same of a finger, with its spine at -y."""
    return _fold(finger.bellows, finger.solid(), material, size, (2,))


def _fold(bellows: Bellows, solid, material, size: float | None, mirrors) -> Cell:
    middle = float(bellows.cap + (bellows.num_folds // 2 + 0.5) * bellows.pitch)
    span = (middle, middle + float(bellows.pitch) / 2)
    fine = float(bellows.wall_thickness) / 2 if size is None else size
    air = LaidAlong(bellows.chamber(), 0)
    laid = LaidAlong(solid, 0) - air
    return unit_cell(laid, air, span, material, size=fine, mirrors=mirrors)
