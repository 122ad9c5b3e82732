"""Depth priors of training pixels: inverse distance and expected error, from all sources.

Sources, later ones replacing earlier ones: dense matches (``dense.py``), SfM points, depth images of a sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import cast

import cv2
import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from rich.progress import track

from mmpi_ns.data.copies import size_as_read, size_of
from mmpi_ns.data.dataset import MMPIDataset, read_depth_image
from mmpi_ns.data.posed_images import PosedImages, at_full_size, posed_images
from mmpi_ns.data.priors import UNKNOWN, Codes, DepthPriors, packed, unpacked
from mmpi_ns.data.rays import Rays
from mmpi_ns.placement.observations import Observations
from mmpi_ns.utils.errors import log
from mmpi_ns.utils.host import give_back_freed_memory
from mmpi_ns.utils.parallel import in_order
from mmpi_priors.cache import Computed, digest, kept
from mmpi_priors.clouds import POINT_ERROR, contradict, see_points
from mmpi_priors.dense import Depth, find_depths
from mmpi_priors.lone_depth import continued, is_lone
from mmpi_priors.observe import drop_masked, opaque
from mmpi_priors.views import Map, View, look_up, straightened, strips

FINER, LONGEST = 2.0, 1600
"""Images are matched at this multiple of the training size, if the originals are available, and their longer side has
at most so many pixels."""
MOST_WORKING = 2.5e8
"""Total number of pixels at which images are matched (10 bytes each); larger captures are matched at a smaller size."""
COVERED = 0.3
"""Fraction of a training pixel's area in which working pixels must have a depth."""
CONTINUED = 320
"""Maximum pixels along the longer side of an image at which surfaces are extrapolated; they are smooth."""
CELLS = 32
"""Cells along the longer side of an image; placement gets one depth from each."""
SENSOR_ERROR = 0.01
"""Relative error of a sensor's depth."""
MOST_KEYPOINTS = 3.0
"""Multiple of the number of cells with a depth above which placement ignores keypoints."""


def make_depth_priors(
    outputs: DataparserOutputs,
    observations: Observations,
    dataset: MMPIDataset,
    rays: Rays,
    *,
    dense: bool,
    sensor: bool,
) -> tuple[DepthPriors | None, Observations]:
    """All available depths of the training images, and the observations with the points of a cloud, if there is one.

    ``dense`` matches neighbouring images, ``sensor`` reads depth images; without both and a cloud the depths are None.
    Raises InputError naming an image or a depth image that cannot be used.
    """
    if not (dense or sensor or observations.loose is not None):
        return None, observations
    unknown = (np.broadcast_to(np.int16(UNKNOWN), (int(h), int(w), 2)) for w, h in observations.sizes)  # of no memory
    depths, posed = DepthPriors(tuple(unknown)), posed_images(observations, dataset)
    files = outputs.metadata.get("depth_filenames") if sensor else None
    if posed is None or not (dense or files or observations.loose is not None):
        return depths, observations
    original = at_full_size(posed)
    cloud = None if observations.loose is None else see_points(observations.loose, posed)
    seen = observations if cloud is None else cloud.added_to(observations)
    if dense:
        depths = _matched_depths(original, posed, seen)
    if dense and cloud is not None:
        cloud = see_points(cloud.points, posed, depths.image)
        seen = cloud.added_to(observations) if cloud.fits else replace(observations, loose=None)
        depths = depths if cloud.fits else _matched_depths(original, posed, seen)
    if cloud is not None:
        log(cloud.describe())
        seen = drop_masked(seen, dataset)
    depths = with_points(depths, seen)
    if files:
        unit = outputs.metadata.get("depth_unit_scale_factor", 1.0) * outputs.dataparser_scale
        depths = with_sensor(depths, [Path(f) for f in files], float(unit), posed)
    depths = with_continued(depths, posed, dataset, rays)
    give_back_freed_memory()
    return depths, seen


def _matched_depths(original: PosedImages, posed: PosedImages, observations: Observations) -> DepthPriors:
    """Depths by dense matching, from the cache if possible."""
    seen_by, points = observations.tracked
    shapes = [(int(h), int(w)) for w, h in observations.sizes]
    longest, pixels = max(max(shape) for shape in shapes), sum(w * h for h, w in shapes)
    side = int(min(LONGEST, longest * min(FINER, (MOST_WORKING / pixels) ** 0.5)))

    def match() -> Iterable[Codes]:
        CONSOLE.print(f"Matching {len(shapes)} images densely, at most {side} pixels wide or high.")
        return find_depths(
            original, lambda i: points[seen_by == i], side,
            lambda i, view, depth: packed(at_training_pixels(view, depth, posed, i, shapes[i])),
            progress=lambda work, count: track(work, "Depths", count, console=CONSOLE),
        )  # fmt: skip

    return _kept("depths", original, (side, shapes, seen_by, points), match)


def _kept(
    name: str, images: PosedImages, settings: Sequence[object], find: Callable[[], Iterable[Codes]]
) -> DepthPriors:
    """The codes of all images in turn, from the cache if they are there (``cache.kept``)."""
    arrays = kept(name, images, settings, lambda: ((f"{i}", codes) for i, codes in enumerate(find())))
    # One at a time: numpy parses the header of an array with ast, which fails at times in threads of CPython 3.11.
    reading = Lock()

    def read(i: int) -> Codes:
        with reading:
            return cast(Codes, arrays[f"{i}"])

    return DepthPriors(Computed(len(arrays), read))


def with_sensor(depths: DepthPriors, files: list[Path], unit: float, posed: PosedImages) -> DepthPriors:
    """Depths with those of sensors in place of others; where the two contradict each other, neither is kept.

    ``files`` are the depth images of all training images, and ``unit`` is the length of a depth of 1, scene units.
    """

    def replaced(i: int) -> Codes:
        codes = depths.codes[i]
        shape = codes.shape[0], codes.shape[1]
        size = size_as_read(size_of(posed.files[i]), posed.sizes[i]).astype(int).tolist()
        depth = read_depth_image(files[i], unit)  # along the optical axis
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)[: shape[0], : shape[1]]
        x, y = straightened(posed, i, shape)
        longer = np.sqrt(x**2 + y**2 + 1)
        inverse = np.where(depth > 0, 1 / (np.where(depth > 0, depth, 1) * longer), 0)
        measured = packed(np.stack([inverse, SENSOR_ERROR * inverse], -1))
        apart = contradict(*(unpacked(torch.from_numpy(x)).numpy() for x in (measured, codes)))
        codes = np.where(measured[..., :1] != UNKNOWN, measured, codes)
        codes[apart] = UNKNOWN
        return codes

    return DepthPriors(Computed(len(files), replaced))


def at_training_pixels(view: View, depth: Depth, posed: PosedImages, i: int, shape: tuple[int, int]) -> Map:
    """Inverse distances and errors [H, W, 2] of training image i's pixels from the depths of its view at working size.

    A training pixel takes the mean over its area, weighted by certainty; the spread within the area, large at an
    edge, is added to its error. One that is smaller than a working pixel takes the depth of that.
    """
    height, width = (min(pair) for pair in zip(shape, view.gray.shape, strict=True))
    maps, distances = (depth.inverse, depth.error), np.empty((*shape, 2), np.float32)
    if view.gray.shape != (height, width):
        measured = (depth.inverse > 0).astype(np.float32)
        weight = measured / np.maximum(depth.error, 1e-12) ** 2
        cover, total, first, second = (
            cv2.resize(m.astype(np.float64), (width, height), interpolation=cv2.INTER_AREA)
            for m in (measured, weight, weight * depth.inverse, weight * depth.inverse**2)
        )
        mean = first / np.maximum(total, 1e-30)
        spread = np.maximum(second / np.maximum(total, 1e-30) - mean**2, 0)
        error = np.sqrt(cover / np.maximum(total, 1e-30) + spread)
        maps = tuple(np.where(cover >= COVERED, m, 0).astype(np.float32) for m in (mean, error))
    fx, fy, cx, cy = view.pinhole
    scale_x, scale_y = width / view.gray.shape[1], height / view.gray.shape[0]
    for rows in strips(shape):
        x, y = straightened(posed, i, shape, rows)
        at, longer = ((fx * x + cx) * scale_x, (fy * y + cy) * scale_y), np.sqrt(x**2 + y**2 + 1)
        for n, values in enumerate(maps):
            distances[rows, :, n] = look_up(values, *at, nearest=True) / longer
    return distances


def with_continued(depths: DepthPriors, posed: PosedImages, dataset: MMPIDataset, rays: Rays) -> DepthPriors:
    """Depths with surfaces extrapolated into regions that hardly any other image sees (``lone_depth.py``); cached.

    Masked and transparent pixels get no distance: moving objects have no fixed position, what is cut out has none.
    """

    def codes_of(i: int) -> Codes:
        """Computed for every n-th pixel of a large image."""
        codes, hidden = np.array(depths.codes[i]), ~opaque(dataset, i)[..., None]
        np.copyto(codes, UNKNOWN, where=hidden)
        step = -(-max(codes.shape[:2]) // CONTINUED)
        rows, columns = (np.minimum(np.arange(0, n, step) + step // 2, n - 1) for n in codes.shape[:2])
        pixels = np.stack(np.meshgrid(i, rows, columns, indexing="ij"), -1).reshape(-1, 3)
        directions = rays(torch.from_numpy(pixels)).directions.cpu().numpy().reshape(len(rows), len(columns), 3)
        sparse = unpacked(torch.from_numpy(codes[np.ix_(rows, columns)])).numpy()
        extended = continued(sparse, directions)
        down, across = np.nonzero(extended[..., 0])
        points = posed.camera_to_worlds[i, :, 3] + directions[down, across] / extended[down, across, :1]
        seen = ~is_lone(posed, i, points)
        extended[down[seen], across[seen]] = 0
        fine = packed(extended).repeat(step, 0).repeat(step, 1)[: codes.shape[0], : codes.shape[1]]
        np.copyto(codes, fine, where=codes[..., :1] == UNKNOWN)
        np.copyto(codes, UNKNOWN, where=hidden)
        return codes

    count = len(depths.codes)
    is_cut = dataset.has_masks or dataset.has_alpha
    masks = [digest((), opaque(dataset, i)) for i in range(count)] if is_cut else []
    contents = [digest((), codes) for codes in depths.codes]
    work = "Extrapolating surfaces"
    return _kept(
        "continued", posed, (contents, masks),
        lambda: track(in_order(codes_of, range(count)), work, count, console=CONSOLE),
    )  # fmt: skip


def of_cells(observations: Observations, depths: DepthPriors, dataset: MMPIDataset) -> Observations:
    """The observations for placement: of each image cell the pixel with the most certain depth.

    Keypoints come before them unless they are ``MOST_KEYPOINTS`` times as many: they would then draw MPIs and texels to
    the parts of the images that an SfM model or a cloud is densest in. Points of estimated surfaces are less accurate
    and are dropped. Without depths nothing changes.
    """

    def points_of(i: int) -> NDArray[np.float64]:
        depth = depths.image(i)
        height, width = depth.shape[:2]
        side = max(1, -(-max(height, width) // CELLS))
        relative = np.full((-(-height // side) * side, -(-width // side) * side), np.inf, np.float32)
        relative[:height, :width] = np.where(
            depth[..., 0] > 0, depth[..., 1] / np.maximum(depth[..., 0], 1e-12), np.inf
        )
        cells = relative.reshape(len(relative) // side, side, -1, side).swapaxes(1, 2).reshape(-1, side * side)
        best, known_cells = cells.argmin(1), np.nonzero(np.isfinite(cells.min(1)))[0]
        down, across = np.divmod(known_cells, relative.shape[1] // side)
        rows, columns = down * side + best[known_cells] // side, across * side + best[known_cells] % side
        if not len(rows):  # some of nerfstudio's lenses cannot make no rays
            return observations.points[:0]
        coords = torch.from_numpy(np.stack([rows, columns], -1) + 0.5).float()
        rays = dataset.cameras.generate_rays(torch.full((len(rows), 1), i), coords=coords)
        return observations.centers[i] + rays.directions.double().numpy() / depth[rows, columns, :1]

    points = list(in_order(points_of, range(len(depths.codes))))
    cells = np.concatenate(points)
    if not len(cells):
        return observations
    tracked = len(observations.seen_at)
    stays = 0 < tracked <= MOST_KEYPOINTS * len(cells)
    observations = observations.with_keypoints(np.arange(len(observations.seen_by)) < stays * tracked)
    if not stays:
        observations = replace(observations, points=cells[:0])
    return replace(
        observations,
        points=np.concatenate([observations.points, cells]),
        seen_by=np.concatenate([observations.seen_by, np.repeat(np.arange(len(points)), [len(p) for p in points])]),
        seen_point=np.concatenate([observations.seen_point, len(observations.points) + np.arange(len(cells))]),
    )


def with_points(depths: DepthPriors, observations: Observations) -> DepthPriors:
    """Depths with the distances of SfM points at their keypoints; the nearest where several fall on one pixel."""
    cameras, points = observations.tracked
    distance = np.linalg.norm(points - observations.centers[cameras], axis=-1)
    inverse = packed(np.outer(1 / np.maximum(distance, 1e-30), [1, POINT_ERROR]))
    columns, rows = observations.seen_at.astype(int).T

    def added(i: int) -> Codes:
        codes = np.array(depths.codes[i])
        inside = (rows >= 0) & (rows < codes.shape[0]) & (columns >= 0) & (columns < codes.shape[1])
        chosen = np.nonzero((cameras == i) & inside & (distance > 0))[0]
        chosen = chosen[np.argsort(-distance[chosen], kind="stable")]  # the last one written stays
        codes[rows[chosen], columns[chosen]] = inverse[chosen]
        return codes

    return DepthPriors(Computed(len(depths.codes), added))
