"""Ready-made and printable bodies as parametric programs."""

from sorojax._arguments import check_package as _check_package
from sorojax.robots.arms import arm_mjcf
from sorojax.robots.bellows import BellowsActuator, PneuNet, bellows_problem, pneunet_mesh
from sorojax.robots.imported import (
    BodyFrame,
    ImportedRobot,
    actuator_forces,
    computed_torque,
    mount,
)
from sorojax.robots.locomotion import (
    Crawler,
    Walker,
    crawler_gait,
    crawler_problem,
    crawler_rubbers,
    gait,
    pair_angles,
    walker_problem,
    walker_rubber,
)
from sorojax.robots.models.cell import unit_cell
from sorojax.robots.models.models import bench, model, printed_rubber
from sorojax.robots.models.supply import Port, Supply, rod_stepper, stepper, with_pneumatics
from sorojax.robots.printable import (
    Bellows,
    BendingActuator,
    Finger,
    Hand,
    Manipulator,
    PlanarActuator,
)
from sorojax.robots.surroundings import (
    contact_stepper,
    cylinder,
    middle,
    pose_below,
    replay,
    rim,
    ring,
    standing_ball,
    standing_cylinder,
    upside_down,
    with_contacts,
)

__all__ = [
    "Bellows",
    "BellowsActuator",
    "BendingActuator",
    "BodyFrame",
    "Crawler",
    "Finger",
    "Hand",
    "ImportedRobot",
    "Manipulator",
    "PlanarActuator",
    "PneuNet",
    "Port",
    "Supply",
    "Walker",
    "actuator_forces",
    "arm_mjcf",
    "bellows_problem",
    "bench",
    "computed_torque",
    "contact_stepper",
    "crawler_gait",
    "crawler_problem",
    "crawler_rubbers",
    "cylinder",
    "gait",
    "middle",
    "model",
    "mount",
    "pair_angles",
    "pneunet_mesh",
    "pose_below",
    "printed_rubber",
    "replay",
    "rim",
    "ring",
    "rod_stepper",
    "standing_ball",
    "standing_cylinder",
    "stepper",
    "unit_cell",
    "upside_down",
    "walker_problem",
    "walker_rubber",
    "with_contacts",
    "with_pneumatics",
]

_check_package(__name__)
