"""Rays of undistorted perspective cameras in one batch.

nerfstudio's ray generator handles every camera type and checks types and distortions some twenty times for each batch,
which takes 4 of 75 ms of a step on a CPU; on a GPU, each check is a synchronisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from mmpi_ns.scene.geometry import rotate


@dataclass(frozen=True)
class PinholeRays:
    """Takes the place of nerfstudio's ``RayGenerator`` for N such cameras."""

    poses: Float[Tensor, "N 3 4"]
    focal: Float[Tensor, "N 2"]
    principal: Float[Tensor, "N 2"]

    @staticmethod
    def of(cameras: Cameras, device: torch.device | str) -> PinholeRays | None:
        """None if a camera has another type, distortion or a time."""
        distortion = cameras.distortion_params
        plain = bool((cameras.camera_type == CameraType.PERSPECTIVE.value).all()) and cameras.times is None
        if not plain or (distortion is not None and bool((distortion != 0).any())):
            return None
        focal, principal = torch.cat([cameras.fx, cameras.fy], -1), torch.cat([cameras.cx, cameras.cy], -1)
        return PinholeRays(*(x.to(device, torch.float32) for x in (cameras.camera_to_worlds, focal, principal)))

    def __call__(self, ray_indices: Int[Tensor, "R 3"]) -> RayBundle:
        """Rays through pixel centres. Pixel areas, which this package does not use, are 1.

        Args:
            ray_indices: camera, row and column of each.
        """
        camera, pixel = ray_indices[:, 0], ray_indices[:, 1:].flip(-1) + 0.5
        poses = self.poses[camera]
        u, v = ((pixel - self.principal[camera]) / self.focal[camera]).unbind(-1)
        directions = torch.nn.functional.normalize(
            rotate(poses[:, :, :3], torch.stack([u, -v, -torch.ones_like(u)], -1)), dim=-1
        )
        one = torch.ones_like(u)[:, None]
        return RayBundle(poses[:, :, 3], directions, pixel_area=one, camera_indices=camera[:, None], metadata={})

    def image(self, height: int, width: int) -> RayBundle:
        """Rays [height, width] through all pixels of the first camera."""
        rows, columns = (torch.arange(n, device=self.focal.device) for n in (height, width))
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        return self(torch.stack([torch.zeros_like(x), y, x], -1).view(-1, 3)).reshape((height, width))
