"""Ready-made and printable bodies as parametric programs."""

from sorojax.robots.bellows import BellowsActuator as BellowsActuator
from sorojax.robots.bending import BendingActuator as BendingActuator
from sorojax.robots.finger import Finger as Finger
from sorojax.robots.hand import Hand as Hand
from sorojax.robots.manipulator import Manipulator as Manipulator
from sorojax.robots.parts import Bellows as Bellows
from sorojax.robots.planar import PlanarActuator as PlanarActuator
