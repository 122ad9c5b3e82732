"""Poses refined while the scene is learned: nerfstudio's camera optimiser, and which rays it learns from."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.rays import RayBundle
from torch.nn import Parameter

from mmpi_ns.capture.datamanager import OWN_PIXEL
from mmpi_ns.utils.errors import InputError


def check_refined_poses(mode: str, windows: int) -> None:
    """Raises InputError where poses are to be refined of a capture in several windows, which would not share them."""
    if mode != "off" and windows > 1:
        raise InputError(
            f"The capture is trained in {windows} windows, one after the other, and poses are refined in one alone: "
            "refine them before (mmpi-prepare --refine-poses), or give --pipeline.model.placement.window-length 0."
        )


@torch.no_grad()
def keep_frame(poses: Iterable[Parameter]) -> None:
    """Takes what all cameras have in common out of their corrections [N, 6].

    The scene would follow them and every training image look the same, but test images would not: their poses stay.
    """
    for moves in poses:
        moves -= moves.mean(0)


def move_rays(bundle: RayBundle, poses: CameraOptimizer) -> None:
    """Moves a training batch's rays with their cameras, in place.

    Rays of new views and through keypoints follow the camera that they were made from and do not move it: where they
    start and what they show come from depths that were found under the given poses, and would hold it there.
    """
    if poses.config.mode == "off":
        return
    poses.apply_to_raybundle(bundle)
    own = bundle.metadata[OWN_PIXEL]
    bundle.origins = torch.where(own, bundle.origins, bundle.origins.detach())
    bundle.directions = torch.where(own, bundle.directions, bundle.directions.detach())
