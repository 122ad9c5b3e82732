"""Writes a scene as a Nerfstudio data set: images, depths, cameras, a COLMAP model with tracks.

Images may be exposed: gains that follow the content, white balance, vignetting and a tone curve, all exact.

    pixel value = tone(min(1, gain * (1 - vignetting * r^2) * light)),    r = 1 in the corners

Light is the inverse of the tone curve at the scene's colours, so that a gain of 1 without vignetting changes nothing.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mmpi_scene.cameras import Array, Cameras, Panoramas
from mmpi_scene.movers import moving_mask
from mmpi_scene.scene import Colors, Scene, render
from mmpi_scene.sfm_like import SfmPoints, sfm_points

ExposureName = Literal["none", "auto", "vignetting"]
GAMMA, CONTRAST = 2.2, 0.3
"""tone(x) = y + CONTRAST y (1 - y) (2 y - 1) with y = x^(1 / GAMMA)."""
RANGE, WHITE_BALANCE = 3.0, 0.1
"""Ratio of the largest and the least automatic gain; largest change of red and of blue, opposite to each other."""
LAG = 4.0
"""Images over which an automatic exposure follows the content."""
METERED = 24, 16
"""Rays across and down an image by which its light is measured."""
LOST = {"auto": 0.3, "vignetting": 0.5}
"""Share of the light that is lost in the corners."""
SECONDS, SPEED, APERTURE = 0.01, 100, 1.8
"""EXIF values of an image whose gain is 1."""
KNOTS = np.linspace(0.0, 1.0, 1 << 14)
PARTS = (
    *("transforms.json", "images", "images_2", "images_4", "images_8", "depths", "moving", "exposure.json", "colmap"),
    "sparse_pc.ply",
)
"""Files and folders of a data set, which are removed before another one replaces it."""
MILLIMETRES = 65535
"""The farthest depth that a 16-bit file holds; 0 stands for farther, and for the sky."""


def tone(light: NDArray[Any]) -> Array:
    """Pixel values in [0, 1] of light in [0, 1]."""
    y = np.asarray(light, np.float64) ** (1 / GAMMA)
    return y + CONTRAST * y * (1 - y) * (2 * y - 1)


def light_of(values: NDArray[Any]) -> Array:
    """Light in [0, 1] of pixel values in [0, 1]: the inverse of ``tone``."""
    return np.interp(values, tone(KNOTS**GAMMA), KNOTS) ** GAMMA


@dataclass(frozen=True)
class Exposure:
    """Exposures of M images."""

    gains: Array
    """[M, 3] factors on red, green and blue light."""
    vignetting: float
    """Share of the light that is lost in the corners."""

    def expose(self, cameras: Cameras, camera: int, colors: Colors) -> Colors:
        """Pixel values [H, W, 3] of an image whose colours with a gain of 1 are [H, W, 3]."""
        offset = (cameras.pixel_centers - cameras.center) / np.hypot(*cameras.center)
        passed = (1 - self.vignetting * (offset**2).sum(-1)).reshape(cameras.height, cameras.width, 1)
        return tone(np.minimum(1, self.gains[camera] * passed * light_of(colors))).astype(np.float32)

    def to_object(self, names: list[str]) -> dict[str, Any]:
        """The content of exposure.json."""
        return {
            "model": "value = tone(min(1, gain * (1 - vignetting * r^2) * light)), r = 1 in the corners; "
            "tone(x) = y + contrast * y * (1 - y) * (2 * y - 1), y = x^(1 / gamma)",
            "gamma": GAMMA,
            "contrast": CONTRAST,
            "vignetting": self.vignetting,
            "gains": {name: gains.tolist() for name, gains in zip(names, self.gains, strict=True)},
        }


def make_exposure(name: ExposureName, scene: Scene) -> Exposure | None:
    """Exposures of a scene's images, taken in the order of its cameras.

    none: one exposure, pixel values are the scene's colours. auto: gains follow what an image sees, a few images late,
    three-fold between the darkest and the brightest; white balance wanders by a tenth. vignetting: one exposure, half
    of the light lost in the corners."""
    if name == "none":
        return None
    count, log_gains = len(scene.cameras), np.zeros((len(scene.cameras), 3))
    if name == "auto":
        cameras, (across, down) = scene.cameras, METERED
        x, y = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(down) + 0.5) / down)
        pixels: Array = np.stack([x, y], -1).reshape(-1, 2) * np.array([cameras.width, cameras.height], np.float64)
        pixel = cameras.width / across / cameras.focal
        seen = (scene.trace(*cameras.rays(i, pixels), pixel)[1] for i in range(count))
        followed = np.log([float(light_of(colors).mean()) for colors in seen])
        for i in range(1, count):
            followed[i] += (1 - 1 / LAG) * (followed[i - 1] - followed[i])
        spread = np.ptp(followed)
        if spread > 0:
            log_gains -= ((followed - np.median(followed)) * np.log(RANGE) / spread)[:, None]
        random = np.random.default_rng([scene.seed, 18])
        period, phase = random.uniform(40, 90), random.uniform(0, 2 * np.pi)
        warmth = np.log1p(WHITE_BALANCE) * np.sin(2 * np.pi * np.arange(count) / period + phase)
        log_gains += warmth[:, None] * [1.0, 0.0, -1.0]
    return Exposure(np.exp(log_gains), LOST[name])


def image_name(camera: int) -> str:
    return f"frame_{camera + 1:05d}.png"


def write_dataset(
    scene: Scene,
    folder: Path,
    points: int = 4000,
    noise_pixels: float = 0.3,
    outliers: float = 0.02,
    images: bool = True,
    overwrite: bool = False,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
    tracks: bool = True,
    exposure: Exposure | None = None,
    processes: int = 1,
) -> SfmPoints:
    """Writes images, depths (along the optical axis), transforms.json, sparse_pc.ply and colmap/sparse/0.

    With moving objects also their exact masks (moving/), which transforms.json does not name: tests compare detected
    masks with them. With an exposure also exposure.json. All is in the scene's own frame, which applied_transform
    states.

    ``points``, ``noise_pixels`` and ``outliers`` are those of ``sfm_points``. Without ``images`` only cameras and
    points are written, without ``tracks`` no points and no COLMAP model, which need pycolmap. ``progress`` wraps the
    image numbers as they are rendered, by ``processes`` side by side; the files do not depend on their number.

    Raises FileExistsError if the folder is in use and may not, or cannot safely, be overwritten, and ValueError if a
    number is out of range; nothing was touched then.
    """
    check_folder(folder, overwrite)
    sfm = sfm_points(scene, points, noise_pixels, outliers)
    clear(folder)
    if tracks:
        model, sparse = colmap_model(scene, sfm), folder / "colmap" / "sparse" / "0"
        sparse.mkdir(parents=True)
        model.write(sparse)
        model.export_PLY(folder / "sparse_pc.ply")
    if images:
        _write_images(scene, folder, exposure, progress, processes)
    if exposure is not None:
        names = [f"images/{image_name(i)}" for i in range(len(scene.cameras))]
        (folder / "exposure.json").write_text(json.dumps(exposure.to_object(names), indent=1))
    # Last, so that a folder with a transforms.json is complete.
    (folder / "transforms.json").write_text(json.dumps(_transforms(scene, images), indent=1))
    return sfm


def _write_image(camera: int) -> None:
    """Renders one image and writes its files."""
    scene, folder, exposure = _writing
    name, exif = image_name(camera), Image.Exif()
    colors, distances = render(scene.filmed_by(camera), camera)
    if exposure is not None:
        colors = exposure.expose(scene.cameras, camera, colors)
        seconds = Fraction(SECONDS * exposure.gains[camera, 1]).limit_denominator(10**6)  # by the gain of green
        exif[0x8769] = {33434: float(seconds), 33437: APERTURE, 34855: SPEED}  # its own directory: time, f-number, ISO
    Image.fromarray((colors * 255).round().astype(np.uint8)).save(folder / "images" / name, exif=exif)
    if not isinstance(scene.cameras, Panoramas):
        write_depths(scene, folder, camera, distances)
    if scene.movers is not None:
        Image.fromarray(moving_mask(scene, camera)).save(folder / "moving" / name)


def write_depths(scene: Scene, folder: Path, camera: int, distances: Colors) -> None:
    """Writes the depth image of a camera, given metres along the rays [H, W]: millimetres along the optical axis, 0
    where that is too far."""
    slant = np.sqrt(1 + (scene.cameras.central_tangents**2).sum(-1)).reshape(distances.shape)
    depths = 1000 * distances / slant
    millimetres = np.where(depths <= MILLIMETRES, depths, 0).round().astype(np.uint16)
    (folder / "depths").mkdir(exist_ok=True)
    Image.fromarray(millimetres).save(folder / "depths" / image_name(camera))


_writing: tuple[Scene, Path, Exposure | None]
"""Arguments of the processes of a pool: forks inherit them, as a scene's functions cannot be sent."""


def _write_images(
    scene: Scene,
    folder: Path,
    exposure: Exposure | None,
    progress: Callable[[Iterable[int]], Iterable[int]],
    processes: int,
) -> None:
    """Renders and writes all images, by forked processes if there are several and the system can fork."""
    global _writing
    for part in ("images", *(["moving"] if scene.movers else [])):
        (folder / part).mkdir()
    _writing, count = (scene, folder, exposure), len(scene.cameras)
    if min(processes, count) < 2 or "fork" not in get_all_start_methods():
        for camera in progress(range(count)):
            _write_image(camera)
        return
    pool = ProcessPoolExecutor(min(processes, count), get_context("fork"))
    try:
        written = pool.map(_write_image, range(count))
        for _ in progress(range(count)):
            next(written)
    finally:
        pool.shutdown(cancel_futures=True)


def check_folder(folder: Path, overwrite: bool) -> None:
    """Check that a data set may be written. Raises FileExistsError if not."""
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise FileExistsError(f"{folder} is not empty: choose another folder, or add --overwrite to replace it.")
        others = sorted(p.name for p in folder.iterdir() if p.name not in PARTS)
        if others:
            raise FileExistsError(f"{folder} holds more than a data set ({others[0]}): move that, or choose another.")
    elif folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file: choose another folder.")


def clear(folder: Path) -> None:
    """Makes the folder, without a data set in it."""
    folder.mkdir(parents=True, exist_ok=True)
    for part in PARTS:
        path = folder / part
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _transforms(scene: Scene, images: bool) -> dict:
    cameras, frames = scene.cameras, []
    is_round = isinstance(cameras, Panoramas)
    focal = np.pi * cameras.focal if is_round else cameras.focal  # nerfstudio's is half the width of a panorama
    for i, pose in enumerate(cameras.camera_to_worlds):
        frame = {"file_path": f"images/{image_name(i)}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        frames.append(frame | ({"depth_file_path": f"depths/{image_name(i)}"} if images and not is_round else {}))
    test = cameras.is_test
    names = {split: [f["file_path"] for f, t in zip(frames, test, strict=True) if t == held] for split, held in
             (("train", False), ("val", True), ("test", True))}  # fmt: skip
    return {
        "camera_model": "EQUIRECTANGULAR" if is_round else "OPENCV",
        "fl_x": focal, "fl_y": focal, "cx": cameras.center[0], "cy": cameras.center[1],
        "w": cameras.width, "h": cameras.height,
        **dict(zip(("k1", "k2", "p1", "p2"), cameras.distortion, strict=True)),
        "applied_transform": np.eye(4)[:3].tolist(),
        **({} if is_round else {"ply_file_path": "sparse_pc.ply"}),
        "scene": {"name": scene.name, "seed": scene.seed},
        **{f"{split}_filenames": files for split, files in names.items()},
        "frames": frames,
    }  # fmt: skip


def colmap_model(scene: Scene, sfm: SfmPoints) -> Any:
    """The cameras, points and tracks as a ``pycolmap.Reconstruction``; image and point ids count from 1."""
    import pycolmap  # a machine with a GPU may lack it

    cameras, points, is_bent = scene.cameras, sfm.points, any(scene.cameras.distortion)
    params = [cameras.focal, cameras.focal, *cameras.center, *(cameras.distortion if is_bent else ())]
    size = {"width": cameras.width, "height": cameras.height}
    camera = pycolmap.Camera(model="OPENCV" if is_bent else "PINHOLE", params=params, camera_id=1, **size)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    by_camera = np.argsort(sfm.camera, kind="stable")
    bounds = np.searchsorted(sfm.camera[by_camera], np.arange(len(cameras) + 1))
    slot = np.empty(len(by_camera), np.int64)
    for i, pose in enumerate(cameras.camera_to_worlds):
        rows = by_camera[bounds[i] : bounds[i + 1]]
        slot[rows] = np.arange(len(rows))
        rotation = np.diag([1.0, -1.0, -1.0]) @ pose[:, :3].T  # world to camera, with y down and z ahead
        image = pycolmap.Image(name=image_name(i), camera_id=1, image_id=i + 1, keypoints=sfm.pixel[rows])
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:, 3])
        model.add_image_with_trivial_frame(image, rigid)
    starts = np.searchsorted(sfm.point, np.arange(len(points) + 1))
    elements = [pycolmap.TrackElement(i, k) for i, k in np.stack([sfm.camera + 1, slot], -1).tolist()]
    for p, (xyz, color) in enumerate(zip(points, sfm.colors, strict=True)):
        model.add_point3D(xyz, pycolmap.Track(elements[starts[p] : starts[p + 1]]), color)
    model.update_point_3d_errors()
    return model
