"""Observations of a data set for placement: cameras, points, and which camera saw which point."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.capture.cache import Arrays, digest, remembered
from mmpi_ns.capture.checks import in_one_place, say_once
from mmpi_ns.capture.dataset import MMPIDataset
from mmpi_ns.capture.loose_points import usable_points
from mmpi_ns.capture.rays import lens_directions
from mmpi_ns.capture.sfm import SfmModel, find_sfm_model
from mmpi_ns.capture.tracks import PosedImages, at_full_size, triangulate
from mmpi_ns.placement.observations import Observations, add_swept_points
from mmpi_ns.utils.errors import InputError, quoted

MAX_REPROJECTION = 0.02
"""Median angle between keypoints and points, as a fraction of the image, above which a model is in another frame."""
POSES_OFF = 0.5
"""Error of the poses, in training pixels, above which it is reported."""
TRACKS_VERSION = 3
"""Version of the algorithm: cached tracks of another version are recomputed."""
THUMBNAIL = 128
"""Maximum pixels along a side of the gray images for the plane sweep, box-filtered."""
ENOUGH_KEYPOINTS = 20
"""Average number of keypoints in an image above which no plane sweep is needed."""


def sfm_folder(parser: DataParserConfig, default: Path) -> Path:
    """Folder of a scene's COLMAP model: the data parser's, otherwise ``default`` beside the frames."""
    data = Path(parser.data)
    folder = data.parent if data.suffix == ".json" else data
    return folder / getattr(parser, "colmap_path", default)


def observe(
    outputs: DataparserOutputs, dataset: MMPIDataset, sfm: Path, *, find_points: bool, triangulates: bool
) -> Observations:
    """The observations of a training data set.

    Args:
        outputs: data parser outputs of the training images.
        dataset: the training images.
        sfm: folder of a COLMAP model, which need not exist.
        find_points: search the images for points if there are no tracks.
        triangulates: match features for this before a plane sweep.

    Raises:
        InputError: poses or intrinsics that cannot be used.
    """
    observations = read_observations(outputs, dataset.cameras, find_sfm_model(sfm))
    if in_one_place(observations.centers):
        CONSOLE.print("[bold yellow]All training cameras stand in one place: no distance can be learned.")
    if find_points:
        if not len(observations.seen_by):
            observations = _find_points(observations, dataset, triangulates)
        else:
            if observations.loose is not None:
                say_once("Point cloud: not used, as the SfM tracks tell of each point which images saw it.")
                observations = replace(observations, loose=None)
            angles = keypoint_angles(observations, dataset.cameras)
            off = np.median(angles * observations.intrinsics[observations.seen_by, 0])
            tell_poses(float(off), Path(outputs.image_filenames[0]))
        observations = drop_masked(observations, dataset)
    return observations


def _find_points(observations: Observations, dataset: MMPIDataset, triangulates: bool) -> Observations:
    """Points of a scene without tracks: triangulated, and from a plane sweep if triangulation finds too few."""
    images = posed_images(observations, dataset)
    if images is None:
        CONSOLE.print("Cameras that are neither perspective nor fisheye: no features are matched.")
    elif triangulates:
        originals = at_full_size(images)

        def find() -> Arrays:
            width, height = originals.sizes.max(0).astype(int)
            size = f"{len(originals.files)} images of {width} x {height}"
            CONSOLE.print(f"No SfM tracks: matching the features of {size}.")
            return {name: np.asarray(value) for name, value in vars(triangulate(originals)).items()}

        cameras = originals.camera_to_worlds, originals.intrinsics, originals.distortion, originals.fisheye
        stored: Mapping[str, Any] = remembered(digest(originals.files, "tracks", TRACKS_VERSION, *cameras), find)
        model = SfmModel(**{**stored, "off": stored["off"].item()})
        CONSOLE.print(f"{len(model.points)} triangulated points, seen {len(model.seen_by)} times.")
        observations = with_tracks(observations, model)
        tell_poses(model.off * float(images.sizes[:, 0].mean()), images.files[0])
    if len(observations.seen_by) < ENOUGH_KEYPOINTS * len(dataset):
        CONSOLE.print("Few or no tracks: a quick plane sweep locates the content.")
        thumbnails = []
        for i in range(len(dataset)):
            image = dataset.get_data(i, image_type="uint8")["image"][..., :3].float().mean(-1) / 255
            scale = max(1.0, max(image.shape) / THUMBNAIL)
            size = [max(8, round(n / scale)) for n in image.shape]
            small = torch.nn.functional.interpolate(image[None, None], size=size, mode="area")
            thumbnails.append(small[0, 0].double().numpy())
        observations = add_swept_points(observations, thumbnails)
    return observations


def tell_poses(off: float, image: Path) -> None:
    """Reports inaccurate poses, with the command that refines them.

    Args:
        off: median distance of matches or keypoints from their positions predicted by the poses, training pixels.
        image: one of the training images.
    """
    if not off > POSES_OFF:  # or not a number, as nothing matched
        return
    folder = image.parent
    full = folder.with_name(re.sub(r"_\d+$", "", folder.name))  # images for images_2
    refined, poses = full.parent.with_name(f"{full.parent.name}-refined"), full.parent / "transforms.json"
    command = f"mmpi-prepare {quoted(full)} {quoted(refined)} --poses {quoted(poses)} --refine-poses"
    says = f"The poses are off by {off:.1f} training pixels (median over the matches of the images)"
    CONSOLE.print(f"{says}: {command} mends them.", style="bold yellow", markup=False, soft_wrap=True)


def read_observations(outputs: DataparserOutputs, cameras: Cameras, sfm: SfmModel | None) -> Observations:
    """Training cameras as they are used, with the SfM points and keypoints moved into their frame.

    Raises:
        InputError: poses are missing, or poses or intrinsics cannot be used; names the image.
    """
    if not len(outputs.image_filenames):
        raise InputError("The capture holds no training image: check the split that the data parser made.")
    poses = np.array(cameras.camera_to_worlds.double().cpu())
    flat = [x.double().cpu().numpy().reshape(-1) for x in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
    usable = np.isfinite(poses).all((1, 2)) & np.isfinite(flat).all(0) & (flat[0] > 0) & (flat[1] > 0)
    if not usable.all():
        raise InputError(
            f"The camera of {outputs.image_filenames[usable.argmin()]} has a pose or focal length that is no finite "
            "number or not positive: correct it or remove the frame."
        )
    # The axes of an MPI come from a camera and must be orthonormal to more digits than poses in captures are.
    left, _, right = np.linalg.svd(poses[:, :, :3])
    poses[:, :, :3] = left @ right
    sizes = np.stack([cameras.width.cpu().numpy().reshape(-1), cameras.height.cpu().numpy().reshape(-1)], -1)
    observations = Observations.of_cameras(poses, np.stack(flat, -1), sizes)
    cloud = outputs.metadata.get("points3D_xyz")
    loose = None if cloud is None else usable_points(cloud.double().numpy(), poses[:, :, 3])
    loose = loose if loose is not None and len(loose) else None
    observations = replace(observations, lens=lens_directions(cameras), loose=loose)
    if sfm is None:
        return observations
    transform = outputs.dataparser_transform.double().numpy()
    points = (sfm.points @ transform[:3, :3].T + transform[:3, 3]) * outputs.dataparser_scale
    tracked = with_tracks(observations, replace(sfm, points=points), [Path(p).name for p in outputs.image_filenames])
    if not len(tracked.seen_at):
        return tracked
    angles = keypoint_angles(tracked, cameras)
    width = np.arctan(0.5 * tracked.sizes[:, 0] / tracked.intrinsics[:, 0]) * 2
    if np.median(angles / width[tracked.seen_by]) > MAX_REPROJECTION:
        CONSOLE.print(
            "[bold yellow]The COLMAP model does not fit the cameras (its points project elsewhere), so its tracks are "
            "not used: state its frame as applied_transform in transforms.json."
        )
        return replace(tracked.with_keypoints(np.zeros(len(angles), np.bool_)), points=np.zeros((0, 3)))
    ahead = angles < np.pi / 2
    if not ahead.all():
        CONSOLE.print(
            f"[bold yellow]{(~ahead).sum()} of {len(ahead)} keypoints have their point behind the camera and are not "
            "used: check the COLMAP model."
        )
    return tracked.with_keypoints(ahead)


def keypoint_angles(observations: Observations, cameras: Cameras) -> NDArray[np.float64]:
    """Radians [Q] between each keypoint's ray, lens included, and the direction to its point."""
    seen_by = torch.from_numpy(observations.seen_by).to(cameras.device)
    coords = torch.from_numpy(observations.seen_at[:, ::-1].copy()).float().to(cameras.device)
    rays = cameras.generate_rays(camera_indices=seen_by[:, None], coords=coords)
    directions = rays.directions.double().cpu().numpy()
    offsets = observations.points[observations.seen_point] - observations.centers[observations.seen_by]
    across = np.linalg.norm(np.cross(directions, offsets), axis=-1)
    return np.arctan2(across, (directions * offsets).sum(-1))


def posed_images(observations: Observations, dataset: MMPIDataset) -> PosedImages | None:
    """The training images with their cameras and lenses; None where a camera is neither perspective nor fisheye."""
    kinds = dataset.cameras.camera_type.reshape(-1).cpu()
    is_fisheye = kinds == CameraType.FISHEYE.value
    if not (is_fisheye | (kinds == CameraType.PERSPECTIVE.value)).all():
        return None
    lens = dataset.cameras.distortion_params  # k1, k2, k3, k4, p1, p2
    lens = torch.zeros(len(dataset), 6) if lens is None else lens.reshape(len(dataset), 6).cpu()
    lens = torch.where(is_fisheye[:, None], lens[:, :4], lens[:, [0, 1, 4, 5]])
    files = tuple(map(Path, dataset.image_filenames))
    cameras = observations.camera_to_worlds, observations.intrinsics, observations.sizes
    return PosedImages(files, *cameras, distortion=lens.double().numpy(), fisheye=is_fisheye.numpy())


def with_tracks(observations: Observations, model: SfmModel, names: Sequence[str] | None = None) -> Observations:
    """The observations with the points of a model.

    Args:
        observations: the cameras.
        model: tracks in their frame.
        names: of the training images in the model; None for their indices.
    """
    names = [str(i) for i in range(len(observations.centers))] if names is None else names
    seen_by, seen_point, relative = model.keypoints_of(names)
    seen_at = relative * observations.sizes[seen_by]
    return replace(observations, points=model.points, seen_by=seen_by, seen_point=seen_point, seen_at=seen_at)


def drop_masked(observations: Observations, dataset: MMPIDataset) -> Observations:
    """Drops keypoints on masked pixels: moving objects have no depth to learn from."""
    if not len(observations.seen_at) or not dataset.has_masks:
        return observations
    keep = np.ones(len(observations.seen_by), dtype=bool)
    for i in range(len(dataset)):
        mask = dataset.usable(i)
        keypoints = np.nonzero(observations.seen_by[: len(observations.seen_at)] == i)[0]
        x, y = observations.seen_at[keypoints].astype(int).T
        keep[keypoints] = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    return observations.with_keypoints(keep)
