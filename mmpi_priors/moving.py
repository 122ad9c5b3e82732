"""Masks of moving objects: cars and people that no static scene can explain.

Every image is compared with its neighbours at reduced size (``moving_evidence.py``), also at inverse depths that are
impossible for static points (``moving_sweep.py``); pixels that fit none grow to objects (``moving_objects.py``). A
second pass near images with moving objects ignores those objects in the neighbours, and only its own detections are
tracked into other images; outlines are computed again at the end (``moving_outline.py``). In a video, key images are
compared with each other, and the images between them only near moving objects.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from rich.progress import track

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.files import opened
from mmpi_ns.utils.parallel import in_order, num_threads, one_thread_each
from mmpi_priors.cache import Arrays, Computed, kept
from mmpi_priors.dense import Depth, Progress, find_depths, mean_and_contrast
from mmpi_priors.moving_carry import Carried, carried
from mmpi_priors.moving_doubt import doubt_of
from mmpi_priors.moving_evidence import Evidence, Mask, Neighbour, Shot, evidence, ground_of, horizon_of
from mmpi_priors.moving_follow import upright_objects
from mmpi_priors.moving_objects import UNASKED, followed, grown, is_static, seeds, touching
from mmpi_priors.moving_outline import outlined
from mmpi_priors.moving_sweep import Sweep, sweep
from mmpi_priors.upright import upright
from mmpi_priors.views import Parallax, View, look_up, project, straightened, straightened_color

SIDE = 384
"""Longer side of the images at working size, pixels."""
RANKS = (0, 1, 2, 3, 5, 8)
"""Neighbours that an image is compared with, by distance: farther ones see what a slow object occludes in near ones."""
MAX_ANGLE = 40.0
"""Maximum angle between the directions of images that are compared, degrees."""
ROUNDS = (2, 1)
"""Of dense matching: at half the size, then at that size."""
AFTER = 2
"""Nearest neighbours from which objects are tracked by optical flow."""
FURTHER, SIDES, ASIDE = 2, 8, 0.005
"""Maximum number of images that objects are tracked through at the sides of a drive; width of a side as a share of the
image's; minimum share of an image that is newly masked there."""
EDGE = 0.4
"""Share of moving pixels around a pixel from which it is masked."""
LARGE = 0.015
"""Minimum share of masked pixels in the image that has most; below it nothing is masked."""
COMPARED, FIRST, FEW = 0.02, 0.06, 30
"""Maximum median displacement of points from a key image to the next, in widths: of key images that others are compared
with (in consecutive images slow objects occlude the same background), and of those that are searched first; and minimum
number of points for it."""
KNOWN, CONTRAST = 0.5, 3.0
"""Share of the textured pixels (standard deviation of gray levels around them) whose depths other images confirm, in
half of the images at least, or nothing is masked: where most pixels have no confirmed depth, motion cannot be told from
occlusion and failed matches. On a procedural walk it is 0.62, and 90 % of the people are masked; with every third of
its images 0.52 and 21 %; on a film of one frame a second 0.39, and rocks were masked instead of the man."""
ENOUGH, SAMPLES = 200, 5000
"""Minimum and maximum number of pixels of equal depth in both images from which their exposures are compared."""
SHOWN, COLUMNS, WIDTH = 24, 4, 320
"""Images in the picture for reports, those in a row, and pixels across each."""
RED = (0, 0, 127)
"""Blue, green, red that is mixed in equal parts with masked pixels."""


def find_moving(
    images: PosedImages,
    points_of: Callable[[int], NDArray[np.float64]],
    progress: Progress = lambda work, _: work,
) -> tuple[list[View], list[Mask], str]:
    """Views of images at working size, masks of moving objects in them, and a sentence why the masks are doubtful, if
    they are; the number of threads does not change the result. ``images`` are the originals, ``points_of`` gives the
    SfM points [P, 3] of one, and ``progress`` wraps the images as they are worked on."""
    up = upright(images.camera_to_worlds)

    def shot_of(i: int, view: View, depth: Depth) -> Shot:
        color = cv2.GaussianBlur(straightened_color(images, i, view), (0, 0), 1.0)
        ground, level = ground_of(view, depth, up), horizon_of(view, up)
        horizon = None if ground is None else level
        return Shot(view, np.asarray(color, np.uint8), depth, ground, horizon, level=level)

    keys = key_images(images, points_of, COMPARED)
    shots = list(find_depths(images, points_of, SIDE, shot_of, progress, ROUNDS, keys))
    near = [neighbours(images, i, keys) for i in range(len(shots))]
    masks = [np.zeros(shot.view.gray.shape, bool) for shot in shots]
    nothing, first = masks.copy(), {}
    if message := too_few_depths(shots):
        return [shot.view for shot in shots], nothing, message

    def look(i: int) -> tuple[Mask, _Look]:
        return _moving_pixels(shots, near[i], i, nothing, nothing[i], None)

    with one_thread_each(), ThreadPoolExecutor(num_threads()) as pool:
        part = key_images(images, points_of, FIRST)
        while part:
            for i, (mask, seen) in zip(part, pool.map(look, part), strict=True):
                masks[i], first[i] = mask, seen
            part = [i for i in range(len(shots)) if i not in first and any(masks[j].any() for j in near[i])]
        uprights = upright_objects(shots, near, masks, pool)
        masks = [mask | more for mask, more in zip(masks, uprights, strict=True)]
        again = [i for i in first if any(masks[j].any() for j in near[i])]
        second = list(pool.map(lambda i: _moving_pixels(shots, near[i], i, masks, uprights[i], first[i]), again))
        for i, (mask, _) in zip(again, second, strict=True):
            masks[i] = mask
        looks = {i: look for i, (_, look) in zip(again, second, strict=True)}
        masks = _followed_on(shots, near, masks, looks, pool)
        # Moving objects come close at some time; false detections are mostly small.
        if max((mask.mean() for mask in masks), default=0.0) >= LARGE:
            masks = _outlined(shots, near, masks, looks, pool)
        else:
            masks = nothing
    return [shot.view for shot in shots], masks, doubt_of(shots, up, masks)


def reaches_side(mask: Mask) -> bool:
    """Whether a mask covers much of an image's left or right side."""
    side = mask.shape[1] // SIDES
    return max(int(mask[:, :side].sum()), int(mask[:, -side:].sum())) > ASIDE * mask.size


def neighbours(images: PosedImages, i: int, keys: Sequence[int]) -> list[int]:
    """The key images that an image is compared with, nearest first."""
    nearest = nearest_views(images.camera_to_worlds, i, RANKS[-1] + 1, MAX_ANGLE, keys)
    return [nearest[rank] for rank in RANKS if rank < len(nearest)]


def key_images(images: PosedImages, points_of: Callable[[int], NDArray[np.float64]], spacing: float) -> list[int]:
    """Key images: the fewest, in order, whose points are displaced by at most ``spacing`` (median, in widths) from the
    previous one; all images, unless they are dense as in a video."""

    def shift(i: int, j: int) -> float:
        points = points_of(i)
        if len(points) < FEW:
            return np.inf
        moved = np.linalg.norm(project(images, j, points) - project(images, i, points), axis=-1)
        return float(np.median(moved)) / float(images.sizes[i].max())

    keys, last = [0], len(images.files) - 1
    while keys[-1] < last:
        first = keys[-1]
        far = (j for j in range(first + 1, last + 1) if not shift(first, j) < spacing)
        keys.append(max(first + 1, next(far, last + 1) - 1))
    return keys


def too_few_depths(shots: Sequence[Shot]) -> str:
    """A sentence if so few of the textured pixels of shots have a depth that nothing is masked, else empty."""
    shares = []
    for shot in shots:
        textured = shot.view.inside & (mean_and_contrast(shot.view.gray)[1] > CONTRAST)
        shares.append(float((shot.depth.inverse > 0)[textured].mean()) if textured.any() else 1.0)
    if (share := float(np.median(shares))) >= KNOWN:
        return ""
    return (
        f"Nothing is masked, as other images confirm the depths of {share:.0%} of the textured pixels alone: too few "
        "to tell motion from occlusion. People who walk along may be left in: take images closer together "
        "(of a video: mmpi-prepare --max-frames), or mask them by hand (mask_path)."
    )


def in_image(view: View, mask: Mask, images: PosedImages, i: int, shape: tuple[int, int]) -> Mask:
    """A mask of the undistorted view of image i of the originals as a mask of the image itself, which may be a copy of
    another size: ``shape`` is its height and width."""
    x, y = straightened(images, i, shape)
    fx, fy, cx, cy = view.pinhole
    return look_up(mask.astype(np.float32), fx * x + cx, fy * y + cy) > EDGE


def moving_masks(
    images: PosedImages,
    shapes: Sequence[tuple[int, int]],
    seen_by: NDArray[np.integer],
    points: NDArray[np.float64],
) -> tuple[Sequence[Mask], str]:
    """Masks of moving objects in each image [H, W], and the doubt of ``find_moving``, from the cache if possible.
    ``images`` are the originals, ``shapes`` height and width of each mask, ``seen_by`` the image [N] of each observed
    point [N, 3]."""

    def find() -> Arrays:
        deque(in_order(_decode, images.files), maxlen=0)  # names a damaged file, for which OpenCV would print warnings
        views, masks, doubt = find_moving(
            images, lambda i: points[seen_by == i],
            progress=lambda work, count: track(work, "Moving objects", count, console=CONSOLE),
        )  # fmt: skip
        return {
            f"{i}": np.packbits(in_image(v, m, images, i, s) if m.any() else np.zeros(s, bool))
            for i, (v, m, s) in enumerate(zip(views, masks, shapes, strict=True))
        } | {"doubt": np.frombuffer(doubt.encode(), np.uint8)}

    stored = kept("moving", images, (shapes, seen_by, points), find)

    def unpacked(i: int) -> Mask:
        height, width = shapes[i]
        return np.unpackbits(np.asarray(stored[f"{i}"], np.uint8), count=height * width).reshape(height, width) > 0

    return Computed(len(shapes), unpacked), bytes(np.asarray(stored["doubt"], np.uint8)).decode()


def _decode(file: Path) -> None:
    with opened(file) as image:
        image.load()


def share_of_moving(masks: Sequence[Mask]) -> str:
    """Share of moving pixels in the training images, as a sentence."""
    shares = np.array([mask.mean() for mask in masks])
    if not shares.any():
        return "No moving objects are detected in the training images"
    count = np.count_nonzero(shares)
    return (
        f"{100 * shares.mean():.1f} % of the training pixels, in {count} of {len(masks)} images, show moving objects "
        "and are masked"
    )


def draw_moving(path: Path, files: Sequence[Path], masks: Sequence[Mask]) -> None:
    """Writes the images with most moving pixels, in order, with masks in red.

    Args:
        path: file of the picture; its folder is made.
        files: of the images.
        masks: of moving objects in each image [H, W]; not all empty.
    """
    shares = [float(mask.mean()) for mask in masks]
    tiles = []
    for i in sorted(sorted(range(len(masks)), key=lambda i: -shares[i])[:SHOWN]):
        if shares[i] == 0:
            continue
        height = round(WIDTH * masks[i].shape[0] / masks[i].shape[1])
        image = cv2.imread(str(files[i]), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        tile = np.asarray(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
        mask = cv2.resize(masks[i].astype(np.float32), (WIDTH, height), interpolation=cv2.INTER_AREA) > EDGE
        tile[mask] = tile[mask] // 2 + np.array(RED, np.uint8)
        cv2.putText(tile, files[i].name, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 255, 255), 1)
        tiles.append(tile)
    height = max(tile.shape[0] for tile in tiles)
    tiles = [cv2.copyMakeBorder(t, 0, height - t.shape[0], 0, 0, cv2.BORDER_CONSTANT) for t in tiles]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows))


def gain_of(shot: Shot, other: Shot) -> NDArray[np.float64]:
    """Gains of blue, green and red that bring another shot to the exposure of this one, from pixels of equal depth.
    [3]"""
    rows, columns = np.nonzero(shot.depth.inverse)
    some = np.s_[:: max(1, len(rows) // SAMPLES)]
    rows, columns = rows[some], columns[some]
    parallax, inverse = Parallax.between(shot.view, other.view), shot.depth.inverse[rows, columns]
    right, down, ahead = parallax.linear @ [columns + 0.5, rows + 0.5, np.ones(len(rows))] + np.outer(
        parallax.b, inverse
    )
    ahead = np.where(ahead > 0, ahead, np.nan)
    x, y = right / ahead, down / ahead
    theirs = look_up(other.depth.inverse, x, y, nearest=True)
    same = np.abs(theirs * ahead - inverse) < 0.05 * inverse
    if np.count_nonzero(same) < ENOUGH:
        return np.ones(3)
    theirs = look_up(other.color, x[same], y[same])
    mine, theirs = (np.log(c + 2.0) for c in (shot.color[rows[same], columns[same]], theirs))
    return np.exp(np.median(mine - theirs, 0))


@dataclass(frozen=True)
class _Look:
    """State of an image in the search."""

    gains: list[NDArray[np.float64]]
    """Gains of its neighbours. [3] each"""
    swept: Sweep
    levels: NDArray[np.int16]
    """Of ``seeds``. [h, w]"""
    weighed: Evidence
    core: Mask
    """Pixels that certainly move, from which objects grow. [h, w]"""


def _others(
    shots: Sequence[Shot], near: Sequence[int], i: int, gains: Sequence[NDArray[np.float64]]
) -> list[Neighbour]:
    """Neighbours of an image, at its exposure."""
    return [Neighbour.of(shots[i], shots[j], gain) for j, gain in zip(near, gains, strict=True)]


def _moving_pixels(
    shots: Sequence[Shot], near: Sequence[int], i: int, masks: Sequence[Mask], uprights: Mask, first: _Look | None
) -> tuple[Mask, _Look]:
    """Moving pixels of an image by its own evidence, given the masks of others and where it sees their objects."""
    shot = shots[i]
    gains = first.gains if first else [gain_of(shot, shots[j]) for j in near]
    others = _others(shots, near, i, gains)
    swept = first.swept if first else sweep(shot, others)
    levels = first.levels if first else np.full(uprights.shape, UNASKED, np.int16)
    weighed = evidence(shot, others, [masks[j] for j in near], swept.impossible)
    core = uprights | (swept.certain & ~is_static(shot, weighed))
    if len(others) >= 2:
        core |= seeds(shot, others, weighed, levels)
    return grown(shot, weighed, core), _Look(gains, swept, levels, weighed, core)


def _followed_on(
    shots: Sequence[Shot],
    near: Sequence[Sequence[int]],
    masks: list[Mask],
    looks: dict[int, _Look],
    pool: ThreadPoolExecutor,
) -> list[Mask]:
    """Masks [h, w] with objects that are tracked into the images of the second pass: by optical flow and along the
    path, and on along it from image to image where objects enter or leave images at the side. Tracked objects join the
    seeds in ``looks``."""

    def followed_to(part: Iterable[int], some_of: Callable[[int], Mask]) -> list[Mask]:
        def whole(i: int) -> Mask:
            shot, look = shots[i], looks[i]
            some = some_of(i) & ~is_static(shot, look.weighed)
            if not (some & ~masks[i]).any():
                return masks[i]
            looks[i] = replace(look, core=look.core | some)
            return masks[i] | grown(shot, look.weighed, looks[i].core)

        arrived = dict(zip(part, pool.map(whole, part), strict=True))
        return [arrived.get(i, mask) for i, mask in enumerate(masks)]

    def by_flow(i: int) -> Mask:
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        flow.setVariationalRefinementIterations(0)
        result = np.zeros_like(masks[i])
        for j in near[i][:AFTER]:
            if masks[j].any():
                result |= followed(shots[i], shots[j], masks[j], flow)
        return result

    def along_path(i: int) -> Carried:
        others = _others(shots, near[i], i, looks[i].gains)
        return carried(shots[i], others, [masks[j] for j in near[i]], masks[i])

    def everywhere(i: int) -> Mask:
        carry = along_path(i)
        return by_flow(i) | carry.pixels | carry.objects | (uprights[i] & ~touching(uprights[i], masks[i]))

    uprights = upright_objects(shots, near, masks, pool)
    before, masks = masks, followed_to(looks, everywhere)
    for _ in range(FURTHER):
        aside = [reaches_side(mask & ~old) for mask, old in zip(masks, before, strict=True)]
        part, before = [i for i in looks if any(aside[j] for j in near[i][:AFTER])], masks
        masks = followed_to(part, lambda i: along_path(i).objects)
    return masks


def _outlined(
    shots: Sequence[Shot],
    near: Sequence[Sequence[int]],
    masks: Sequence[Mask],
    looks: dict[int, _Look],
    pool: ThreadPoolExecutor,
) -> list[Mask]:
    """Masks [h, w] with better outlines, in the images of the second pass."""

    def outline(i: int) -> Mask:
        others = _others(shots, near[i], i, looks[i].gains)
        return outlined(shots[i], others, [masks[j] for j in near[i]], masks[i], looks[i].core, looks[i].weighed.noise)

    part = [i for i in looks if masks[i].any()]
    better = dict(zip(part, pool.map(outline, part), strict=True))
    return [better.get(i, mask) for i, mask in enumerate(masks)]
