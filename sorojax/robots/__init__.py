"""Ready-made and printable bodies as parametric programs."""

from sorojax._arguments import check_package as _check_package
from sorojax.robots.around import (
    below as below,
    cylinder as cylinder,
    rim as rim,
    ring as ring,
    upside_down as upside_down,
)
from sorojax.robots.bellows import BellowsActuator as BellowsActuator
from sorojax.robots.bellows_problem import bellows_problem as bellows_problem
from sorojax.robots.bending import BendingActuator as BendingActuator
from sorojax.robots.crawler import (
    Crawler as Crawler,
    crawler_gait as crawler_gait,
    crawler_problem as crawler_problem,
    crawler_rubbers as crawler_rubbers,
)
from sorojax.robots.finger import Finger as Finger
from sorojax.robots.gait import Gait as Gait, gait as gait
from sorojax.robots.hand import Hand as Hand
from sorojax.robots.manipulator import Manipulator as Manipulator
from sorojax.robots.models import (
    bench as bench,
    model as model,
    printed_rubber as printed_rubber,
)
from sorojax.robots.models_cell import Cell as Cell, unit_cell as unit_cell
from sorojax.robots.models_supply import (
    Model as Model,
    Port as Port,
    Supply as Supply,
    stepper as stepper,
    supplied as supplied,
)
from sorojax.robots.parts import Bellows as Bellows
from sorojax.robots.planar import PlanarActuator as PlanarActuator
from sorojax.robots.pneunet import PneuNet as PneuNet, pneunet_mesh as pneunet_mesh
from sorojax.robots.rod_stepper import (
    RodBehindValves as RodBehindValves,
    rod_stepper as rod_stepper,
)
from sorojax.robots.surroundings import (
    InContact as InContact,
    Replay as Replay,
    contact_stepper as contact_stepper,
    middle as middle,
    replay as replay,
    standing_cylinder as standing_cylinder,
    surrounded as surrounded,
)
from sorojax.robots.walker import (
    Walker as Walker,
    pair_angles as pair_angles,
    walker_problem as walker_problem,
    walker_rubber as walker_rubber,
)

_check_package(__name__)
