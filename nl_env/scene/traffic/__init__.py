"""Traffic of one sequence: highway-env's roads and drivers, with signals and pedestrians, at any microsecond.

The modules of this package are the only ones that import highway_env.
"""

from nl_env.scene.traffic.simulation import simulate
from nl_env.scene.traffic.trajectories import (
    ACTOR_KINDS,
    LINE_TYPES,
    Actor,
    Crossing,
    EgoMotion,
    Lane,
    Traffic,
)

__all__ = ["ACTOR_KINDS", "LINE_TYPES", "Actor", "Crossing", "EgoMotion", "Lane", "Traffic", "simulate"]
