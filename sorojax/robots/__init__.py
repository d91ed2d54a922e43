"""Ready-made and printable bodies as parametric programs."""

from sorojax.robots.bellows import BellowsActuator as BellowsActuator
