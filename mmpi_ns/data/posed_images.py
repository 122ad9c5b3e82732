"""Images with their cameras and lenses, for image comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from numpy.typing import NDArray

from mmpi_ns.data.copies import size_as_read, size_of, whole_of
from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.data.rays import lens_directions
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.errors import InputError


@dataclass(frozen=True)
class PosedImages:
    """Images and their cameras."""

    files: tuple[Path, ...]
    camera_to_worlds: NDArray[np.float64]
    """[M, 3, 4], OpenGL axes."""
    intrinsics: NDArray[np.float64]
    """[M, 4]: fx, fy, cx, cy in pixels."""
    sizes: NDArray[np.float64]
    """[M, 2]: width, height in pixels."""
    distortion: NDArray[np.float64]
    """[M, 4 or 5]: k1, k2, p1, p2 and k3 if there is one (OpenCV), or k1 to k4 of a fisheye lens."""
    fisheye: NDArray[np.bool_] | bool = False
    """Whether the lens of each image is a fisheye: [M], or one for all."""

    def is_fisheye(self, i: int) -> bool:
        """Whether image i has a fisheye lens."""
        return bool(np.broadcast_to(self.fisheye, len(self.sizes))[i])

    def is_bent(self, i: int) -> bool:
        """Whether the lens of image i is not a pinhole; a fisheye never is, even if all its terms are 0."""
        return self.is_fisheye(i) or bool(self.distortion[i].any())

    def lens(self, i: int) -> NDArray[np.float64]:
        """OpenCV's terms of image i."""
        return self.distortion[i][: 4 if self.is_fisheye(i) else 5]


def posed_images(observations: Observations, dataset: MMPIDataset) -> PosedImages | None:
    """The training images with their cameras and lenses; None where a camera is neither fisheye nor perspective, or
    perspective with a k4, which OpenCV lacks."""
    kinds = dataset.cameras.camera_type.reshape(-1).cpu()
    is_fisheye = kinds == CameraType.FISHEYE.value
    lens = dataset.cameras.distortion_params  # k1, k2, k3, k4, p1, p2
    lens = torch.zeros(len(dataset), 6) if lens is None else lens.reshape(len(dataset), -1).cpu()
    if not (is_fisheye | (kinds == CameraType.PERSPECTIVE.value) & (lens[:, 3] == 0)).all():
        return None
    lens = torch.where(is_fisheye[:, None], lens[:, :5], lens[:, [0, 1, 4, 5, 2]])
    files = tuple(map(Path, dataset.image_filenames))
    cameras = observations.camera_to_worlds, observations.intrinsics, observations.sizes
    return PosedImages(files, *cameras, distortion=lens.double().numpy(), fisheye=is_fisheye.numpy())


def at_full_size(images: PosedImages) -> PosedImages:
    """The same views in their originals, which are sharper; a view whose original has another shape stays as it is.
    Raises InputError naming an image file that cannot be read."""
    copies = [size_of(file) for file in images.files]
    files, sizes, scales = zip(*map(whole_of, images.files, copies), strict=True)
    reduced = np.stack(copies) / [size_as_read(*pair) for pair in zip(copies, images.sizes, strict=True)]
    intrinsics = images.intrinsics * np.tile(scales * reduced, 2)
    return replace(images, files=files, sizes=np.stack(sizes), intrinsics=intrinsics)


def camera_observations(cameras: Cameras, files: Sequence[Path]) -> Observations:
    """Training cameras in the scene's frame, without points. Raises InputError naming the image whose pose or
    intrinsics cannot be used."""
    poses = np.array(cameras.camera_to_worlds.double().cpu())
    flat = [x.double().cpu().numpy().reshape(-1) for x in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
    usable = np.isfinite(poses).all((1, 2)) & np.isfinite(flat).all(0) & (flat[0] > 0) & (flat[1] > 0)
    if not usable.all():
        raise InputError(
            f"The camera of {files[usable.argmin()]} has a pose or focal length that is no finite "
            "number or not positive: correct it or remove the frame."
        )
    # The axes of an MPI come from a camera and must be orthonormal to more digits than poses in captures are.
    left, _, right = np.linalg.svd(poses[:, :, :3])
    poses[:, :, :3] = left @ right
    sizes = torch.cat([cameras.width, cameras.height], -1).double().cpu().numpy()
    return Observations(poses, np.stack(flat, -1), sizes, lens=lens_directions(cameras))
