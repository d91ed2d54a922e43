"""Steps of environments in contact or of finite elements a second: grasps, reduced solids.

Each member has numbers of its own. A step is 20 ms: 10 steps of physics of 2 ms of grasps and
of the crawler, 5 of 4 ms of the finger, measurements, reward. `run_s` is that of one member of
a batch, one over the steps a second. The solids are trained once on a computer.
"""

from benchmarks.task_steps import steps
from sorojax import envs

WORKERS = 1  # nothing here calls the host


def rows():
    yield from steps({"ball turn": envs.BallTurn(), "pick and place": envs.PickPlace()})
    yield from steps({"solid reach": envs.SolidReach(), "solid crawl": envs.SolidCrawl()})
