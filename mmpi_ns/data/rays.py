"""Rays of perspective and fisheye cameras in one batch, and the directions of a lens.

nerfstudio's ray generator handles every camera type and checks types and distortions some twenty times for each batch,
which takes 4 of 75 ms of a step on a CPU; on a GPU, each check is a synchronisation. It undistorts every pixel of every
batch anew: here the directions of a lens are computed once for all cameras that share it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.camera_utils import radial_and_tangential_undistort
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.scene.geometry import rotate

Rays = Callable[[Int[Tensor, "R 3"]], RayBundle]
"""Generator of rays through pixel centres (camera, row, column)."""
MOST_DIRECTIONS = 20_000_000
"""Maximum number of pixels of several lenses whose directions are stored (12 bytes each); beyond it nerfstudio
generates the rays."""
UNDISTORTED = 2**16
"""Pixels undistorted at once: their intermediate values fit the caches of a CPU."""
CHUNK = 2**18
"""Pixels whose rays are generated at once."""
GRID = 17
"""Grid points along each side of an image, for placement."""
BENT = (CameraType.FISHEYE, CameraType.FISHEYE624, CameraType.EQUIRECTANGULAR)
"""Camera types that are not pinholes, whatever their distortion."""


@dataclass
class TrainingRays(RayBundle):
    """Rays of a training step with their priors; a field is None if no ray has that prior."""

    keypoint_disparities: Float[Tensor, "*batch 1"] | None = None
    """Inverse distance of the SfM point on a keypoint ray, 0 on other rays."""
    disparities: Float[Tensor, "*batch 2"] | None = None
    """Inverse distance of a pixel's surface and its expected error, 0 where there is none."""
    exposures: Float[Tensor, "*batch 3"] | None = None
    """Colour in the ray's image over colour in the field."""
    through_pixel: Bool[Tensor, "*batch 1"] | None = None
    """Whether the ray goes through a pixel of a training image, from its camera."""


@dataclass(frozen=True)
class CameraRays:
    """Replacement of nerfstudio's ``RayGenerator`` for N perspective and fisheye cameras."""

    poses: Float[Tensor, "N 3 4"]
    focal: Float[Tensor, "N 2"]
    principal: Float[Tensor, "N 2"]
    lenses: tuple[Float[Tensor, "T 3"], Int[Tensor, "N"], Int[Tensor, "N"]] | None = field(default=None, kw_only=True)
    """Directions of the pixels of all distinct cameras, in their axes; the row of each camera's first pixel there, and
    the width of its image. None if all are pinholes."""

    @staticmethod
    def of(cameras: Cameras, device: torch.device | str) -> CameraRays | None:
        """None if a camera has another type, or if several lenses have more pixels than MOST_DIRECTIONS. Scenes
        do not change, so cameras' times are left out."""
        kinds = cameras.camera_type.reshape(-1)
        is_fisheye = kinds == CameraType.FISHEYE.value
        if not bool((is_fisheye | (kinds == CameraType.PERSPECTIVE.value)).all()):
            return None
        focal, principal = torch.cat([cameras.fx, cameras.fy], -1), torch.cat([cameras.cx, cameras.cy], -1)
        pinholes = CameraRays(*(x.to(device, torch.float32) for x in (cameras.camera_to_worlds, focal, principal)))
        lens = cameras.distortion_params
        if not bool(is_fisheye.any()) and (lens is None or not bool((lens != 0).any())):
            return pinholes
        lens = torch.zeros(len(kinds), 6) if lens is None else lens
        columns = (focal, principal, cameras.width, cameras.height, kinds, lens)
        rows = torch.cat([x.reshape(len(kinds), -1).double().cpu() for x in columns], -1)
        distinct, which = torch.unique(rows, dim=0, return_inverse=True)
        pixels = (distinct[:, 4] * distinct[:, 5]).long()
        if len(distinct) > 1 and int(pixels.sum()) > MOST_DIRECTIONS:
            return None
        tables = [pixel_directions(tuple(row)) for row in distinct.tolist()]
        directions = torch.cat(tables) if len(tables) > 1 else tables[0]  # without a copy
        first, widths = (pixels.cumsum(0) - pixels)[which], distinct[which, 4].long()
        return replace(pinholes, lenses=(directions.to(device), first.to(device), widths.to(device)))

    def __call__(self, ray_indices: Int[Tensor, "R 3"]) -> RayBundle:
        """Rays through pixel centres (camera, row, column). Pixel areas are those at distance 1; of a lens, those at
        its centre."""
        camera, row, column = ray_indices.unbind(-1)
        poses, focal = self.poses[camera], self.focal[camera]
        if self.lenses is None:
            u, v = ((ray_indices[:, 1:].flip(-1) + 0.5 - self.principal[camera]) / focal).unbind(-1)
            local = torch.stack([u, -v, torch.full_like(u, -1)], -1)
        else:
            directions, first, widths = self.lenses
            local = directions[first[camera] + row * widths[camera] + column]
        directions = torch.nn.functional.normalize(rotate(poses[:, :, :3], local), dim=-1)
        area = (focal.prod(-1, keepdim=True) * local.square().sum(-1, keepdim=True)).reciprocal()
        return RayBundle(poses[:, :, 3], directions, pixel_area=area, camera_indices=camera[:, None], metadata={})


def image_rays(camera: Cameras, step: int = 1) -> RayBundle:
    """Rays [H, W] through the pixels of one camera, or of every n-th row and column; nerfstudio's for other types."""
    rays, sizes = CameraRays.of(camera, camera.device), (int(camera.height), int(camera.width))
    if rays is None:
        return camera.generate_rays(0, keep_shape=True)[::step, ::step]
    rows, columns = (torch.arange(min(step, n) // 2, n, step, device=camera.device) for n in sizes)
    parts = []
    for some in rows.split(max(1, CHUNK // len(columns))):
        y, x = torch.meshgrid(some, columns, indexing="ij")
        parts.append(rays(torch.stack([torch.zeros_like(x), y, x], -1).view(-1, 3)))
    fields = ("origins", "directions", "pixel_area", "camera_indices")
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in fields}
    return RayBundle(**joined, metadata={}).reshape((len(rows), len(columns)))


@lru_cache(maxsize=2)
def pixel_directions(camera: tuple[float, ...]) -> Float[Tensor, "P 3"]:
    """Unit directions of all pixel centres of a camera, in its axes, row after row; the bits of nerfstudio's. A camera
    is fx, fy, cx, cy, width, height, type (perspective or fisheye), and nerfstudio's distortion parameters.

    Source: ``Cameras._generate_rays_from_coords``, which also makes the two neighbours of every pixel and needs ten
    times as long.
    """
    focal, center, lens = (torch.tensor(camera[part]) for part in (slice(0, 2), slice(2, 4), slice(7, None)))
    width, height, kind = (int(n) for n in camera[4:7])
    parts = []
    for rows in torch.arange(height).split(max(1, UNDISTORTED // width)):
        y, x = torch.meshgrid(rows + 0.5, torch.arange(width) + 0.5, indexing="ij")
        at = (torch.stack([x, y], -1).view(-1, 2) - center) / focal
        if bool((lens != 0).any()):
            at = radial_and_tangential_undistort(at, lens)
        (u, v), ahead = at.unbind(-1), torch.ones_like(at[:, 0])
        if kind == CameraType.FISHEYE.value:
            angle = at.square().sum(-1).sqrt().clip(0, math.pi)
            u, v, ahead = u * angle.sin() / angle, v * angle.sin() / angle, angle.cos()
        local = torch.stack([u, -v, -ahead], -1)
        parts.append(local / torch.linalg.vector_norm(local, dim=-1, keepdim=True))
    return _without_nan(torch.cat(parts))


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
    coords = torch.cartesian_prod(shares, shares) * torch.cat([cameras.height, cameras.width], -1).view(count, 1, 2)
    index = torch.arange(count).repeat_interleave(GRID * GRID)[:, None]
    rays = cameras.generate_rays(camera_indices=index, coords=coords.view(-1, 2))
    poses = cameras.camera_to_worlds.reshape(count, 3, 4).double()
    local = _without_nan(rays.directions.double().view(count, -1, 3) @ poses[:, :, :3])
    return torch.nn.functional.normalize(local, dim=-1).view(count, GRID, GRID, 3).numpy()


def _without_nan(directions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Local directions with the centre of a fisheye straight ahead, where nerfstudio divides by 0."""
    finite = torch.isfinite(directions).all(-1, keepdim=True)
    return torch.where(finite, directions, directions.new_tensor([0.0, 0.0, -1.0]))
