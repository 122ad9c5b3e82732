"""Observations of a data set for placement: cameras, points, and which camera saw which point.

The points of a cloud (``ply_file_path``) do not say which images saw them. Projection alone would see through walls.
Where a pixel's depth is known from matches, a point is visible if it lies there, hidden if it lies behind, and
contradicted if it lies in front: then the image looks through it. Elsewhere coarse depth images of the cloud decide: a
point is visible if no other one lies clearly in front of it, in its cell or a neighbouring one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from mmpi_ns.data.checks import say_once
from mmpi_ns.data.dataset import MMPIDataset
from mmpi_ns.data.posed_images import PosedImages, at_full_size, camera_observations, posed_images
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.near_views import nearest_views
from mmpi_ns.utils.errors import InputError, quoted
from mmpi_priors.cache import Arrays, kept
from mmpi_priors.conventions import OPENGL, Matches, find_convention, in_words
from mmpi_priors.patches import search_surfaces
from mmpi_priors.sfm import SfmModel, find_sfm_model, numbers_in_model
from mmpi_priors.tracks import SAME_PLACE, triangulate
from mmpi_priors.views import Map, load_view, pixel_grid, project

Array = NDArray[np.float64]

MAX_REPROJECTION = 0.02
"""Median angle between keypoints and points, as a fraction of the image, above which a model is in another frame."""
POSES_OFF = 0.5
"""Error of the poses, in training pixels, above which it is reported."""
ENOUGH_KEYPOINTS = 20
"""Average number of keypoints in an image above which no surfaces need to be searched."""
SEARCHED, SEARCHED_SIDE = 16, 220
"""Views whose surfaces are searched, evenly spread over the capture, and pixels of their longer side."""
SEARCH_NEAR, SEARCH_ANGLE = (4, 8), 30.0
"""Nearest views that such a view is compared with, and which count as seeing its points; the largest angle in degrees
between their directions."""
SEARCH_ERROR = 0.5
"""Largest relative error of a point: what is so far that it hardly moves must not be left out."""
POINTS_PER_VIEW = 400
"""Points on the surfaces of such a view, about."""
CELLS, BEHIND = 48, 1.15
"""Cells of a coarse depth image along the longer side; a point farther away than the nearest one around it by this
factor is hidden."""
POINT_ERROR = 0.01
"""Minimum relative error of the distance of a point."""
CONTRADICTS = 6.0
"""Difference of two sources, in expected errors of both, from which one of them is wrong."""
MOST_POINTS, FARTHEST = 100_000, 1e5
"""Points that are used of a larger cloud, such as a laser scan's; distance of one from the cameras, over their own
extent, from which it is a mistake."""


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
        outputs, dataset: the training images, as the data parser lists them and as they are read.
        parser: settings of the data parser, whose COLMAP model is read if it has one.
        sfm_path: of a COLMAP model beside the frames otherwise; it need not exist.
        find_points, triangulates: search the images for points if there are no tracks; first by matched features.
        trusts: go on with cameras that contradict their images.
    """
    data = Path(parser.data)
    folder = data.parent if data.suffix == ".json" else data
    model = find_sfm_model(folder / getattr(parser, "colmap_path", sfm_path))
    observations = read_observations(outputs, dataset.cameras, model, point_cloud(outputs, parser))
    if np.ptp(observations.centers, axis=0).max() <= SAME_PLACE * max(1.0, np.abs(observations.centers).max()):
        CONSOLE.print("[bold yellow]All training cameras stand in one place: no distance can be learned.")
    if find_points:
        if not len(observations.seen_by):
            check = partial(check_cameras, file_matrices(observations, outputs, folder), trusts=trusts)
            observations = _find_points(observations, dataset, triangulates, check)
        else:
            if observations.loose is not None:
                say_once("Point cloud: not used, as the SfM tracks tell of each point which images saw it.")
                observations = replace(observations, loose=None)
            angles = keypoint_angles(observations, dataset.cameras)
            off = np.median(angles * observations.intrinsics[observations.seen_by, 0])
            tell_poses(float(off), Path(outputs.image_filenames[0]))
        observations = drop_masked(observations, dataset)
    return observations


def _find_points(
    observations: Observations,
    dataset: MMPIDataset,
    triangulates: bool,
    check: Callable[[PosedImages, SfmModel], bool],
) -> Observations:
    """Points of a scene without tracks: triangulated, and on searched surfaces if triangulation finds too few.

    ``check`` tells whether cameras were found to contradict the matches, after it said so."""
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

        stored: Mapping[str, Any] = kept("tracks", originals, (), find)
        model = SfmModel(**{**stored, "off": stored["off"].item()})
        CONSOLE.print(f"{len(model.points)} triangulated points, seen {len(model.seen_by)} times.")
        observations = with_tracks(observations, model)
        if not check(originals, model):
            tell_poses(model.off * float(images.sizes[:, 0].mean()), images.files[0])
    if images is not None and len(observations.seen_by) < ENOUGH_KEYPOINTS * len(dataset):
        CONSOLE.print("Few or no tracks: a quick search for surfaces locates the content.")
        observations = with_surfaces(observations, at_full_size(images))
    return observations


def with_surfaces(observations: Observations, images: PosedImages) -> Observations:
    """The observations with points on surfaces of some views, which are searched at a low resolution (``patches.py``).
    Points, each seen by its view and every near one it falls on, follow earlier ones."""
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
    """The cameras' matrices as they are in transforms.json, before the data parser moved and scaled them. [M, 4, 4]"""
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
    """Whether cameras contradict verified matches, said in a sentence with the convention that explains them.

    Raises InputError with this sentence where they cannot be used, unless they are to be trusted."""
    table, width = model.matches, images.sizes[:, 0]
    pairs = Matches(table[:, :2].astype(np.int64), *(table[:, c : c + 4].reshape(-1, 2, 2) for c in (2, 6)))
    lens = images.intrinsics[:, 0] / width, images.intrinsics[:, :2], images.intrinsics[:, 2:]
    as_given, better, is_wrong = find_convention(matrices, OPENGL, lens, pairs)
    if better is None and not is_wrong:
        return False
    focal, pixels = float(images.intrinsics[0, 0]), float(width.mean())
    if better is None:
        says = (
            f"The cameras contradict their images: matches are off by {as_given.error:.1%} of the width, and "
            "no usual convention of axes, inversion, focal length or lens explains them. Are the poses those of "
            "other images, or in another order?"
        )
    else:
        says = in_words(better, OPENGL, focal, pixels, as_given.error)
        says = f"The cameras contradict their images. {says}"
        full = images.files[0].parent
        if better.is_of_axes(OPENGL):
            to, poses = full.parent.with_name(f"{full.parent.name}-converted"), full.parent / "transforms.json"
            command = f"mmpi-prepare {quoted(full)} {quoted(to)} --poses {quoted(poses)}"
            says = f"{says} Convert them: {command} reads them so."
        else:
            says = f"{says} Correct the intrinsics in transforms.json."
    if is_wrong and not trusts:
        raise InputError(f"{says} To train all the same: --pipeline.datamanager.priors.trust-cameras True.")
    CONSOLE.print(says, style="bold yellow", markup=False, soft_wrap=True)
    return True


def tell_poses(off: float, image: Path) -> None:
    """Reports poses from which matches or keypoints are off by this many training pixels (median), with the command
    that refines them, for one of the training images."""
    if not off > POSES_OFF:  # or not a number, as nothing matched
        return
    full = image.parent.with_name(re.sub(r"_\d+$", "", image.parent.name))  # images for images_2
    refined, poses = full.parent.with_name(f"{full.parent.name}-refined"), full.parent / "transforms.json"
    command = f"mmpi-prepare {quoted(full)} {quoted(refined)} --poses {quoted(poses)} --refine-poses"
    says = f"The poses are off by {off:.1f} training pixels (median over the matches of the images)"
    CONSOLE.print(f"{says}: {command} mends them.", style="bold yellow", markup=False, soft_wrap=True)


def point_cloud(outputs: DataparserOutputs, parser: DataParserConfig) -> Array | None:
    """The points of a capture's cloud [P, 3] in the scene's frame; None if it has none, or they are not asked for."""
    given = outputs.metadata.get("points3D_xyz")
    if given is not None:
        return given.double().numpy()
    data = Path(parser.data)
    file = data if data.suffix == ".json" else data / "transforms.json"
    if not getattr(parser, "load_3D_points", False) or not file.is_file():
        return None
    meta = json.loads(file.read_text(encoding="utf-8"))
    if "ply_file_path" not in meta:
        return None
    points = read_ply(file.parent / meta["ply_file_path"])
    if points is None:
        return None
    transform, applied = outputs.dataparser_transform.double().numpy(), np.eye(4)
    if "applied_transform" in meta:
        applied[:3] = meta["applied_transform"]
    elif (file.parent / "colmap/sparse/0").exists():  # nerfstudio then takes the axes of its older exports
        applied[:3] = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    transform = transform @ np.linalg.inv(applied)  # from the axes of the file
    return (points @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale


def read_ply(path: Path) -> Array | None:
    """The points of a PLY file [P, 3]; None, with a warning, if it is no such file or holds none."""
    from plyfile import PlyData, PlyParseError  # slow to import; comes with nerfstudio's viewer

    try:
        points = PlyData.read(path)["vertex"]
        xyz = np.stack([np.asarray(points[name], dtype=np.float64) for name in "xyz"], -1)
    except (PlyParseError, KeyError, ValueError, TypeError, OSError, MemoryError) as error:
        says = f"{path} is not a PLY file of points ({error}): write it again."
        say_once(f"[bold yellow]{says} Training goes on without the point cloud.")
        return None
    if not len(xyz):
        say_once(f"[bold yellow]The point cloud {path} holds no point: training goes on without it.")
        return None
    return xyz


def read_observations(
    outputs: DataparserOutputs, cameras: Cameras, sfm: SfmModel | None, cloud: Array | None = None
) -> Observations:
    """Training cameras as they are used, with the SfM points and keypoints moved into their frame, and the points of a
    cloud [P, 3]. Raises InputError naming the image whose pose or intrinsics cannot be used."""
    observations = camera_observations(cameras, outputs.image_filenames)
    if cloud is not None and len(loose := usable_points(cloud, observations.centers)):
        observations = replace(observations, loose=loose)
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


def contradict(a: Map, b: Map) -> NDArray[np.bool_]:
    """Mask [...] of two sources' inverse distances [..., 2] that differ by more than their errors can explain."""
    apart = np.abs(a[..., 0] - b[..., 0]) > CONTRADICTS * np.hypot(a[..., 1], b[..., 1])
    return apart & (a[..., 0] > 0) & (b[..., 0] > 0)


def usable_points(points: Array, centers: Array) -> Array:
    """The points of a cloud [P, 3] that can be used, a random subset of ``MOST_POINTS`` if there are more; says how
    many are NaN or absurdly far away from the cameras [M, 3]."""
    middle = np.median(centers, axis=0)
    extent = float(np.ptp(centers, axis=0).max())
    with np.errstate(invalid="ignore"):
        usable = np.abs(points - middle).max(-1) < (FARTHEST * extent or np.inf)
    if not usable.all():
        say_once(
            f"{(~usable).sum():,} of {len(usable):,} points of the point cloud are not used: they are no finite "
            "numbers, or absurdly far away."
        )
    points = points[usable]
    if len(points) <= MOST_POINTS:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False))]


@dataclass(frozen=True)
class Sightings:
    """Places at which training images see the points of a cloud."""

    points: Array
    """[P, 3]"""
    seen_by: NDArray[np.int64]
    """[Q] camera."""
    seen_point: NDArray[np.int64]
    """[Q] point."""
    seen_at: Array
    """[Q, 2] pixel (x, y)."""
    confirmed: NDArray[np.int64]
    """[P] images in which a point lies at the known depth of its pixel."""
    contradicted: NDArray[np.int64]
    """[P] images whose known depth there is behind it."""

    @property
    def fits(self) -> bool:
        """True if at least as many points are confirmed as contradicted."""
        return bool((self.confirmed > self.contradicted).sum() >= (self.contradicted > self.confirmed).sum())

    def added_to(self, tracks: Observations) -> Observations:
        """The observations with these after the keypoints of their tracks; contradicted points are left out."""
        kept = (self.contradicted <= self.confirmed)[self.seen_point]
        count, first = len(tracks.seen_at), len(tracks.points)
        return replace(
            tracks,
            points=np.concatenate([tracks.points, self.points]),
            seen_by=np.concatenate([tracks.seen_by[:count], self.seen_by[kept], tracks.seen_by[count:]]),
            seen_point=np.concatenate(
                [tracks.seen_point[:count], first + self.seen_point[kept], tracks.seen_point[count:]]
            ),
            seen_at=np.concatenate([tracks.seen_at, self.seen_at[kept]]),
            loose=None,
        )

    def describe(self) -> str:
        """Number of points that are used, and their use, in one line."""
        out = self.contradicted > self.confirmed
        if not self.fits:
            return (
                f"The point cloud does not fit the images, which look through {out.sum():,} of its points where they "
                f"confirm {(self.confirmed > 0).sum():,}, so it is not used: state its frame as applied_transform in "
                "transforms.json."
            )
        used = np.unique(self.seen_point[~out[self.seen_point]])
        left_out = f"; {out.sum():,} are left out, as images look through them" if out.any() else ""
        return (
            f"Point cloud: {len(used):,} of {len(self.points):,} points are seen, {(self.confirmed > 0).sum():,} of "
            f"them where matches have a depth{left_out}. They are used for placement and depths."
        )


def see_points(points: Array, posed: PosedImages, depths: Callable[[int], Map] | None = None) -> Sightings:
    """Sightings of points [P, 3] in the training images; ``depths`` are an image's known inverse distances and their
    errors, 0 where unknown. [H, W, 2]"""
    seen: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
    confirmed, contradicted = np.zeros((2, len(points)), np.int64)
    for i, size in enumerate(posed.sizes):
        at = project(posed, i, points)
        inside = np.nonzero(((at >= 0) & (at < size)).all(-1))[0]
        at = at[inside]
        distance = np.linalg.norm(points[inside] - posed.camera_to_worlds[i, :, 3], axis=-1)
        cell = max(size) / CELLS
        columns, rows = (at / cell).astype(int).T
        nearest = np.full((int(size[1] / cell) + 1, int(size[0] / cell) + 1), np.inf)
        np.minimum.at(nearest, (rows, columns), distance)
        visible = distance < BEHIND * minimum_filter(nearest, 3, mode="nearest")[rows, columns]
        if depths is not None:
            columns, rows = at.astype(int).T
            measured = depths(i)[rows, columns]
            expected = np.outer(1 / np.maximum(distance, 1e-30), [1, POINT_ERROR]).astype(np.float32)
            has_depth, apart = measured[:, 0] > 0, contradict(expected, measured)
            visible = np.where(has_depth, ~apart, visible)
            confirmed[inside] += has_depth & ~apart
            contradicted[inside] += apart & (expected[:, 0] > measured[:, 0])
        seen.append((np.full(visible.sum(), i), inside[visible], at[visible]))
    seen_by, seen_point, seen_at = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return Sightings(points, seen_by, seen_point, seen_at, confirmed, contradicted)
