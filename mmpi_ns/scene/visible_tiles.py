"""Tiles of texels that training rays can read, from the cameras alone, without reading images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from mmpi_ns.scene.plan import MPIPlan, ScenePlan
from mmpi_ns.scene.texels import SIDE

BORDER_RAYS = 33
"""Number of rays along each border of an image, enough for lens distortion."""
MARGIN = 0.25
"""Texels added on each side of a tile: rays are drawn in float32."""
AT_ONCE = 8
"""Number of cameras that are compared together with the tiles that no earlier one can read."""
PART = 1 << 14
"""Number of tiles processed together."""


@dataclass(frozen=True, eq=False)
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


@lru_cache(maxsize=16)
def reachable_tiles(views: TrainingViews, plan: ScenePlan, device: str | torch.device = "cpu") -> Bool[Tensor, "T"]:
    """Tiles (in the order of ``texels``) with a texel that a ray through a training image can read.

    A tile is excluded if it lies outside one of the four side planes of every frustum, or on a plane that no camera is
    in front of. This is conservative: a few too many are marked at the corners of images. All tiles of the cube are
    marked. Computed on a device in float64, and returned on the CPU. Cached: the result must not be changed.
    """
    tiles = [_tiles_of(mpi, views, torch.device(device)).reshape(-1).cpu() for mpi in plan.mpis]
    if plan.cube is not None:
        depth, height, width = plan.cube.shape
        tiles.append(torch.ones(depth * -(-height // SIDE) * -(-width // SIDE), dtype=torch.bool))
    return torch.cat(tiles)


def _tiles_of(mpi: MPIPlan, views: TrainingViews, device: torch.device) -> Bool[Tensor, "L Y X"]:
    """Tiles of one MPI that some image can read.

    From a camera at o (in the MPI's axes) the point with tangents (u, v) on the plane of disparity w lies in direction
    (u, v, 1) - w o, affine in u and v: over a tile, the maximum of normal . direction is a sum of two maxima. Cameras
    far from each other come first, and each group is compared only with the tiles that none has reached.
    """
    axes = torch.tensor(mpi.axes, dtype=torch.float64)
    spread = torch.cat([torch.arange(len(views.origins))[i::AT_ONCE] for i in range(AT_ONCE)])
    origins = (views.origins[spread] - torch.tensor(mpi.origin, dtype=torch.float64)) @ axes.T
    normals = views.inward[spread] @ axes.T
    u0, u1, v0, v1 = mpi.extent
    along = []  # largest slope * tangent over the lookups that read each tile of a row, and of a column, of texels
    for slope, low, high, size in ((normals[..., 0], u0, u1, mpi.width), (normals[..., 1], v0, v1, mpi.height)):
        first = torch.arange(0, size, SIDE, dtype=torch.float64)
        ends = torch.stack([first - 1 - MARGIN, first + SIDE + MARGIN]).clamp(0, size - 1)
        tangents = low + ends * ((high - low) / (size - 1))
        along.append((slope[..., None, None] * tangents).amax(-2).to(device))
    along_x, along_y = along
    shift, ahead = (normals * origins[:, None]).sum(-1), normals[..., 2]
    w = 1 / mpi.far + torch.arange(mpi.planes - 1, -1, -1, dtype=torch.float64) * mpi.disparity_step
    rest = ahead - w[:, None, None] * shift
    rest[w[:, None] * origins[:, 2] >= 1] = -torch.inf  # cameras behind which a plane lies
    rest = rest.to(device)
    rows, columns = along_y.shape[-1], along_x.shape[-1]
    reachable = torch.zeros(mpi.planes, rows, columns, dtype=torch.bool, device=device)
    first, *others = range(0, len(origins), AT_ONCE)
    for part, marks in zip(*(x.split(max(1, PART // (rows * columns))) for x in (rest, reachable)), strict=True):
        some = slice(first, first + AT_ONCE)
        most = along_y[some][..., None] + (along_x[some] + part[:, some, :, None])[..., None, :]
        marks |= (most >= 0).all(2).any(1)
        for some in (slice(start, start + AT_ONCE) for start in others):
            plane, y, x = (~marks).nonzero(as_tuple=True)
            most = along_y[some][..., y] + (along_x[some][..., x] + part[:, some].movedim(0, -1)[..., plane])
            marks[plane, y, x] = (most >= 0).all(1).any(0)
    return reachable
