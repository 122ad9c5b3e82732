"""Bundle adjustment: points of all matches or of known poses, the lens as far as the images determine it, and how well
they do."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.capture.sfm import MIN_ANGLE, quiet, triangulate_points
from mmpi_ns.prepare.alignment import camera_poses, degrees_between, similarity_between
from mmpi_ns.prepare.features import matched_keypoints
from mmpi_ns.utils.errors import InputError, progress, say

STILL = 1e-6
"""Relative change of the cost at which an adjustment ends. COLMAP goes on to 100 iterations: of 64 images of a drive
that took four times as long, and moved the focal length by 0.002 px."""
WORTH = 0.97
"""Fraction of the reprojection error to which a freed parameter must lower it."""
LARGEST_ERROR = 4.0
"""Reprojection error in pixels above which an observation is dropped."""
ENOUGH_POINTS = 300
"""Points of each image, the ones that most images see, on which a choice between camera models rests."""
PARTS = 20
"""Number of images from which the two halves of a capture are also used separately to judge the focal length."""
WIDE = 0.08
"""Width of the interval of the focal length, relative to it, from which --focal is asked for."""
REFINE_ROUNDS = 3
"""Rounds of refining known poses and triangulating points again."""
COARSE_PX, FINE_PX = 8.0, 4.0
"""Largest reprojection error of a point of known poses: while these are to be refined, and in the end."""
LEAST_SHARE = 0.2
"""Fraction of the matched keypoints that must become points; few do where known poses are those of other images."""
BENT_PX = 0.8
"""Mean reprojection error above which another attempt is made even though the images are registered."""


@dataclass(frozen=True)
class Free:
    """Camera parameters that may be refined."""

    lens: bool
    """Focal length and distortion."""
    full_lens: bool
    """OpenCV's four lens terms in place of one radial term, if they fit clearly better."""
    principal_point: bool
    """The principal point, if that fits clearly better. It is hardly observable on straight stretches, but in bends."""


def adjust(
    model: pycolmap.Reconstruction, threads: int, lens: bool, principal_point: bool = False, poses: bool = True
) -> None:
    """Bundle adjustment of points, and of what is named, over all images with a robust loss, in place; ``lens`` is
    focal length and distortion."""
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_rig_from_world = poses
    options.refine_focal_length = options.refine_extra_params = lens
    options.refine_principal_point = principal_point
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = STILL
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, 1.0
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    if poses:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with quiet():  # pycolmap.bundle_adjustment cannot be kept quiet
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def polish(model: pycolmap.Reconstruction, free: Free, threads: int) -> pycolmap.Reconstruction:
    """The model adjusted with more parameters free, if that lowers the error.

    Parameters that do not lower it absorb other errors: driving forward, lens terms absorb the principal point.
    """
    trials = []  # in words, and whether it is the four lens terms; else the principal point
    if free.principal_point:
        trials.append(("the principal point free", False))
    if free.full_lens and any(c.model.name == "SIMPLE_RADIAL" for c in model.cameras.values()):
        trials.append(("OpenCV's four lens terms", True))
    if not trials:
        return model
    center = four_terms = False

    def adjusted(start: pycolmap.Reconstruction, four_terms: bool, center: bool) -> pycolmap.Reconstruction:
        """A copy adjusted with cameras of one radial term as OpenCV's, if asked, and the principal point free."""
        trial = copy.deepcopy(start)
        for camera in trial.cameras.values() if four_terms else ():
            if camera.model.name == "SIMPLE_RADIAL":
                f, cx, cy, k = camera.params
                camera.model = pycolmap.CameraModelId.OPENCV
                camera.params = [f, f, cx, cy, k, 0.0, 0.0, 0.0]
        adjust(trial, threads, free.lens, center)
        return trial

    with progress("Fitting the lens", 1 + len(trials)) as advance:
        light = with_fewer_points(model)
        adjust(light, threads, free.lens)
        advance()
        for says, is_lens in trials:
            trial = adjusted(light, is_lens, center or not is_lens)
            advance()
            before, after = rms_error(light), rms_error(trial)
            is_better = after < WORTH * before
            say(f"Lens: {before:.3f} px, {after:.3f} px with {says}: {'kept' if is_better else 'not kept'}.")
            if is_better:
                light, center, four_terms = trial, center or not is_lens, four_terms or is_lens
    return adjusted(model, four_terms, center) if center or four_terms else model


def rms_error(model: pycolmap.Reconstruction) -> float:
    """Root mean square of the points' reprojection errors, each counted once for each image that sees it; pixels."""
    errors = np.array([p.error for p in model.points3D.values()])
    lengths = np.array([p.track.length() for p in model.points3D.values()])
    return float(np.sqrt((errors**2 * lengths).sum() / max(int(lengths.sum()), 1)))


def quality(model: pycolmap.Reconstruction) -> tuple[bool, int, float]:
    """Sorts models by soundness, then by number of images, then by fit.

    Errors are those at an image width of 1,000 pixels, or in pixels of smaller images.
    """
    widest = max(camera.width for camera in model.cameras.values())
    error = model.compute_mean_reprojection_error() / max(1.0, widest / 1000)
    return error <= BENT_PX, model.num_reg_images(), -error


def is_bent(model: pycolmap.Reconstruction) -> bool:
    """Whether a model fits its images so badly that it may have started from a wrong pair: squeezed or folded."""
    return not quality(model)[0]


def with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the points that most images see, ENOUGH_POINTS for each image: as telling, and quickly adjusted."""
    light = copy.deepcopy(model)
    counts = dict.fromkeys(light.reg_image_ids(), 0)
    tracks = {i: [e.image_id for e in p.track.elements] for i, p in light.points3D.items()}
    for number in sorted(tracks, key=lambda i: (-len(tracks[i]), i)):
        if all(counts[image] >= ENOUGH_POINTS for image in tracks[number]):
            light.delete_point3D(number)
        else:
            for image in tracks[number]:
                counts[image] += 1
    return light


def with_all_points(
    model: pycolmap.Reconstruction, database: Path, images: Path, lens: bool, threads: int, rounds: int = 1
) -> pycolmap.Reconstruction:
    """A placed model with the points of all verified matches, and everything adjusted to them, in several rounds.

    In place of COLMAP's own last step, which takes longer, and leaves out many points of sequences with small angles:
    of every second frame of a drive with bends half of the matches became points, with this three quarters.
    """
    for _ in range(rounds):
        with quiet():
            model = triangulate_points(model, database, images, threads, LARGEST_ERROR)
        adjust(model, threads, lens)
        pycolmap.ObservationManager(model).filter_all_points3D(LARGEST_ERROR, MIN_ANGLE)
        model.update_point_3d_errors()
    return model


def focal_interval(model: pycolmap.Reconstruction, threads: int) -> tuple[float, float]:
    """Focal lengths, in pixels, that bundle adjustments of one model end at under different assumptions.

    Principal point in the middle; principal point free; each half of the images alone. The statistical error of one
    adjustment is far smaller and means little, because the assumptions dominate. Of several cameras, the first.
    """
    light, ids = with_fewer_points(model), sorted(model.reg_image_ids())
    middle = len(ids) // 2
    trials: list[tuple[list[int], bool]] = [(ids, True)]
    trials += [(ids[:middle], False), (ids[middle:], False)] if len(ids) >= PARTS else []
    models = [model]
    for part, principal_point in trials:
        models.append(copy.deepcopy(light))
        for image_id in set(ids) - set(part):
            models[-1].deregister_frame(models[-1].images[image_id].frame_id)
        adjust(models[-1], threads, True, principal_point)
    firsts = [m.cameras[m.images[min(m.reg_image_ids())].camera_id] for m in models]
    focals = [float(camera.mean_focal_length()) for camera in firsts]
    return min(focals), max(focals)


def focal_in_words(low: float, high: float) -> str:
    """The interval of a focal length, for the report."""
    return f"between {low:.1f} and {high:.1f} px, {(high - low) / high:.1%} wide"


def map_known_poses(
    model: pycolmap.Reconstruction, database: Path, images: Path, refine_poses: bool, refine_lens: bool, threads: int
) -> tuple[pycolmap.Reconstruction, str]:
    """Triangulates points from the poses of a model, and refines these, aligned with the given scale and frame.

    Returns the model with points, and what was done in words. Raises InputError if the poses do not fit the matches.
    """
    _, before = camera_poses(model)
    refines = refine_poses or refine_lens
    with quiet():
        model = triangulate_points(model, database, images, threads, COARSE_PX if refines else FINE_PX)
    share = model.compute_num_observations() / max(matched_keypoints(database, list(model.reg_image_ids())), 1)
    if share < LEAST_SHARE:
        raise InputError(
            f"Only {share:.0%} of the matched keypoints become points from the given poses: the camera axes "
            "(--poses-axes opencv or opengl), the order of the images, the direction (camera "
            "to world is wanted) or the intrinsics (--focal, --camera) are not what the poses were made with."
        )
    error = model.compute_mean_reprojection_error()
    says = f"points from known poses: {share:.0%} of the matched keypoints, {error:.2f} px"
    if refines:
        for _ in range(REFINE_ROUNDS):
            adjust(model, threads, refine_lens, poses=refine_poses)
            with quiet():
                model = triangulate_points(model, database, images, threads, FINE_PX)
        model.transform(similarity_between(camera_poses(model)[1], before))
        _, after = camera_poses(model)
        moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=-1)
        turned = degrees_between(after[:, :3, :3], before[:, :3, :3])
        says += (
            f"; refined, {model.compute_mean_reprojection_error():.2f} px; poses moved by {moved.mean():.3g} units (at "
            f"most {moved.max():.3g}) and turned by {turned.mean():.2f} degrees (at most {turned.max():.2f})"
        )
    say(says)
    return model, says
