"""Observations of a data set for placement: cameras, points, and which camera sees which point."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from mmpi_ns.data.checks import log_once
from mmpi_ns.data.dataset import MMPIDataset, image_and_mask
from mmpi_ns.data.posed_images import PosedImages, at_full_size, camera_observations, posed_images
from mmpi_ns.placement.observations import Array, Observations, nearest_views
from mmpi_ns.utils.errors import InputError, quoted
from mmpi_priors.cache import Arrays, kept
from mmpi_priors.clouds import point_cloud, usable_points
from mmpi_priors.conventions import OPENGL, SAME_PLACE, Matches, find_convention, in_words
from mmpi_priors.patches import search_surfaces
from mmpi_priors.sfm import SfmModel, find_sfm_model, numbers_in_model
from mmpi_priors.tracks import triangulate
from mmpi_priors.views import load_view, pixel_grid

MAX_REPROJECTION = 0.02
"""Median angle between keypoints and points, as a fraction of the image, above which a model is in another frame."""
POSES_OFF = 0.5
"""Error of the poses, in training pixels, above which it is reported."""
ENOUGH_KEYPOINTS = 20
"""Average number of keypoints in an image above which no surfaces need to be estimated."""
SEARCHED, SEARCHED_SIDE = 16, 220
"""Views in which surfaces are estimated, evenly spread over the capture, and pixels of their longer side."""
SEARCH_NEAR, SEARCH_ANGLE = (4, 8), 30.0
"""Nearest views that such a view is compared with and that observe its points; the largest angle in degrees between
their directions."""
SEARCH_ERROR = 0.5
"""Largest relative error of a point; large, so that distant content with little parallax is kept."""
POINTS_PER_VIEW = 400
"""Points on the surfaces of such a view, about."""


def observe(
    outputs: DataparserOutputs,
    dataset: MMPIDataset,
    parser: DataParserConfig,
    sfm_path: Path,
    *,
    find_points: bool,
    triangulates: bool,
    trusts: bool,
) -> Observations:
    """The observations of a training data set. Raises InputError for poses or intrinsics that cannot be used.

    Args:
        parser: settings of the data parser, whose COLMAP model is read if it has one.
        sfm_path: of a COLMAP model beside the frames otherwise; it need not exist.
        find_points, triangulates: search the images for points if there are no tracks; first by matched features.
        trusts: go on with cameras that contradict their images.
    """
    data = Path(parser.data)
    folder = data.parent if data.suffix == ".json" else data
    model = find_sfm_model(folder / getattr(parser, "colmap_path", sfm_path))
    observations, cloud = read_observations(outputs, dataset.cameras, model), point_cloud(outputs, parser)
    if cloud is not None and len(observations.seen_by):
        log_once("Point cloud: not used, because the SfM tracks record which images see each point.")
    elif cloud is not None and len(loose := usable_points(cloud, observations.centers)):
        observations = replace(observations, loose=loose)
    if np.ptp(observations.centers, axis=0).max() <= SAME_PLACE * max(1.0, np.abs(observations.centers).max()):
        CONSOLE.print("[bold yellow]All training cameras have the same position: depths cannot be learned.")
    if find_points:
        if not len(observations.seen_by):
            check = partial(check_cameras, file_matrices(observations, outputs, folder), trusts=trusts)
            observations = _find_points(observations, dataset, triangulates, check)
        else:
            angles = keypoint_angles(observations, dataset.cameras)
            off = np.median(angles * observations.intrinsics[observations.seen_by, 0])
            warn_of_poses(float(off), Path(outputs.image_filenames[0]))
        observations = drop_masked(observations, dataset)
    return observations


def _find_points(
    observations: Observations,
    dataset: MMPIDataset,
    triangulates: bool,
    check: Callable[[PosedImages, SfmModel], bool],
) -> Observations:
    """Points of a scene without tracks: triangulated, and on estimated surfaces if these are too few.

    ``check`` returns whether the cameras contradict the matches, after printing it."""
    images = posed_images(observations, dataset)
    if images is None:
        CONSOLE.print("Cameras that are neither fisheye nor perspective without a k4: no features are matched.")
    elif triangulates:
        originals = at_full_size(images)

        def find() -> Arrays:
            width, height = originals.sizes.max(0).astype(int)
            size = f"{len(originals.files)} images of {width} x {height}"
            CONSOLE.print(f"No SfM tracks: matching the features of {size}.")
            return {name: np.asarray(value) for name, value in vars(triangulate(originals)).items()}

        stored: Mapping[str, Any] = kept("tracks", originals, (), find)
        model = SfmModel(**{**stored, "off": stored["off"].item()})
        CONSOLE.print(f"{len(model.points)} triangulated points, seen {len(model.seen_by)} times.")
        observations = with_tracks(observations, model)
        if not check(originals, model):
            warn_of_poses(model.off * float(images.sizes[:, 0].mean()), images.files[0])
    if images is not None and len(observations.seen_by) < ENOUGH_KEYPOINTS * len(dataset):
        CONSOLE.print("Few or no tracks: a quick search for surfaces locates the content.")
        observations = with_surfaces(observations, at_full_size(images))
    return observations


def with_surfaces(observations: Observations, images: PosedImages) -> Observations:
    """The observations with points on surfaces of some views, estimated at a low resolution (``patches.py``). Points
    follow the earlier ones; each is observed by its view and by every near view that it projects into."""
    poses, count = observations.camera_to_worlds, len(images.files)
    points, seen_by, seen_point = [observations.points], [observations.seen_by], [observations.seen_point]
    for i in np.unique(np.linspace(0, count - 1, min(SEARCHED, count)).round().astype(int)).tolist():
        near = nearest_views(poses, i, SEARCH_NEAR[1], SEARCH_ANGLE)
        view, *others = (load_view(images, j, SEARCHED_SIDE) for j in (i, *near[: SEARCH_NEAR[0]]))
        surfaces = search_surfaces(view, others, np.zeros(view.gray.shape, np.float32), SEARCH_ERROR)
        if surfaces is None:
            continue
        where = np.nonzero(surfaces.inverse)
        where = tuple(at[:: max(1, len(at) // POINTS_PER_VIEW)] for at in where)
        depth, (x, y) = (
            1 / surfaces.inverse[where].astype(np.float64),
            (at[where] for at in pixel_grid(view.gray.shape)),
        )
        fx, fy, cx, cy = view.pinhole
        local = np.stack([(x - cx) / fx, -(y - cy) / fy, -np.ones_like(x)], -1) * depth[:, None]
        places = local @ poses[i, :, :3].T + poses[i, :, 3]
        cameras = np.repeat(np.array([i, *near]), len(places))
        at, ahead = observations.project(cameras, np.tile(places, (1 + len(near), 1)))
        seen = np.nonzero(ahead & ((at >= 0) & (at < observations.sizes[cameras])).all(-1))[0]
        seen_by.append(cameras[seen])
        seen_point.append(sum(map(len, points)) + seen % max(1, len(places)))
        points.append(places)
    joined = (np.concatenate(parts) for parts in (points, seen_by, seen_point))
    return replace(observations, **dict(zip(("points", "seen_by", "seen_point"), joined, strict=True)))


def file_matrices(observations: Observations, outputs: DataparserOutputs, folder: Path) -> Array:
    """The cameras' matrices of transforms.json, before the data parser's transform. [M, 4, 4]"""
    moved = outputs.dataparser_transform.double().numpy()
    with suppress(OSError, ValueError, KeyError):  # another parser, or a file without it
        applied = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["applied_transform"]
        moved = moved @ np.linalg.inv(np.vstack([np.array(applied, np.float64)[:3], [0, 0, 0, 1]]))
    matrices = np.tile(np.eye(4), (len(observations.camera_to_worlds), 1, 1))
    matrices[:, :3] = observations.camera_to_worlds
    matrices[:, :3, 3] /= outputs.dataparser_scale
    matrices[:, :3, 3] -= moved[:, 3]
    matrices[:, :3] = moved[:, :3].T @ matrices[:, :3]
    return matrices


def check_cameras(matrices: Array, images: PosedImages, model: SfmModel, *, trusts: bool) -> bool:
    """Whether cameras contradict verified matches; prints it with the convention that fits them.

    Raises InputError with the same sentence if they cannot be used and ``trusts`` is False."""
    table, width = model.matches, images.sizes[:, 0]
    pairs = Matches(table[:, :2].astype(np.int64), *(table[:, c : c + 4].reshape(-1, 2, 2) for c in (2, 6)))
    lens = images.intrinsics[:, 0] / width, images.intrinsics[:, :2], images.intrinsics[:, 2:]
    as_given, better, is_wrong = find_convention(matrices, OPENGL, lens, pairs)
    if better is None and not is_wrong:
        return False
    focal, pixels = float(images.intrinsics[0, 0]), float(width.mean())
    if better is None:
        message = (
            f"The cameras contradict their images: matches are off by {as_given.error:.1%} of the width, and "
            "no usual convention of axes, inversion, focal length or lens explains them. Are the poses those of "
            "other images, or in another order?"
        )
    else:
        message = in_words(better, OPENGL, focal, pixels, as_given.error)
        message = f"The cameras contradict their images. {message}"
        full = images.files[0].parent
        if better.is_of_axes(OPENGL):
            to, poses = full.parent.with_name(f"{full.parent.name}-converted"), full.parent / "transforms.json"
            command = f"mmpi-prepare {quoted(full)} {quoted(to)} --poses {quoted(poses)}"
            message = f"{message} Convert them: {command} reads them so."
        else:
            message = f"{message} Correct the intrinsics in transforms.json."
    if is_wrong and not trusts:
        raise InputError(f"{message} To train all the same: --pipeline.datamanager.priors.trust-cameras True.")
    CONSOLE.print(message, style="bold yellow", markup=False, soft_wrap=True)
    return True


def warn_of_poses(off: float, image: Path) -> None:
    """Reports poses that matches or keypoints contradict by this many training pixels (median), with the command that
    refines them; ``image`` is one of the training images."""
    if not off > POSES_OFF:  # or not a number, as nothing matched
        return
    full = image.parent.with_name(re.sub(r"_\d+$", "", image.parent.name))  # images for images_2
    refined, poses = full.parent.with_name(f"{full.parent.name}-refined"), full.parent / "transforms.json"
    command = f"mmpi-prepare {quoted(full)} {quoted(refined)} --poses {quoted(poses)} --refine-poses"
    message = f"The poses are off by {off:.1f} training pixels (median over the matches of the images)"
    CONSOLE.print(f"{message}: {command} refines them.", style="bold yellow", markup=False, soft_wrap=True)


def read_observations(outputs: DataparserOutputs, cameras: Cameras, sfm: SfmModel | None) -> Observations:
    """Training cameras in the scene's frame, with the SfM points and keypoints in it. Raises InputError naming the
    image whose pose or intrinsics cannot be used."""
    observations = camera_observations(cameras, outputs.image_filenames)
    if sfm is None:
        return observations
    transform = outputs.dataparser_transform.double().numpy()
    points = (sfm.points @ transform[:3, :3].T + transform[:3, 3]) * outputs.dataparser_scale
    tracked = with_tracks(observations, replace(sfm, points=points), outputs.image_filenames)
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


def with_tracks(observations: Observations, model: SfmModel, files: Sequence[Path] | None = None) -> Observations:
    """The observations with the points of a model in their frame; images are named by their indices unless ``files``
    are given."""
    count = len(observations.centers)
    images = numbers_in_model(files or [Path(str(i)) for i in range(count)], model.names.tolist())
    begins, ends = (np.searchsorted(model.seen_by, images, side) for side in ("left", "right"))
    order = np.concatenate([np.zeros(0, np.int64), *map(np.arange, begins, ends)])
    seen_by = np.repeat(np.arange(count), ends - begins)
    seen_at = model.seen_at[order] * observations.sizes[seen_by]
    return replace(
        observations, points=model.points, seen_by=seen_by, seen_point=model.seen_point[order], seen_at=seen_at
    )


def opaque(dataset: MMPIDataset, i: int) -> NDArray[np.bool_]:
    """Mask of the usable pixels of an image that are not transparent. [H, W]"""
    return image_and_mask(dataset, i)[1] > 0 if dataset.has_alpha else dataset.usable(i)


def drop_masked(observations: Observations, dataset: MMPIDataset) -> Observations:
    """Drops keypoints on masked or transparent pixels: moving objects have no depth to learn from, and what a
    transparent pixel shows is cut out."""
    if not len(observations.seen_at) or not (dataset.has_masks or dataset.has_alpha):
        return observations
    keep = np.ones(len(observations.seen_by), dtype=bool)
    for i in range(len(dataset)):
        mask = opaque(dataset, i)
        keypoints = np.nonzero(observations.seen_by[: len(observations.seen_at)] == i)[0]
        x, y = observations.seen_at[keypoints].astype(int).T
        keep[keypoints] = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    return observations.with_keypoints(keep)
