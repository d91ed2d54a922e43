"""Ready-made and printable bodies as parametric programs."""

from sorojax._arguments import check_package as _check_package
from sorojax.robots.bellows import (
    BellowsActuator as BellowsActuator,
    PneuNet as PneuNet,
    bellows_problem as bellows_problem,
    pneunet_mesh as pneunet_mesh,
)
from sorojax.robots.locomotion import (
    Crawler as Crawler,
    Gait as Gait,
    Walker as Walker,
    crawler_gait as crawler_gait,
    crawler_problem as crawler_problem,
    crawler_rubbers as crawler_rubbers,
    gait as gait,
    pair_angles as pair_angles,
    walker_problem as walker_problem,
    walker_rubber as walker_rubber,
)
from sorojax.robots.models.cell import Cell as Cell, unit_cell as unit_cell
from sorojax.robots.models.models import (
    bench as bench,
    model as model,
    printed_rubber as printed_rubber,
)
from sorojax.robots.models.supply import (
    Model as Model,
    Port as Port,
    RodBehindValves as RodBehindValves,
    Supply as Supply,
    rod_stepper as rod_stepper,
    stepper as stepper,
    supplied as supplied,
)
from sorojax.robots.printable import (
    Bellows as Bellows,
    BendingActuator as BendingActuator,
    Finger as Finger,
    Hand as Hand,
    Manipulator as Manipulator,
    PlanarActuator as PlanarActuator,
)
from sorojax.robots.surroundings import (
    InContact as InContact,
    Replay as Replay,
    below as below,
    contact_stepper as contact_stepper,
    cylinder as cylinder,
    middle as middle,
    replay as replay,
    rim as rim,
    ring as ring,
    standing_cylinder as standing_cylinder,
    surrounded as surrounded,
    upside_down as upside_down,
)

_check_package(__name__)
