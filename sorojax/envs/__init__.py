"""Environments of reinforcement learning: soft robots at tasks, in batches, with gradients."""

from sorojax._arguments import check_package as _check_package
from sorojax.envs.adapters import register, to_brax, to_gymnasium, to_gymnasium_vector
from sorojax.envs.core import (
    AbstractEnv,
    State,
    Step,
    randomised,
    reset,
    step,
    step_with_reset,
)
from sorojax.envs.supply_line import SupplyLine
from sorojax.envs.tasks.ball_turn import BallParams, BallTurn
from sorojax.envs.tasks.crawler_run import CrawlerParams, CrawlerRun
from sorojax.envs.tasks.finger import FingerParams
from sorojax.envs.tasks.finger_reach import FingerReach
from sorojax.envs.tasks.pick_place import PickParams, PickPlace
from sorojax.envs.tasks.solid_crawl import SolidCrawl, SolidCrawlParams
from sorojax.envs.tasks.solid_crawler import SolidCrawler, solid_crawler
from sorojax.envs.tasks.solid_finger import SolidFinger, solid_finger
from sorojax.envs.tasks.solid_reach import SolidParams, SolidReach
from sorojax.envs.tasks.tentacle_push import TentacleParams, TentaclePush
from sorojax.envs.tasks.tip_tracking import TipTracking, TrackingParams

__all__ = [
    "AbstractEnv",
    "BallParams",
    "BallTurn",
    "CrawlerParams",
    "CrawlerRun",
    "FingerParams",
    "FingerReach",
    "PickParams",
    "PickPlace",
    "SolidCrawl",
    "SolidCrawlParams",
    "SolidCrawler",
    "SolidFinger",
    "SolidParams",
    "SolidReach",
    "State",
    "Step",
    "SupplyLine",
    "TentacleParams",
    "TentaclePush",
    "TipTracking",
    "TrackingParams",
    "randomised",
    "register",
    "reset",
    "solid_crawler",
    "solid_finger",
    "step",
    "step_with_reset",
    "to_brax",
    "to_gymnasium",
    "to_gymnasium_vector",
]

_check_package(__name__)
