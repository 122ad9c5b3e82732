"""Pose refinement during training: nerfstudio's camera optimiser, and the rays it learns from."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.rays import RayBundle
from torch.nn import Parameter

from mmpi_ns.capture.ray_sources import OWN_PIXEL
from mmpi_ns.utils.errors import InputError


def check_refined_poses(mode: str, windows: int) -> None:
    """Raises InputError if poses of a capture in several windows are to be refined, since windows do not share them."""
    if mode != "off" and windows > 1:
        raise InputError(
            f"The capture is trained in {windows} windows, one after the other, and poses are refined in one alone: "
            "refine them before (mmpi-prepare --refine-poses), or give --pipeline.model.placement.window-length 0."
        )


@torch.no_grad()
def keep_frame(poses: Iterable[Parameter]) -> None:
    """Subtracts the mean of the cameras' corrections [N, 6].

    The scene would follow a common correction without changing the training images, but test images keep their poses.
    """
    for moves in poses:
        moves -= moves.mean(0)


def move_rays(bundle: RayBundle, poses: CameraOptimizer) -> None:
    """Moves a training batch's rays with their cameras, in place.

    Rays of new views and keypoint rays follow their camera but do not move it: they were made from depths found with
    the given poses, and would pull the camera back to them.
    """
    if poses.config.mode == "off":
        return
    poses.apply_to_raybundle(bundle)
    own = bundle.metadata[OWN_PIXEL]
    bundle.origins = torch.where(own, bundle.origins, bundle.origins.detach())
    bundle.directions = torch.where(own, bundle.directions, bundle.directions.detach())
