"""Exposure and white balance of the training images, from the colours of surfaces that several of them see.

Cameras with automatic exposure brighten and darken the same wall. A gain for each image and channel is estimated with
the depth priors: a pixel whose surface another image sees at the same distance gives the ratio of the two colours. The
ratio also depends on where in the image a surface lies: lenses darken their borders (vignetting), and on a straight
drive every surface moves from the middle to the border, so that each image seems darker than the one before. Therefore

    log c_j - log c_i = k_j - k_i + a (r_j^2 - r_i^2) + b (r_j^4 - r_i^4)

is solved for the gains k and the fall-off (a, b) together, robustly, with exposure times from EXIF as further equations
k_j - k_i = s log(E_j / E_i), s unknown as the camera's tone curve is. Gains are used only if they predict the ratios of
held-out image pairs. Colours are those of the files: for a tone curve near a power law a change of exposure multiplies
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from nerfstudio.cameras.cameras import Cameras
from numpy import ndarray
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from mmpi_ns.data.dataset import MMPIDataset, image_and_mask
from mmpi_ns.data.posed_images import PosedImages
from mmpi_ns.data.priors import DepthPriors, Gains
from mmpi_ns.data.rays import Rays
from mmpi_ns.placement.observations import nearest_views
from mmpi_ns.utils.host import give_back_freed_memory
from mmpi_ns.utils.parallel import in_order
from mmpi_priors.cache import held
from mmpi_priors.dense import TRIMMED
from mmpi_priors.views import look_up, project

NEIGHBOURS, MAX_ANGLE = 6, 40.0
"""Nearest views that each image is compared with, and the largest angle in degrees between their directions."""
BYTES_OF_VIEW = 21
"""Of a pixel of an ``ExposedView``."""
HIDDEN = 0.3
"""Log ratio from the median above which a surface counts as occluded, where there are no distances."""

WINDOW = 5
"""Side of the window over which colours are averaged, pixels: single pixels differ by misregistration."""
DARK, BRIGHT = 15, 245
"""Levels beyond which a channel of any pixel of a window is unreliable or clipped."""
CERTAIN, SAME_DISTANCE = 0.03, 0.03
"""Largest relative error of a depth, and relative difference of a surface's distances in two images."""
SAMPLES, FEWEST = 4000, 30
"""Pixels of an image that are projected into another one, and minimum number of matches."""
GROUPS, GROUP = 6, 40
"""Maximum number of groups by radius whose medians summarise the matches of a pair, and minimum size of a group."""
LEAST_ERROR = 0.01
"""Error of a median due to reflections and blur, log ratio."""
TONE, TONE_ERROR, EXIF_ERROR = 0.5, 0.25, 0.1
"""Expected exponent of the tone curve, its standard deviation, and the error of a log ratio that EXIF predicts."""
LOOSE = 1.0
"""Standard deviation of log gains, by which images without a match are tied to the mean."""
FOLDS = 5
OPAQUE = 0.9
"""Accumulation from which a pixel's depth is that of a surface."""
ROUNDS = 20


class ColorRatios(NamedTuple):
    """Colours of the same surfaces in pairs of images: medians of M groups of matches."""

    first: Int[ndarray, "M"]
    second: Int[ndarray, "M"]
    log_ratios: Float[ndarray, "M 3"]
    """log of the second image's colour over the first's."""
    errors: Float[ndarray, "M"]
    falloff: Float[ndarray, "M 2"]
    """Change of r^2 and r^4 from the first to the second; r is 1 at the corners."""


def grouped(
    first: int, second: int, log_ratios: Float[ndarray, "P 3"], radii: tuple[Float[ndarray, "P"], Float[ndarray, "P"]]
) -> ColorRatios | None:
    """Medians of the matches of two images, given by their numbers, in groups of similar change of the squared radius
    from the first to the second; None for too few."""
    if len(log_ratios) < FEWEST:
        return None
    change = np.stack([radii[1] - radii[0], radii[1] ** 2 - radii[0] ** 2], -1)
    order = np.array_split(np.argsort(change[:, 0], kind="stable"), max(1, min(GROUPS, len(change) // GROUP)))
    medians = np.stack([np.median(log_ratios[part], 0) for part in order])
    # Neighbouring windows share pixels, and neighbouring surfaces their error: a match counts as a part of one.
    errors = [
        LEAST_ERROR + 1.9 * float(np.median(np.abs(log_ratios[part] - middle))) / (1 + len(part) / WINDOW**2) ** 0.5
        for part, middle in zip(order, medians, strict=True)
    ]
    places = np.stack([np.median(change[part], 0) for part in order])
    count = len(order)
    return ColorRatios(np.full(count, first), np.full(count, second), medians, np.array(errors), places)


def joined(parts: Iterable[ColorRatios | None]) -> ColorRatios | None:
    """The ratios of several pairs of images; None if there are none."""
    ratios = [part for part in parts if part is not None]
    return ColorRatios(*map(np.concatenate, zip(*ratios, strict=True))) if ratios else None


@dataclass(frozen=True)
class ExposedView:
    """An image prepared for comparison with others."""

    colors: Float[ndarray, "H W 3"]
    """Means over windows."""
    exposed: Bool[ndarray, "H W"]
    """Where no pixel of the window is dark, clipped or masked."""
    depth: Float[ndarray, "H W 2"] | None
    """Inverse distances, 0 where there are none, and their errors; None without any."""
    number: int
    """Among the cameras."""

    @staticmethod
    def of(
        image: UInt8[ndarray, "H W C"],
        usable: UInt8[ndarray, "H W"],
        depth: Float[ndarray, "H W 2"] | None,
        number: int,
    ) -> ExposedView:
        """Of an image, where a mask does not hide it."""
        rgb, kernel = np.ascontiguousarray(image[..., :3]), np.ones((WINDOW, WINDOW), np.uint8)
        colors = np.asarray(cv2.boxFilter(rgb, cv2.CV_32F, (WINDOW, WINDOW)), np.float32) / 255
        lit = cv2.inRange(cv2.erode(rgb, kernel), np.full(3, DARK + 1.0), np.full(3, 255.0))
        unclipped = cv2.inRange(cv2.dilate(rgb, kernel), np.zeros(3), np.full(3, BRIGHT - 1.0))
        exposed = (lit > 0) & (unclipped > 0) & (cv2.erode(usable, kernel) > 0)
        border = WINDOW // 2
        exposed[:border] = exposed[-border:] = exposed[:, :border] = exposed[:, -border:] = False
        return ExposedView(colors, exposed, depth, number)


def pair_ratios(
    first: ExposedView,
    second: ExposedView,
    cameras: PosedImages,
    pixels: Int[ndarray, "P 2"],
    points: Float[ndarray, "P 3"],
) -> ColorRatios | None:
    """Colours of surfaces, at pixels (row, column) of one image, in another; None if it sees too few of them.

    If ``second`` has no depths, occlusions are detected by colour.
    """
    rows, columns = pixels.T
    at = project(cameras, second.number, points)
    visible = look_up(second.exposed.view(np.uint8), *at.T, nearest=True) > 0
    if second.depth is not None:
        center = cameras.camera_to_worlds[second.number, :, 3]
        expected = 1 / np.maximum(np.linalg.norm(points - center, axis=-1), 1e-12)
        inverse = look_up(second.depth[..., 0], *at.T, nearest=True)
        visible &= np.abs(inverse - expected) < SAME_DISTANCE * expected
    chosen = np.nonzero(visible)[0]
    ratios = np.log(look_up(second.colors, *at[chosen].T) / first.colors[rows[chosen], columns[chosen]])
    if second.depth is None and len(chosen):
        chosen, ratios = (x[np.abs(ratios - np.median(ratios, 0)).max(-1) < HIDDEN] for x in (chosen, ratios))
    places = np.stack([columns, rows], -1)[chosen] + 0.5
    sizes = [np.array(view.exposed.shape[::-1]) for view in (first, second)]
    radii = [
        ((2 * x - size) ** 2).sum(-1) / (size**2).sum() for x, size in zip((places, at[chosen]), sizes, strict=True)
    ]
    return grouped(first.number, second.number, ratios, (radii[0], radii[1]))


def color_ratios(
    cameras: PosedImages,
    depths: DepthPriors,
    rays: Rays,
    image_of: Callable[[int], tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    seed: int = 0,
) -> ColorRatios | None:
    """Colours of the same surfaces in each training image and its nearest views; None if there are none.

    ``image_of`` gives the colours [H, W, C] of an image, and where it may be used [H, W]; ``seed`` draws pixels.
    """
    view_of = held(
        lambda i: ExposedView.of(*image_of(i), depths.image(i), i), cameras.sizes, BYTES_OF_VIEW, NEIGHBOURS + 1
    )

    def ratios_of(i: int) -> list[ColorRatios | None]:
        view, rng = view_of(i), np.random.default_rng((seed, i))
        assert view.depth is not None
        inverse, error = view.depth[..., 0], view.depth[..., 1]
        certain = np.argwhere(view.exposed & (inverse > 0) & (error < CERTAIN * inverse))
        pixels = certain[rng.choice(len(certain), min(SAMPLES, len(certain)), replace=False)]
        if len(pixels) < FEWEST:
            return []
        numbers = torch.from_numpy(np.concatenate([np.full((len(pixels), 1), i), pixels], -1))
        directions = rays(numbers).directions.double().cpu().numpy()
        points = cameras.camera_to_worlds[i, :, 3] + directions / inverse[pixels[:, 0], pixels[:, 1], None]
        others = nearest_views(cameras.camera_to_worlds, i, NEIGHBOURS, MAX_ANGLE, apart=False)
        return [pair_ratios(view, view_of(j), cameras, pixels, points) for j in others]

    ratios: list[ColorRatios | None] = []
    for i, parts in enumerate(in_order(ratios_of, range(len(cameras.files)))):
        ratios += parts
        if i % TRIMMED == 0:
            give_back_freed_memory()
    return joined(ratios)


def solve(
    ratios: ColorRatios, count: int, exposures: Float[ndarray, "N"] | None = None, *, gains: bool = True
) -> tuple[Float[ndarray, "N 3"], Float[ndarray, "N"], Float[ndarray, "2 3"]]:
    """Log gains of ``count`` images, their errors, and the fall-off towards the corners, by robust least squares.
    ``exposures``: light of each image by its EXIF, in any unit; NaN where unknown. Without ``gains`` the fall-off
    alone."""
    rows = np.arange(len(ratios.first))
    entries = [(rows, ratios.second, 1.0), (rows, ratios.first, -1.0)] if gains else []
    entries += [(rows, np.full(len(rows), count + n), ratios.falloff[:, n]) for n in range(2)]
    target, errors = ratios.log_ratios, ratios.errors
    tone = count + 2
    dated = np.zeros(0, int) if exposures is None or not gains else np.nonzero(np.isfinite(exposures))[0]
    if len(dated) > 1 and exposures is not None:
        number = len(target) + np.arange(len(dated) - 1)
        change = np.diff(np.log(exposures[dated]))
        entries += [(number, dated[1:], 1.0), (number, dated[:-1], -1.0), (number, np.full(len(number), tone), -change)]
        target = np.concatenate([target, np.zeros((len(number), 3))])
        errors = np.concatenate([errors, np.full(len(number), EXIF_ERROR)])
    values = np.concatenate([np.broadcast_to(value, row.shape) for row, _, value in entries])
    places = tuple(np.concatenate([entry[n] for entry in entries]) for n in range(2))
    matrix = sparse.csr_array((values, places), shape=(len(target), tone + 1))
    prior = np.concatenate([np.full(count, LOOSE**-2), np.full(2, 1e-2), [TONE_ERROR**-2]])
    expected = np.concatenate([np.zeros(count + 2), [TONE]])
    solution, weights = np.zeros((tone + 1, 3)), np.ones(target.shape)
    normal, scale = np.eye(tone + 1), 1.0
    for _ in range(ROUNDS):
        for c in range(3):
            weighted = sparse.diags_array(weights[:, c] / errors**2) @ matrix
            normal = (matrix.T @ weighted).toarray() + np.diag(prior)
            solution[:, c] = np.linalg.solve(normal, weighted.T @ target[:, c] + prior * expected)
        residuals = (target - matrix @ solution) / errors[:, None]
        scale = max(1.0, 1.4826 * float(np.median(np.abs(residuals))))
        weights = 1 / (1 + (residuals / (2 * scale)) ** 2)
    logs = solution[:count] - solution[:count].mean(0)
    # Without the error of the matched images' mean, which no ratio determines and no image needs.
    matched = np.isin(np.arange(count), [ratios.first, ratios.second])
    center = np.eye(count) - matched / max(1, matched.sum())
    covariance = center @ np.linalg.inv(normal)[:count, :count] @ center.T
    return logs, np.sqrt(np.maximum(np.diag(covariance), 0)) * scale, solution[count : count + 2]


def image_gains(ratios: ColorRatios, count: int, exposures: Float[ndarray, "N"] | None = None) -> Gains:
    """Gains of ``count`` images, with their error on held-out pairs of images."""
    pairs = np.minimum(ratios.first, ratios.second) * count + np.maximum(ratios.first, ratios.second)
    fold = np.unique(pairs, return_inverse=True)[1] % FOLDS
    residuals: dict[bool, list[NDArray[np.float64]]] = {False: [], True: []}
    for number in np.unique(fold):
        used, left_out = (ColorRatios(*(x[chosen] for x in ratios)) for chosen in (fold != number, fold == number))
        for gains, parts in residuals.items():
            logs, _, falloff = solve(used, count, exposures, gains=gains)
            change = logs[left_out.second] - logs[left_out.first]
            parts.append(np.abs(left_out.log_ratios - change - left_out.falloff @ falloff).ravel())
    logs, errors, falloff = solve(ratios, count, exposures)
    without, corrected = (float(np.median(np.concatenate(residuals[gains]))) for gains in (False, True))
    return Gains(np.exp(logs), errors, falloff, without, corrected)


def exposure_of_image(
    posed: PosedImages,
    dataset: MMPIDataset,
    factors: Tensor,
    falloff: Tensor,
    camera: Cameras,
    observed: Tensor,
    outputs: dict[str, Tensor],
) -> Tensor | None:
    """Exposure of an image that was not calibrated [3], by surfaces that training images near it see too; None without
    any.

    Args:
        posed, dataset: the training images.
        factors: their exposures. [M, 3]
        falloff: of colours towards the corners. [2, 3]
        camera: of the image.
        observed: its colours. [H, W, 3]
        outputs: its rendering, for the depths.
    """
    pose = camera.camera_to_worlds.reshape(1, 3, 4).double().cpu().numpy()
    poses, count = np.concatenate([posed.camera_to_worlds, pose]), len(dataset)
    nearest = nearest_views(poses, count, NEIGHBOURS, MAX_ANGLE, apart=False)
    others = [ExposedView.of(*image_and_mask(dataset, j), None, j) for j in nearest]
    image = (observed.cpu().numpy() * 255).round().astype(np.uint8)
    view = ExposedView.of(image, np.ones(image.shape[:2], np.uint8), None, count)
    seen = view.exposed & (outputs["accumulation"][..., 0] > OPAQUE).cpu().numpy()
    pixels = np.argwhere(seen)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(SAMPLES, len(pixels))).astype(int)]
    coords = torch.from_numpy(pixels + 0.5).float()
    rays = camera.to("cpu").generate_rays(torch.zeros(len(pixels), 1, dtype=torch.long), coords=coords)
    depths = outputs["depth"].cpu()[pixels[:, 0], pixels[:, 1]]
    points = (rays.origins + rays.directions * depths).double().numpy()
    ratios = joined(pair_ratios(view, other, posed, pixels, points) for other in others)
    if ratios is None:
        return None
    exposure = exposure_by(ratios, *(x.double().cpu().numpy() for x in (factors, falloff)))
    return torch.from_numpy(exposure).float().to(factors)


def exposure_by(
    ratios: ColorRatios, exposures: Float[ndarray, "N 3"], falloff: Float[ndarray, "2 3"]
) -> Float[ndarray, "3"]:
    """Exposure of the image that is the first of all pairs, by those of the second ones."""
    return np.exp(np.median(np.log(exposures[ratios.second]) - ratios.log_ratios + ratios.falloff @ falloff, 0))
