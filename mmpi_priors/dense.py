"""Depth of most pixels of the training images: dense matches between neighbouring views, each with its error.

Every image is compared with its nearest neighbours. A rough depth, from SfM points and PatchMatch planes at a low
resolution (``patches.py``), warps the neighbour into the image, so that the remaining displacement, estimated by
optical flow (``ops/motion``), is small. A match on its epipolar line gives an inverse depth; consistent matches of
several neighbours are averaged; where there are hardly any, the planes' depths remain. Threads share the images (OpenCV
and NumPy release Python's lock), and an image is in memory only while its neighbours are worked on.

A point at inverse depth q appears in the neighbour at the homogeneous pixel a + q b, where a is linear in the pixel. A
match there gives two linear equations r + q s = 0, in pixels once divided by the point's depth: q is their
least-squares solution, the residual is the distance from the epipolar line, and |s| / depth is the parallax in pixels
for each unit of q (``ops/matches``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.host import give_back_freed_memory
from mmpi_ns.utils.parallel import in_turn, num_threads, one_thread_each
from mmpi_priors.ops.matches import Measured, average_matches, compare_depths, follow_motion, solve_matches
from mmpi_priors.ops.motion import find_motion
from mmpi_priors.patches import search_surfaces
from mmpi_priors.views import Map, Parallax, View, load_view, look_up, pixel_grid

T = TypeVar("T")
Progress = Callable[[Iterable[Any], int], Iterable[Any]]
"""Progress wrapper of an iterable and its length."""
Flow = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float32]]
"""Optical flow from one image to another, right and down, pixels. [H, W, 2]"""

NEIGHBOURS, MAX_ANGLE = 4, 40.0
"""Nearest views that each image is compared with, and the largest angle in degrees between their directions."""
LARGE = 640
"""Pixels along the longer side of a large image."""
LEAST_FLOW = 16
"""Pixels of an image's shorter side from which on it is matched at a reduced size."""
SMALLEST = 12
"""Minimum shorter side for optical flow, pixels."""
ROUNDS, SEARCHED = {False: (1, 1, 1), True: (2, 1)}, {False: (1, 1), True: (1,)}
"""Rounds of matching, of small and of large images, at the working size divided by this; and with surfaces."""
STRIDE, COMPARISONS = {False: 5, True: 6}, 6
"""Pixels between patches of the optical flow, in small and in large images, and most comparisons of each."""
NOISE, MAX_EPIPOLAR = 0.3, 1.0
"""Standard deviation of a match where images look alike, and its largest epipolar distance, working pixels."""
WINDOW = 7
"""Side of the window in which images are compared, working pixels."""
MIN_CORRELATION, MIN_CONTRAST = 0.5, 1.0
"""Least correlation of windows that match, and least standard deviation of their gray levels."""
EDGE, STEP = 9, 1.1
"""Factor between inverse depths at an edge, and side of the window in which it is sought, pixels. Background there
moves with the foreground."""
OWN_CONTRAST = 4.0
"""Standard deviation of gray levels in 3 x 3 pixels that a match near an edge needs."""
SAME_DEPTH = 0.03
"""The depths of a point in two images agree within this fraction plus three of their errors."""
MAX_RELATIVE = 0.15
"""Maximum relative error of a depth."""
AROUND, MEASURED = 1 / 20, 0.5
"""Side of the square about a pixel, as a fraction of the longer side of the image, and the share of measured pixels in
it above which planes add no depth: in gaps between matches they lowered the quality of the images."""
PRIOR_ERROR = 0.5
"""Relative error of the initial rough depths, against which measured ones are weighted."""
TRIMMED = 8
"""Number of images after which free memory is returned: glibc keeps it in pieces, per thread."""


@dataclass(frozen=True)
class Depth:
    """Inverse depth along the optical axis, and its expected error; both 0 where there is none. [h, w]"""

    inverse: Map
    error: Map


def rough_inverse_depth(view: View, points: NDArray[np.float64]) -> Map:
    """Inverse depth of every pixel [h, w], interpolated between SfM points [P, 3] of the image."""
    height, width = view.gray.shape
    local = (points - view.pose[:, 3]) @ view.pose[:, :3]
    local = local[local[:, 2] < 0]
    inverse = -1 / local[:, 2]
    fx, fy, cx, cy = view.pinhole
    at = np.stack([fx * local[:, 0] * inverse + cx, cy - fy * local[:, 1] * inverse], -1)
    at, first = np.unique(at.round(2), axis=0, return_index=True)
    inverse = inverse[first]
    if len(at) < 4 or np.linalg.matrix_rank(at - at.mean(0), tol=1.0) < 2:
        middle = float(np.median(inverse)) if len(inverse) else 0.0
        return np.full((height, width), middle, np.float32)
    step = 8
    x, y = np.meshgrid(np.arange(0, width + step, step), np.arange(0, height + step, step))
    coarse = LinearNDInterpolator(at, inverse)(x, y)
    if (outside := ~np.isfinite(coarse)).any():
        coarse[outside] = NearestNDInterpolator(at, inverse)(x[outside], y[outside])
    grid_x, grid_y = pixel_grid((height, width))
    return look_up(coarse.astype(np.float32), grid_x / step + 0.5, grid_y / step + 0.5)


def measure(view: View, neighbour: View, start: Map, flow: Flow, of_view: tuple[Map, Map]) -> Measured:
    """Inverse depths of a view's pixels by comparison with another view, from rough inverse depths and the view's
    ``mean_and_contrast``; ``flow`` computes optical flow."""
    parallax = Parallax.between(view, neighbour)
    x, y, _ = parallax.pixels(start)
    motion = flow(view.gray, look_up(neighbour.gray, x, y))
    at = follow_motion(torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(motion))
    x, y = at.x.numpy(), at.y.numpy()
    seen = look_up(np.ascontiguousarray(neighbour.inside, np.uint8), x, y, nearest=True) > 0
    alike = correlation(view.gray, look_up(neighbour.gray, x, y), of_view)
    usable = view.inside & seen & (alike > MIN_CORRELATION) & (of_view[1] > MIN_CONTRAST)
    matches = at.x, at.y, torch.from_numpy(alike), torch.from_numpy(usable)
    return solve_matches(*matches, *parallax.tensors, NOISE**2, MAX_EPIPOLAR**2)


def mean_and_contrast(image: NDArray[np.uint8]) -> tuple[Map, Map]:
    """Mean and standard deviation in a window about each pixel of an image."""
    mean, contrast = _mean(image), _mean(image, squared=True)
    contrast -= mean * mean
    return mean, np.sqrt(np.maximum(contrast, 0, out=contrast), out=contrast)


def correlation(a: NDArray[np.uint8], b: NDArray[np.uint8], of_a: tuple[Map, Map]) -> Map:
    """Normalised correlation of two images in a window about each pixel, by ``mean_and_contrast`` of the first."""
    of_b, alike = mean_and_contrast(b), _mean(np.asarray(cv2.multiply(a, b, dtype=cv2.CV_16U)))
    alike -= of_a[0] * of_b[0]
    alike /= np.maximum(of_a[1], 1) * np.maximum(of_b[1], 1)
    return alike


def _mean(x: NDArray[Any], side: int = WINDOW, *, squared: bool = False) -> Map:
    """Mean of an image, or of its squares, in a square about each pixel."""
    box_filter = cv2.sqrBoxFilter if squared else cv2.boxFilter
    return np.asarray(box_filter(x, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)


def find_depths(
    images: PosedImages,
    points_of: Callable[[int], NDArray[np.float64]],
    side: int,
    finish: Callable[[int, View, Depth], T] = lambda _, view, depth: (view, depth),
    progress: Progress = lambda work, _: work,
    rounds: Sequence[int] | None = None,
    among: Sequence[int] | None = None,
) -> Iterator[T]:
    """Depths of all images in turn, on all threads; their number does not change the result.

    Args:
        images: the training images in their originals.
        points_of: SfM points [P, 3] of an image.
        side: longer side of the images at working size, pixels, at most.
        finish: makes an image's result from its number, its view at working size, and its depths.
        progress: wraps the images as they are worked on, each twice.
        rounds: of matching; None: by size.
        among: the images that others may be compared with; None for all.
    """
    with one_thread_each(), ThreadPoolExecutor(num_threads()) as pool:
        results = in_turn(_tasks(pool, images, points_of, side, finish, rounds, among), num_threads() + 1)
        for n, (is_last, result) in enumerate(progress(results, 2 * len(images.files))):
            if n % TRIMMED == 0:
                give_back_freed_memory()
            if is_last:
                yield result


def _tasks(
    pool: ThreadPoolExecutor,
    images: PosedImages,
    points_of: Callable[[int], NDArray[np.float64]],
    side: int,
    finish: Callable[[int, View, Depth], T],
    rounds: Sequence[int] | None,
    among: Sequence[int] | None,
) -> Iterator[tuple[bool, Future[Any]]]:
    """Tasks that match and confirm images, in an order in which no thread waits for a later task; True: an image's last
    task.

    An image is released once all tasks that need it are submitted; they keep the only references.
    """

    def match(i: int, views: list[Future[View]]) -> Depth:
        view, *others = (future.result() for future in views)
        return matched(view, others, points_of(i), rounds)

    def confirm(i: int, matches: list[tuple[Future[View], Future[Depth]]]) -> T:
        (view, depth), *others = ((one.result(), other.result()) for one, other in matches)
        return finish(i, view, confirmed(view, depth, others))

    # Each image, then its neighbours.
    near = [
        [i, *nearest_views(images.camera_to_worlds, i, NEIGHBOURS, MAX_ANGLE, among)] for i in range(len(images.files))
    ]
    last_uses = {j: i for i, views in enumerate(near) for j in views}
    views_of: dict[int, Future[View]] = {}
    depths: dict[int, Future[Depth]] = {}
    first = 0
    for i, views in enumerate(near):
        for j in views:
            if j not in views_of:
                views_of[j] = pool.submit(load_view, images, j, side)
        depths[i] = pool.submit(match, i, [views_of[j] for j in views])
        yield False, depths[i]
        while first < len(near) and max(near[first]) <= i:
            yield True, pool.submit(confirm, first, [(views_of[j], depths[j]) for j in near[first]])
            for j in [j for j, last in last_uses.items() if last == first]:
                del views_of[j], depths[j]
            first += 1


def matched(view: View, others: list[View], points: NDArray[np.float64], rounds: Sequence[int] | None = None) -> Depth:
    """Depths of a view by comparison with other views: planes at a low resolution, then optical flow, and planes again
    where that gives hardly any. ``rounds`` of optical flow alone, if there are any."""
    if not others or min(view.gray.shape) < SMALLEST:
        return Depth(*np.zeros((2, *view.gray.shape), np.float32))
    is_large = max(view.gray.shape) >= LARGE
    flow: Flow = partial(find_motion, stride=STRIDE[is_large], rounds=COMPARISONS)
    if rounds:  # OpenCV's flow, with which the settings of moving-object detection were chosen
        search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        search.setFinestScale(0)
        search.setVariationalRefinementIterations(0)
        search.setGradientDescentIterations(8)
        search.setPatchStride(STRIDE[False])
        flow = partial(search.calc, flow=None)  # type: ignore[arg-type]
    rough, depth = rough_inverse_depth(view.reduced(rounds[0]) if rounds else view, points), None
    surfaces = None if rounds else search_surfaces(view, others, rough)
    if surfaces is not None:
        depth = Depth(surfaces.inverse, surfaces.error)
    for factor in rounds or (SEARCHED if surfaces else ROUNDS)[is_large]:
        if factor > 1 and min(view.gray.shape) < LEAST_FLOW * factor:
            continue
        if depth is not None:  # rough depths are pulled towards measured ones nearby, from coarse to fine
            rough = np.asarray(cv2.resize(rough, depth.inverse.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
            relative = depth.error / np.maximum(depth.inverse, 1e-12)
            weight = np.where(depth.inverse > 0, 1 / np.maximum(relative, 0.01), 0).astype(np.float32)
            for side in (65, 33, 17, 9):
                near = _mean(weight, side)
                share = near / (near + PRIOR_ERROR)
                rough = share * _mean(weight * depth.inverse, side) / np.maximum(near, 1e-9) + (1 - share) * rough
        small = view.reduced(factor)
        rough = np.asarray(cv2.resize(rough, small.gray.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
        of_view = mean_and_contrast(small.gray)
        pairs = [measure(small, neighbour.reduced(factor), rough, flow, of_view) for neighbour in others]
        mean = average_matches(*map(torch.stack, zip(*pairs, strict=True)), MAX_RELATIVE)
        depth = without_fringes(small, Depth(mean.inverse.numpy(), mean.certainty.numpy()))
    assert depth is not None
    if surfaces is None:
        return depth
    # The depths of planes where hardly any is measured.
    is_measured, (inverse, error) = depth.inverse > 0, surfaces.enlarged(depth.inverse.shape)
    side = 2 * int(max(is_measured.shape) * AROUND / 2) + 1
    is_bare = ~is_measured & (_mean(is_measured.astype(np.float32), side) < MEASURED)
    return Depth(np.where(is_bare, inverse, depth.inverse), np.where(is_bare, error, depth.error))


def without_fringes(view: View, depth: Depth) -> Depth:
    """Depths without the fringes around foreground objects where the background has no texture."""
    has_depth = depth.inverse > 0
    least = cv2.erode(np.where(has_depth, depth.inverse, 1e30).astype(np.float32), np.ones((EDGE, EDGE), np.uint8))
    variance = _mean(view.gray, 3, squared=True) - _mean(view.gray, 3) ** 2
    kept = has_depth & ((depth.inverse / STEP < least) | (variance > OWN_CONTRAST**2))
    return Depth(np.where(kept, depth.inverse, 0), np.where(kept, depth.error, 0))


def confirmed(view: View, depth: Depth, others: list[tuple[View, Depth]]) -> Depth:
    """Depths that more of the other images confirm than contradict."""
    confirm, contradict = np.zeros(depth.inverse.shape, np.int8), np.zeros(depth.inverse.shape, np.int8)
    for neighbour, theirs in others:
        here, there = ((torch.from_numpy(d.inverse), torch.from_numpy(d.error)) for d in (depth, theirs))
        parallax = Parallax.between(view, neighbour).tensors
        confirms, contradicts = compare_depths(*here, *there, *parallax, SAME_DEPTH)
        confirm += confirms.numpy()
        contradict += contradicts.numpy()
    kept = confirm > contradict
    return Depth(np.where(kept, depth.inverse, 0), np.where(kept, depth.error, 0))
