"""Details: residuals of the nearest training images, added to rendered images where they see the same surfaces.

A field is smooth where rays are few, and averages colours that change with the viewing direction faster than its
network can model. The residual of each training image is stored with the rendered depths. A rendered image adds the
residuals of the nearest training images where they see the same surface, with weights that fall with the angle between
the viewing directions. A field overfits its training images: part of what other views lack is no residual there, so a
part of each residual is taken against the image being rendered. Source: weights as in unstructured lumigraph rendering
(Buehler et al. 2001), applied to residuals instead of colours, so that surfaces that no training image sees are the
field's.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor
from torch.nn.functional import grid_sample

from mmpi_ns.data.rays import image_rays
from mmpi_ns.ops.build import HEADERS
from mmpi_ns.ops.ends import numbers_in
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.files import write_arrays, write_atomically

WEIGHTS = (HEADERS / "details.h").read_text(encoding="utf-8")
"""Source of the constants and weights in GLSL."""
TURN, FADE, SAME_DEPTH, SAME_PIXELS, STRENGTH, HERE, MIDDLE, LEAST_WEIGHT, TINY = numbers_in(
    WEIGHTS, "TURN", "FADE", "SAME_DEPTH", "SAME_PIXELS", "STRENGTH", "HERE", "MIDDLE", "LEAST_WEIGHT", "TINY"
)
MAX_ANGLE = 45.0
"""Maximum angle between the viewing directions of an image and of the training images whose details it adds,
degrees."""
LARGEST = 0.5
"""Maximum residual, of colours in [0, 1]."""
LEVELS = 127
"""Levels of a residual to either side of 0: half of a grey level each."""
PART = 2**18
"""Rays whose details are computed at once."""
DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""Exceptions of reading a damaged file."""
DETAILS_FOLDER = "details"
CAMERAS_FILE = "cameras.npz"
"""Written last, so that a folder without it is incomplete."""


@dataclass(frozen=True)
class DetailView:
    """A training image, as ``seen_details`` needs it."""

    image: Float[Tensor, "H W 4"]
    """Residual of the radiance (image minus ``1 - HERE`` of its rendering, ``HERE * MIDDLE`` lower: red, green, blue),
    and inverse distance along the ray; -1 where the image is masked."""
    camera: Float[Tensor, "24"]


def project(
    local: Float[Tensor, "R 3"], camera: Float[Tensor, "24"], height: int, width: int
) -> tuple[Float[Tensor, "R 2"], Bool[Tensor, "R"]]:
    """Pixel coordinates of directions in a camera's axes (x right, y up, z backwards), and whether the image has them.

    Args:
        local: directions, of any length.
        camera: as for ``seen_details``.
        height, width: of the image, pixels.
    """
    fx, fy, cx, cy, k1, k2, k3, k4, p1, p2, fisheye, reach = camera[12:].unbind()
    x, y, ahead = local[:, 0], -local[:, 1], -local[:, 2]
    radius = torch.hypot(x, y)
    scale = torch.where(
        fisheye > 0, torch.atan2(radius, ahead) / radius.clamp(min=TINY), 1 / torch.where(ahead > TINY, ahead, TINY)
    )
    u, v = x * scale, y * scale
    inside = (radius * scale <= reach) & ((fisheye > 0) | (ahead > TINY))
    r = u * u + v * v
    radial = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    du, dv = 2 * p1 * u * v + p2 * (r + 2 * u * u), 2 * p2 * u * v + p1 * (r + 2 * v * v)
    column, row = fx * (radial * u + du) + cx, fy * (radial * v + dv) + cy
    inside &= (column > 0) & (column < width) & (row > 0) & (row < height)
    return torch.stack([column, row], -1), inside


def seen_details(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    inverse: Float[Tensor, "R 1"],
    radiance: Float[Tensor, "R 3"],
    image: Float[Tensor, "H W 4"],
    camera: Float[Tensor, "24"],
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 1"]]:
    """Interpolated residuals of an image at the surfaces of rays, and weights, 0 where it sees another surface or none.
    These grow with the agreement of viewing directions and depths, and fall where the image is farther away from the
    surface than the ray's origin; residuals fade with the angle between the directions.

    Args:
        origins: of the rays.
        directions: of the rays, unit length.
        inverse: 1 / distance of their surfaces along the rays; 0 is infinity.
        radiance: of the field along the rays.
        image: three differences (``DetailView``), and inverse distances along the image's own
            rays; below 0 where it is masked.
        camera: its pose, camera to world row by row; fx, fy, cx, cy in pixels; nerfstudio's k1, k2, k3, k4, p1, p2;
            whether angles are proportional to distances from the centre (fisheye); and the largest distance of a pixel
            from the centre before the distortion, in focal lengths.
    """
    height, width = image.shape[:2]
    pose = camera[:12].view(3, 4)
    towards = origins - pose[:, 3]
    relative = inverse * towards + directions  # to the surface, over its distance along the ray
    length = relative.norm(dim=-1, keepdim=True).clamp(min=TINY)
    pixels, inside = project(relative @ pose[:, :3], camera, height, width)
    grid = torch.where(inside[:, None], 2 * pixels / pixels.new_tensor([width, height]) - 1, 0.0)
    planes = image.movedim(-1, 0)[None]
    values = grid_sample(planes, grid[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
    there, here = values[:, 3:], inverse / length
    shift = camera[12] * towards.norm(dim=-1, keepdim=True)  # pixels for each unit of inverse depth
    margin = SAME_DEPTH * torch.maximum(there, here) + SAME_PIXELS / shift.clamp(min=TINY)
    turn = (relative / length - directions).norm(dim=-1, keepdim=True)
    coarser = length.clamp(min=1) ** 4
    agrees = torch.exp(-((there - here) / margin).square().clamp(max=80)) / ((turn + TURN) * coarser)
    faded = (values[:, :3] - HERE * (radiance - MIDDLE)) / (1 + (turn / FADE).square())
    return faded, torch.where(inside[:, None] & (there >= 0), agrees, 0.0)


class Details:
    """Residuals of the training images, read when an image needs them.

    Args:
        cameras: of the training images, as ``seen_details`` takes them. [N, 24]
        read: a training image by its number, on a device.
    """

    def __init__(self, cameras: Float[Tensor, "N 24"], read: Callable[[int, torch.device], DetailView]) -> None:
        self.cameras = cameras
        self._poses = cameras[:, :12].view(-1, 3, 4).double().numpy()
        self.view = lru_cache(maxsize=8)(read)

    def added(
        self, outputs: dict[str, Tensor], bundle: RayBundle, nearest: int, exposure: Float[Tensor, "3"] | None
    ) -> dict[str, Tensor]:
        """Outputs of an image [H, W, C] with details in rgb and radiance; those of the field alone begin with
        ``field_``.

        Args:
            outputs: of the field.
            bundle: rays of the image. [H, W]
            nearest: number of training images whose details are added. Shares reach 0 at the distance of the next one,
                so that none appears suddenly as a camera moves.
            exposure: of rgb over the radiance; None if they are the same.
        """
        origins, directions = bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3)
        pose = np.zeros((1, 3, 4))
        pose[0, :, 3], ahead = origins[0].double().cpu().numpy(), directions.double().mean(0).cpu().numpy()
        length = float(np.linalg.norm(ahead))
        pose[0, :, 2] = -ahead / max(length, 1e-9)
        angle = MAX_ANGLE if length > 0.5 else 180.0  # a panorama faces all directions
        chosen = nearest_views(np.concatenate([self._poses, pose]), len(self._poses), nearest + 1, angle, apart=False)
        distances = np.linalg.norm(self._poses[chosen, :, 3] - pose[0, :, 3], axis=-1)
        limit = distances[-1] if len(chosen) > nearest and distances[-1] > 0 else np.inf
        chosen, shares = chosen[:nearest], ((1 - (distances / limit) ** 2) ** 2)[:nearest].tolist()
        views, details = [self.view(i, origins.device) for i in chosen], []
        disparities, radiance = 1 / outputs["depth"].reshape(-1, 1), outputs.get("radiance", outputs["rgb"])
        rays = origins, directions, disparities, radiance.reshape(-1, 3)
        for starts, ways, near, field in zip(*(x.split(PART) for x in rays), strict=True):
            total, weight = torch.zeros_like(starts), torch.full_like(near, LEAST_WEIGHT)
            for view, share in zip(views, shares, strict=True):  # the weighted mean of their residuals
                difference, seen = seen_details(starts, ways, near, field, view.image, view.camera)
                total += share * seen * difference
                weight += share * seen
            details.append(STRENGTH * total / weight)
        detail = torch.cat(details).view(bundle.origins.shape) * outputs["accumulation"]
        rgb = (outputs["rgb"] + (detail if exposure is None else exposure * detail)).clamp(0, 1)
        detailed = outputs | {"rgb": rgb, "field_rgb": outputs["rgb"]}
        if "radiance" in outputs:
            detailed |= {"radiance": outputs["radiance"] + detail, "field_radiance": outputs["radiance"]}
        return detailed


def details_of(folder: Path, step: int) -> Details | None:
    """Details that ``write_details`` wrote for the checkpoint of a step; None without any, or if they belong to another
    step. Raises InputError if it is damaged."""
    if not (folder / CAMERAS_FILE).is_file():
        return None
    kept_at, cameras, _ = _load(folder / CAMERAS_FILE, "step", "cameras", "here")  # differences without HERE differ

    def read(i: int, device: torch.device) -> DetailView:
        difference, inverse = (x.to(device) for x in _load(folder / f"{i:05d}.npz", "difference", "inverse"))
        image = torch.cat([difference.float() * (LARGEST / LEVELS), inverse.float()[..., None]], -1)
        return DetailView(image, cameras[i].to(device))

    return Details(cameras, read) if int(kept_at) == step else None


def _load(path: Path, *names: str) -> list[Tensor]:
    """Some arrays of a file. Raises InputError if it is damaged."""
    try:
        with np.load(path) as file:
            return [torch.from_numpy(file[name]) for name in names]
    except DAMAGED as error:
        raise InputError(
            f"{path} is damaged ({brief(error)}): remove the folder {path.parent}, and images show the field alone, or "
            "train again."
        ) from error


def moved_cameras(cameras: Cameras, poses: CameraOptimizer) -> Cameras:
    """Cameras with the refined poses of an optimiser."""
    if poses.config.mode == "off":
        return cameras
    corrections, cameras = poses(list(range(len(cameras)))).detach(), copy(cameras)
    before = cameras.camera_to_worlds
    shift = before[..., 3:] + corrections[:, :3, 3:]
    cameras.camera_to_worlds = torch.cat([corrections[:, :3, :3] @ before[..., :3], shift], -1)
    return cameras


@torch.no_grad()
def write_details(
    folder: Path,
    step: int,
    cameras: Cameras,
    factors: Float[Tensor, "N 3"],
    image_of: Callable[[int], tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    outputs_of: Callable[[RayBundle], dict[str, Tensor]],
) -> str:
    """Renders all training images and writes their residuals; returns a sentence about them.

    Args:
        folder: created, or emptied.
        step: of the checkpoint that the details belong to.
        cameras: of the N training images, with refined poses.
        factors: exposures of the images over that of the field; empty if they are the same.
        image_of: colours of a training image [H, W, 3 or 4], and mask of its usable pixels [H, W].
        outputs_of: the field's outputs for the rays of an image: depth, and radiance or rgb [H, W, C].

    Raises:
        WriteError: the disk is full.
    """
    kinds = cameras.camera_type.flatten().tolist()
    if not set(kinds) <= {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value}:
        return "Images show the field without details: some cameras are neither perspective nor fisheye."
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CAMERAS_FILE).unlink(missing_ok=True)
    rows, size = [], 0
    for i in track(range(len(cameras)), "Details", console=CONSOLE):
        bundle = image_rays(cameras[i : i + 1])
        image, usable = image_of(i)
        outputs = outputs_of(bundle)
        factor = (factors[i] if len(factors) else torch.ones(3)).to(outputs["depth"])
        observed = torch.from_numpy(image[..., :3]).to(factor) / 255
        radiance = outputs.get("radiance", outputs["rgb"])
        difference = (observed - (factor * radiance).clamp(0, 1)) / factor + HERE * (radiance - MIDDLE)
        difference *= LEVELS / LARGEST
        masked = torch.from_numpy(usable == 0).to(factor.device)
        arrays = {
            "difference": difference.round().clamp(-LEVELS, LEVELS).to(torch.int8).cpu().numpy(),
            "inverse": torch.where(masked, -1.0, 1 / outputs["depth"][..., 0]).clamp(max=6e4).half().cpu().numpy(),
        }
        path = folder / f"{i:05d}.npz"
        write_atomically(path, partial(write_arrays, arrays=arrays))
        size += path.stat().st_size
        rows.append(_camera_row(cameras[i], bundle, kinds[i] == CameraType.FISHEYE.value))
    arrays = {"step": np.array(step), "cameras": np.stack(rows), "here": np.array(HERE)}
    write_atomically(folder / CAMERAS_FILE, partial(write_arrays, arrays=arrays))
    return f"Details of {len(rows)} training images, {size / 2**20:,.0f} MiB, are in {folder}."


def _camera_row(camera: Cameras, bundle: RayBundle, fisheye: bool) -> NDArray[np.float32]:
    """Parameters of a camera for ``seen_details``. [24]"""
    pose = camera.camera_to_worlds.reshape(3, 4)
    local = bundle.directions.reshape(-1, 3) @ pose[:, :3]
    radius, ahead = local[:, :2].norm(dim=-1), -local[:, 2]
    reach = (torch.atan2(radius, ahead) if fisheye else radius / ahead.clamp(min=1e-6)).max()
    lens = camera.distortion_params
    lens = torch.zeros(6) if lens is None else lens.reshape(-1)
    intrinsics = (x.reshape(1) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    numbers = [pose.reshape(-1), *intrinsics, lens, torch.tensor([float(fisheye), 1.001 * float(reach)])]
    return torch.cat([x.float().cpu() for x in numbers]).numpy()
