"""Bundle adjustment of a model, with points of all matches or of given poses and the lens as far as the images
determine it; alignment with another track of the same cameras; and the frame of the scene, by gravity and metres."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mmpi_ns.utils.errors import InputError, log, progress
from mmpi_prepare.gps import Array, Fit
from mmpi_priors.sfm import MIN_ANGLE, triangulate_points, verified_matches
from mmpi_priors.upright import level_up

STILL = 1e-6
"""Relative change of the cost at which an adjustment ends. COLMAP's 100 iterations took four times as long on 64
images of a drive, and changed the focal length by 0.002 px."""
WORTH = 0.97
"""Fraction of the reprojection error to which a freed parameter must lower it."""
SQUARE = 0.8
"""The same for pixels that are not square, as those of some old video."""
IMAGES_OF_LENS = 3
"""Minimum images of a camera for more than one term of its lens."""
LARGEST_ERROR = 4.0
"""Reprojection error in pixels above which an observation is dropped."""
ENOUGH_POINTS = 300
"""Points of each image, those seen by the most images, for the choice between camera models."""
PARTS = 20
"""Number of images from which the two halves of a capture are also used separately to judge the focal length."""
WIDE = 0.08
"""Relative width of the interval of the focal length from which --focal is requested."""
NOTED_OFF, NOTED_WORTH, NOTED_ROUNDS = 0.1, 0.95, 3
"""Relative difference of a refined focal length from that of EXIF, which is rounded, from which it is asked whether the
images determine it; share of the reprojection error with that of EXIF to which they must lower it; and adjustments with
that of EXIF, as it changes all heights."""
REFINE_ROUNDS, COARSE_PX, FINE_PX = 3, 8.0, 4.0
"""Rounds of refining given poses and triangulating points again; largest reprojection error of a point while these are
to be refined, and in the end."""
LEAST_SHARE = 0.2
"""Fraction of the matched keypoints that must become points; few do if given poses are those of other images."""
BENT_PX = 0.8
"""Mean reprojection error above which another attempt follows although the images are registered."""
ROTATION_WEIGHT = 1.0
"""Weight of rotations in the alignment of two tracks; the main direction of the centres has weight 1."""
LEAST_GROUND, GROUND_SHARE, TRIALS = 50, 0.15, 2000
"""Minimum number of points below the cameras for fitting the ground, the fraction that must lie on it, planes tried."""
GROUND_TILT = 25.0
"""Maximum angle in degrees between gravity estimated from the cameras and the normal of the ground."""


def adjust(
    model: pycolmap.Reconstruction,
    threads: int,
    lens: bool,
    principal_point: bool = False,
    poses: bool = True,
    focal: bool = True,
) -> None:
    """Bundle adjustment of points, and of what is named, over all images with a robust loss, in place; ``lens`` is
    distortion and, if ``focal``, focal length."""
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_rig_from_world, options.refine_sensor_from_rig = poses, False
    options.refine_focal_length, options.refine_extra_params = lens and focal, lens
    options.refine_principal_point = principal_point
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = STILL
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, 1.0
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    if poses:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def fit_error(model: pycolmap.Reconstruction) -> float:
    """Root mean square of the points' errors in pixels, robust to single outliers."""
    errors = np.array([point.error for point in model.points3D.values()])
    lengths = np.array([point.track.length() for point in model.points3D.values()], np.float64)
    errors = np.minimum(np.nan_to_num(errors, nan=np.inf), LARGEST_ERROR)
    return float(np.sqrt((errors**2 * lengths).sum() / max(float(lengths.sum()), 1.0)))


def worth(model: pycolmap.Reconstruction, parameters: int) -> float:
    """Fraction of the error below which so many more parameters are believed: by the Bayesian information criterion,
    that of all coordinates of keypoints, and ``WORTH`` at most."""
    count = max(2 * model.compute_num_observations(), 2)
    return min(WORTH, float(np.exp(-parameters * np.log(count) / (2 * count))))


def turns_back(camera: pycolmap.Camera) -> bool:
    """Whether a lens shows rays farther from its axis nearer to the middle, before the corner of the image."""
    corner = np.hypot(camera.width / camera.focal_length_x, camera.height / camera.focal_length_y) / 2
    terms = camera.params[camera.extra_params_idxs()][: 1 if camera.model.name == "SIMPLE_RADIAL" else 2]
    squares = np.linspace(0, corner, 50) ** 2
    slopes = 1 + sum(((2 * n + 3) * k * squares ** (n + 1) for n, k in enumerate(terms)), np.zeros(50))
    return bool(slopes.min() <= 0)


def polish(
    model: pycolmap.Reconstruction, threads: int, lens: bool, full_lens: bool, principal_point: bool
) -> pycolmap.Reconstruction:
    """The model adjusted with more parameters free, if that lowers the error by more than so many parameters would do
    anyway, and no lens turns back; what may be is as in ``mapping.Task``.

    Parameters that do not lower it absorb other errors: driving forward, lens terms absorb the principal point, and a
    second focal length whatever is left, as few images, a straight path and upright cameras hardly determine it. So
    pixels are square unless that fits far worse. Cameras of few images keep one radial term.
    """
    images = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    several = [n for n, c in model.cameras.items() if c.model.name == "SIMPLE_RADIAL" and images[n] >= IMAGES_OF_LENS]
    # In words, the lens model, whether both focal lengths are free, and the fraction of the error that is asked for.
    trials: list[tuple[str, str, bool, float]] = []
    if principal_point:
        trials.append(("the principal point free", "", True, worth(model, 2 * len(model.cameras))))
    if full_lens and several:
        trials.append(("two radial terms", "RADIAL", True, worth(model, len(several))))
        trials.append(("OpenCV's four lens terms", "OPENCV", False, worth(model, 3 * len(several))))
        trials.append(("these and pixels that are not square", "OPENCV", True, SQUARE))
    if not trials:
        return model

    def adjusted(start: pycolmap.Reconstruction, kind: str, focal: bool, center: bool) -> pycolmap.Reconstruction:
        """A copy adjusted with cameras as of another lens model, if asked, and the principal point free."""
        trial = copy.deepcopy(start)
        for camera in (trial.cameras[n] for n in several) if kind else ():
            f, cx, cy, *terms = camera.params
            camera.model = getattr(pycolmap.CameraModelId, kind)
            terms = [*terms, 0.0][:2]
            camera.params = [f, cx, cy, *terms] if kind == "RADIAL" else [f, f, cx, cy, *terms, 0.0, 0.0]
        adjust(trial, threads, lens, center)
        if not focal:  # COLMAP cannot tie the two focal lengths
            for camera in (trial.cameras[n] for n in several):
                camera.params[camera.focal_length_idxs()] = camera.mean_focal_length()
            adjust(trial, threads, lens, center, focal=False)
        return trial

    with progress("Fitting the lens", 1 + len(trials)) as advance:
        light, center, chosen = with_fewer_points(model), False, ("", True)
        adjust(light, threads, lens)
        advance()
        start = light
        for summary, kind, focal, share in trials:
            trial = adjusted(start, kind, focal, center or not kind)
            advance()
            before, after = fit_error(light), fit_error(trial)
            fate = "kept" if after < share * before else "not kept"
            if fate == "kept" and any(turns_back(trial.cameras[n]) for n in several if kind):
                fate = "not kept, as the lens would turn back before the corner"
            log(f"Lens: {before:.3f} px, {after:.3f} px with {summary}: {fate}.")
            if fate == "kept":
                light, center, chosen = trial, center or not kind, (kind, focal) if kind else chosen
                start = start if kind else trial
    return adjusted(model, *chosen, center) if center or chosen[0] else model


def quality(model: pycolmap.Reconstruction) -> tuple[bool, int, float]:
    """Sorts models by soundness, then by number of images, then by fit.

    Errors are those at an image width of 1,000 pixels, or in pixels of smaller images.
    """
    widest = max(camera.width for camera in model.cameras.values())
    error = model.compute_mean_reprojection_error() / max(1.0, widest / 1000)
    return error <= BENT_PX, model.num_reg_images(), -error


def is_bent(model: pycolmap.Reconstruction) -> bool:
    """Whether a model fits its images so badly that it may have started from a wrong pair and be squeezed or folded."""
    return not quality(model)[0]


def with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the points seen by the most images, ENOUGH_POINTS for each image: as informative, and quickly
    adjusted."""
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

    Replaces COLMAP's last step, which takes longer and omits many points of sequences with small angles: of every
    second frame of a drive with bends, half of the matches became points, here three quarters.
    """
    for _ in range(rounds):
        model = triangulate_points(model, database, images, threads, LARGEST_ERROR)
        adjust(model, threads, lens)
        pycolmap.ObservationManager(model).filter_all_points3D(LARGEST_ERROR, MIN_ANGLE)
        model.update_point_3d_errors()
    return model


def focal_interval(model: pycolmap.Reconstruction, threads: int) -> tuple[float, str]:
    """Width, relative to the largest, of the interval of focal lengths that bundle adjustments of one model end at
    under different assumptions, and the interval in words.

    Principal point in the middle; principal point free; each half of the images alone. The statistical error of one
    adjustment is far smaller and means little, because the assumptions dominate. Of several cameras, the first."""
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
    low, high = min(focals), max(focals)
    return (high - low) / high, f"between {low:.1f} and {high:.1f} px, {(high - low) / high:.1%} wide"


def with_focals(model: pycolmap.Reconstruction, focals: Mapping[int, float], threads: int) -> pycolmap.Reconstruction:
    """A copy adjusted with given focal lengths, in pixels by camera; those of other cameras stay."""
    held = copy.deepcopy(model)
    for number, camera in held.cameras.items():
        if number in focals:
            camera.params[camera.focal_length_idxs()] = focals[number]
    for _ in range(NOTED_ROUNDS):
        adjust(held, threads, lens=True, focal=False)
    return held


def open_focals(model: pycolmap.Reconstruction, database: Path, threads: int) -> dict[int, float]:
    """Focal lengths that a database of features has from EXIF, in pixels by camera, if the images hardly determine
    them, but end elsewhere: with those of EXIF the error is hardly larger. Else empty.

    If all cameras look the same way and move across it, as on a level flight, doubling all distances and the focal
    length gives the same images."""
    with pycolmap.Database.open(database) as opened:
        cameras = [c for c in opened.read_all_cameras() if c.has_prior_focal_length]
    noted = {c.camera_id: c.mean_focal_length() for c in cameras}
    apart = [abs(camera.mean_focal_length() / noted[n] - 1) for n, camera in model.cameras.items() if n in noted]
    if not apart or max(apart) < NOTED_OFF:
        return {}
    light = with_fewer_points(model)
    adjust(light, threads, lens=True)
    free, held = fit_error(light), fit_error(with_focals(light, noted, threads))
    is_open = free > NOTED_WORTH * held
    focals = ", ".join(f"{focal:.0f}" for _, focal in sorted(noted.items())[:3])
    fate = "kept, as the images hardly determine it" if is_open else "not kept"
    log(f"Lens: {free:.3f} px, {held:.3f} px with the focal length of EXIF ({focals} px): {fate}.")
    return noted if is_open else {}


def keeps_focals(model: pycolmap.Reconstruction, cameras: Sequence[pycolmap.Camera]) -> bool:
    """Whether all cameras of a model have kept the focal lengths that EXIF gave ``cameras``, those of the database."""
    noted = {i: c.mean_focal_length() for i, c in enumerate(cameras, 1) if c.has_prior_focal_length}
    used = {i: c.mean_focal_length() for i, c in model.cameras.items()}
    return all(i in noted and np.isclose(focal, noted[i], 1e-6) for i, focal in used.items())


def map_given_poses(
    model: pycolmap.Reconstruction, database: Path, images: Path, refine_poses: bool, refine_lens: bool, threads: int
) -> tuple[pycolmap.Reconstruction, str]:
    """Triangulates points from the poses of a model, and refines these, aligned with the given scale and frame.

    Returns the model with points, and a summary. Raises InputError if the poses do not fit the matches.
    """
    _, before = camera_poses(model)
    refines = refine_poses or refine_lens
    model = triangulate_points(model, database, images, threads, COARSE_PX if refines else FINE_PX)
    matched: dict[int, set[int]] = {i: set() for i in model.reg_image_ids()}  # keypoints with a match in another image
    for *pair, matches in verified_matches(database):
        for i, keypoints in zip(pair, matches.T, strict=True) if all(i in matched for i in pair) else ():
            matched[i].update(keypoints.tolist())
    share = model.compute_num_observations() / max(sum(map(len, matched.values())), 1)
    if share < LEAST_SHARE:
        raise InputError(
            f"Only {share:.0%} of the matched keypoints become points from the given poses: the camera axes "
            "(--poses-axes opencv or opengl), the order of the images, the direction (camera "
            "to world is wanted) or the intrinsics (--focal, --camera) are not what the poses were made with."
        )
    error = model.compute_mean_reprojection_error()
    summary = f"points from known poses: {share:.0%} of the matched keypoints, {error:.2f} px"
    if refines:
        for _ in range(REFINE_ROUNDS):
            adjust(model, threads, refine_lens, poses=refine_poses)
            model = triangulate_points(model, database, images, threads, FINE_PX)
        model.transform(similarity_between(camera_poses(model)[1], before))
        _, after = camera_poses(model)
        moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=-1)
        turned = degrees_between(after[:, :3, :3], before[:, :3, :3])
        summary += (
            f"; refined, {model.compute_mean_reprojection_error():.2f} px; poses moved by {moved.mean():.3g} units (at "
            f"most {moved.max():.3g}) and turned by {turned.mean():.2f} degrees (at most {turned.max():.2f})"
        )
    log(summary)
    return model, summary


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array]:
    """Names in order of the image ids, and camera to world with OpenCV axes. [N, 4, 4]"""
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    for pose, image in zip(poses, images, strict=True):
        pose[:3] = image.cam_from_world().inverse().matrix()
    return [image.name for image in images], poses


def degrees_between(first: Array, second: Array) -> Array:
    """Angles [N] between rotations [N, 3, 3]."""
    traces = np.einsum("nij,nij->n", first, second)
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation with the largest product with a matrix. [3, 3]"""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def similarity_between(source: Array, target: Array) -> pycolmap.Sim3d:
    """The similarity that aligns camera poses, camera to world [N, 4, 4], with other poses of the same cameras.

    Uses centres and rotations: the centres of a straight track do not fix its roll, and noise tilts a short one.
    (``pycolmap.estimate_sim3d`` uses centres alone, and gives up where they lie on a line or a plane, as drives do.)
    """
    a = source[:, :3, 3] - source[:, :3, 3].mean(0)
    b = target[:, :3, 3] - target[:, :3, 3].mean(0)
    by_centers = b.T @ a / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-24)
    by_rotations = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]) / len(source)
    rotation = nearest_rotation(by_centers + ROTATION_WEIGHT * by_rotations)
    scale = float((a @ rotation.T * b).sum() / max((a * a).sum(), 1e-24))
    translation = target[:, :3, 3].mean(0) - scale * rotation @ source[:, :3, 3].mean(0)
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation)


def fit_ground(points: Array, centers: Array, up: Array) -> tuple[Array, float]:
    """The plane that the cameras [N, 3] stand over: the most populous of SfM points [P, 3] among roughly level ones.

    Returns its unit normal towards the cameras [3], and their median height above it. Raises InputError if too few
    points lie below the cameras, or no plane is among them.
    """
    # Points below the nearest camera and near the track.
    some = centers[:: max(1, len(centers) // 32)]
    reach = 2 * np.linalg.norm(centers - np.median(centers, axis=0), axis=-1).max()
    offset = points - some[np.linalg.norm(points[:, None] - some[None], axis=-1).argmin(1)]
    height = offset @ up
    across = np.linalg.norm(offset - height[:, None] * up, axis=-1)
    below = points[(height < 0) & (-height > 0.05 * across) & (across < reach)]
    if len(below) < LEAST_GROUND:
        raise InputError(
            f"--camera-height: only {len(below)} points lie below the cameras: too few to find the ground."
        )
    tolerance = 0.04 * abs(float(np.median(-((below - np.median(centers, axis=0)) @ up))))
    rng, inside = np.random.default_rng(0), np.zeros(len(below), dtype=bool)
    for _ in range(TRIALS):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 or abs(normal @ up) / length < np.cos(np.radians(GROUND_TILT)):
            continue
        near = np.abs((below - a) @ normal) < tolerance * length
        inside = near if near.sum() > inside.sum() else inside
    if inside.sum() < GROUND_SHARE * len(below):
        raise InputError("--camera-height: the points below the cameras lie on no common plane.")
    center = below[inside].mean(0)
    normal = np.linalg.eigh((below[inside] - center).T @ (below[inside] - center))[1][:, 0]
    normal *= np.sign(normal @ up)
    return normal, float(np.median((centers - center) @ normal))


def choose_frame(
    model: pycolmap.Reconstruction, camera_height: float | None, gps: Fit | None = None
) -> tuple[pycolmap.Sim3d, str, str]:
    """Up to +z, the first camera's heading to +y, the cameras' middle (or the ground below it) as origin.

    Without a ground, cameras are assumed level: up is perpendicular to all right vectors if they turn, else the mean up
    vector. Without ``camera_height``, in metres above the ground, scale and up are those of ``gps``; without both, one
    unit is the extent of the track.

    Returns the transform from the model to the scene, and the sources of up and of the unit in words.
    """
    _, poses = camera_poses(model)
    centers = poses[:, :3, 3]
    up, they_turn = level_up(poses[:, :3, 0], -poses[:, :3, 1])
    words = "mean of the cameras, assumed level"
    if they_turn:
        words = "perpendicular to the right vectors of the cameras, which are assumed level"
    if camera_height is not None:
        points = np.array([p.xyz for p in model.points3D.values()])
        up, height = fit_ground(points, centers, up)
        if height <= 0:
            raise InputError("--camera-height: the ground found lies above the cameras.")
        scale, words = camera_height / height, "normal of the ground"
        unit = f"1 metre, from a camera height of {camera_height:g} m above the ground"
    elif gps is not None:
        scale, unit = gps.scale, f"1 metre, from {gps.summary} m"
        up, words = (up, words) if gps.up is None else (gps.up, "GPS")
    else:
        extent = float(np.ptp(centers @ np.linalg.svd(centers - centers.mean(0))[2][0]))
        scale, unit = 1 / max(extent, 1e-12), "the extent of the camera track (metres are not known)"
    heading = poses[0, :3, 2] - (poses[0, :3, 2] @ up) * up
    if np.linalg.norm(heading) < 1e-6:  # the first camera looks up or down
        heading = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    heading = heading / np.linalg.norm(heading)
    rotation = np.stack([np.cross(heading, up), heading, up])
    similarity = pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), -scale * rotation @ centers.mean(0))
    return similarity, words, unit
