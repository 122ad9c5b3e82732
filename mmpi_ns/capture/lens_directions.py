"""Ray directions of a lens on a grid over each image, for placement."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from numpy.typing import NDArray

GRID = 17
"""Grid points along each side of an image."""
BENT = (CameraType.FISHEYE, CameraType.FISHEYE624, CameraType.EQUIRECTANGULAR)
"""Camera types that are not pinholes, whatever their distortion."""


def lens_directions(cameras: Cameras) -> NDArray[np.float64] | None:
    """Unit directions [M, G, G, 3] in camera axes (x right, y up, z backwards), row after row, borders included.

    None if all cameras are pinholes, or of types without a single centre of projection.
    """
    kinds = cameras.camera_type.reshape(-1)
    bent = torch.isin(kinds, torch.tensor([kind.value for kind in BENT]).to(kinds))
    distorted = cameras.distortion_params is not None and bool((cameras.distortion_params != 0).any())
    if not bool((bent | (kinds == CameraType.PERSPECTIVE.value)).all()) or not (distorted or bool(bent.any())):
        return None
    cameras, count, shares = cameras.to("cpu"), len(cameras), torch.linspace(0, 1, GRID)
    grid = torch.stack(torch.meshgrid(shares, shares, indexing="ij"), -1).reshape(-1, 2)  # y, x
    sizes = torch.stack([cameras.height.reshape(-1), cameras.width.reshape(-1)], -1)
    coords = grid * sizes[:, None]
    index = torch.arange(count)[:, None].expand(coords.shape[:2])
    rays = cameras.generate_rays(camera_indices=index.reshape(-1, 1), coords=coords.reshape(-1, 2))
    poses = cameras.camera_to_worlds.reshape(count, 3, 4).double()
    local = rays.directions.double().view(count, -1, 3) @ poses[:, :, :3]
    # nerfstudio divides by 0 in the very middle of a fisheye.
    local = torch.where(torch.isfinite(local).all(-1, keepdim=True), local, local.new_tensor([0.0, 0, -1]))
    return torch.nn.functional.normalize(local, dim=-1).view(count, GRID, GRID, 3).numpy()
