"""Tiles of texels that training rays can read, from the cameras alone, without reading images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from numpy.typing import NDArray
from torch import Tensor

from mmpi_ns.scene.plan import MPIPlan, ScenePlan
from mmpi_ns.scene.texels import SIDE

BORDER_RAYS = 33
"""Rays along each border of an image, enough to follow lens distortion."""
MARGIN = 0.25
"""Texels added on each side of a tile: rays are drawn in float32."""


@dataclass(frozen=True)
class TrainingViews:
    """Position of each training camera and the four side planes of its frustum."""

    origins: Float[Tensor, "M 3"]
    inward: Float[Tensor, "M 4 3"]
    """Normals of the planes: a direction d is in the image only if all inward . d >= 0."""

    @staticmethod
    def of(cameras: Cameras) -> TrainingViews:
        """The views of a data set. A camera that sees half the sphere or more has no bounds (normals of 0)."""
        cameras, count, shares = cameras.to("cpu"), len(cameras), torch.linspace(0, 1, BORDER_RAYS)
        ends = torch.zeros(BORDER_RAYS)
        sides = [(ends, shares), (ends + 1, shares), (shares, ends), (shares, ends + 1)]
        border = torch.cat([torch.stack(side, -1) for side in sides])
        sizes = torch.stack([cameras.height.reshape(-1), cameras.width.reshape(-1)], -1)
        coords = border * sizes[:, None]
        index = torch.arange(count)[:, None].expand(coords.shape[:2])
        rays = cameras.generate_rays(camera_indices=index.reshape(-1, 1), coords=coords.reshape(-1, 2))
        poses = cameras.camera_to_worlds.reshape(count, 3, 4).double()
        axes = poses[:, :, :3] * poses.new_tensor([1.0, -1, -1])  # columns: right, down, ahead
        x, y, ahead = (rays.directions.double().view(count, -1, 3) @ axes).unbind(-1)
        one, zero = torch.ones(count, dtype=torch.float64), torch.zeros(count, dtype=torch.float64)
        x, y = (v / ahead.clamp(min=1e-9) for v in (x, y))
        normals = [(one, zero, -x.amin(1)), (-one, zero, x.amax(1)), (zero, one, -y.amin(1)), (zero, -one, y.amax(1))]
        inward = torch.stack([torch.stack(n, -1) for n in normals], 1) @ axes.mT
        kinds = cameras.camera_type.reshape(-1, 1)
        projects = (kinds == CameraType.PERSPECTIVE.value) | (kinds == CameraType.FISHEYE.value)
        bounded = projects[:, 0].expand(count) & (ahead > 0.01).all(1)
        return TrainingViews(poses[:, :, 3], torch.where(bounded[:, None, None], inward, 0.0))

    def some(self, chosen: NDArray[np.int64]) -> TrainingViews:
        """Those of the chosen images."""
        index = torch.from_numpy(chosen)
        return TrainingViews(self.origins[index], self.inward[index])


def reachable_tiles(views: TrainingViews, plan: ScenePlan) -> Bool[Tensor, "T"]:
    """Tiles (in the order of ``texels``) with a texel that a ray through a training image can read.

    A tile is left out if it lies outside one of the four planes of every image, or on a plane that no camera is in
    front of. This is conservative: a few too many are marked at the corners of images. All tiles of the cube are
    marked.

    Args:
        views: the training images.
        plan: the heads, at the resolution in use.
    """
    tiles = [_tiles_of(mpi, views).reshape(-1) for mpi in plan.mpis]
    if plan.cube is not None:
        depth, height, width = plan.cube.shape
        tiles.append(torch.ones(depth * -(-height // SIDE) * -(-width // SIDE), dtype=torch.bool))
    return torch.cat(tiles)


def _tiles_of(mpi: MPIPlan, views: TrainingViews) -> Bool[Tensor, "L Y X"]:
    """Tiles of one MPI that some image can read.

    From a camera at o (in the MPI's axes) the point with tangents (u, v) on the plane of disparity w lies in direction
    (u, v, 1) - w o, which is affine in u and v: over a tile, the maximum of normal . direction is a sum of two maxima.
    """
    axes = torch.tensor(mpi.axes, dtype=torch.float64)
    origins = (views.origins - torch.tensor(mpi.origin, dtype=torch.float64)) @ axes.T
    normals = views.inward @ axes.T
    along_x = _most(normals[..., 0], mpi.extent[:2], mpi.width)
    along_y = _most(normals[..., 1], mpi.extent[2:], mpi.height)
    shift = (normals * origins[:, None]).sum(-1)
    reachable = torch.zeros(mpi.planes, along_y.shape[-1], along_x.shape[-1], dtype=torch.bool)
    for plane in range(mpi.planes):
        w = mpi.last_disparity + (mpi.planes - 1 - plane) * mpi.disparity_step
        before = w * origins[:, 2] < 1
        rest = (normals[..., 2] - w * shift)[before]
        most = along_y[before][..., :, None] + (along_x[before] + rest[..., None])[..., None, :]
        reachable[plane] = (most >= 0).all(1).any(0)
    return reachable


def _most(slope: Float[Tensor, "M 4"], extent: tuple[float, ...], size: int) -> Float[Tensor, "M 4 N"]:
    """Largest slope * tangent over the lookups that read each tile of a row or column of texels."""
    first = torch.arange(0, size, SIDE, dtype=torch.float64)
    ends = torch.stack([first - 1 - MARGIN, first + SIDE + MARGIN]).clamp(0, size - 1)
    tangents = extent[0] + ends * ((extent[1] - extent[0]) / (size - 1))
    return (slope[..., None, None] * tangents).amax(-2)
