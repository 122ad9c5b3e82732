"""Writes a scene as a Nerfstudio data set: images, depths, cameras, a COLMAP model with tracks."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from mmpi_ns.synthetic.primitives import Array
from mmpi_ns.synthetic.scene import Colors, Scene, render
from mmpi_ns.synthetic.sfm_like import SfmPoints, sfm_points

PARTS = ("transforms.json", "images", "images_2", "images_4", "images_8", "depths", "colmap", "sparse_pc.ply")
"""What belongs to a data set, and is removed before another one is written in its place."""
MILLIMETRES = 65535
"""The farthest depth that a 16-bit file holds; 0 stands for farther, and for the sky."""


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
) -> SfmPoints:
    """Writes images, depths (along the optical axis), transforms.json, sparse_pc.ply and colmap/sparse/0.

    Everything is in the scene's own frame, which applied_transform states, as Nerfstudio would guess another.

    Args:
        points, noise_pixels, outliers: see ``sfm_points``.
        images: False writes cameras and points alone.
        overwrite: replaces a data set that is in the folder.
        progress: wraps the image numbers as they are rendered.

    Raises:
        FileExistsError: the folder is in use and may not, or cannot safely, be overwritten. Nothing was touched.
        ValueError: a number is out of range.
    """
    check_folder(folder, overwrite)
    found = sfm_points(scene, points, noise_pixels, outliers)
    clear(folder)
    write_colmap(scene, found, folder / "colmap" / "sparse" / "0")
    _write_ply(found, folder / "sparse_pc.ply")
    for part in ("images", "depths") if images else ():
        (folder / part).mkdir()
    for i in progress(range(len(scene.cameras))) if images else ():
        colors, distances = render(scene, i)
        Image.fromarray((colors * 255).round().astype(np.uint8)).save(folder / "images" / image_name(i))
        Image.fromarray(_millimetres(scene, i, distances)).save(folder / "depths" / image_name(i))
    # Last, so that a folder with a transforms.json is complete.
    (folder / "transforms.json").write_text(json.dumps(_transforms(scene, images), indent=1))
    return found


def check_folder(folder: Path, overwrite: bool) -> None:
    """Raises FileExistsError where a data set must not be written."""
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


def _millimetres(scene: Scene, camera: int, distances: Colors) -> np.ndarray:
    """Depth along the optical axis [H, W] as uint16, 0 where it is too far."""
    height, width = distances.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    (cx, cy), focal = scene.cameras.center, scene.cameras.focal
    depth = 1000 * distances / np.sqrt(((x - cx) / focal) ** 2 + ((y - cy) / focal) ** 2 + 1)
    return np.where(depth <= MILLIMETRES, depth, 0).round().astype(np.uint16)


def _transforms(scene: Scene, images: bool) -> dict:
    cameras = scene.cameras
    frames = []
    for i, pose in enumerate(cameras.camera_to_worlds):
        frame = {"file_path": f"images/{image_name(i)}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        frames.append(frame | ({"depth_file_path": f"depths/{image_name(i)}"} if images else {}))
    test = cameras.is_test
    names = {split: [f["file_path"] for f, t in zip(frames, test, strict=True) if t == held] for split, held in
             (("train", False), ("val", True), ("test", True))}  # fmt: skip
    return {
        "camera_model": "OPENCV",
        "fl_x": cameras.focal, "fl_y": cameras.focal, "cx": cameras.center[0], "cy": cameras.center[1],
        "w": cameras.width, "h": cameras.height, "k1": 0, "k2": 0, "p1": 0, "p2": 0,
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": "sparse_pc.ply",
        "scene": {"name": scene.name, "seed": scene.seed},
        **{f"{split}_filenames": files for split, files in names.items()},
        "frames": frames,
    }  # fmt: skip


def _write_ply(found: SfmPoints, path: Path) -> None:
    names = [f"property float {c}" for c in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    head = ["ply", "format ascii 1.0", f"element vertex {len(found.points)}", *names, "end_header"]
    rows = [
        f"{x:.6f} {y:.6f} {z:.6f} {r} {g} {b}"
        for (x, y, z), (r, g, b) in zip(found.points.tolist(), found.colors.tolist(), strict=True)
    ]
    path.write_text("\n".join([*head, *rows]) + "\n")


def write_colmap(scene: Scene, found: SfmPoints, folder: Path) -> None:
    """The cameras, points and tracks as a COLMAP text model."""
    folder.mkdir(parents=True)
    cameras, (cx, cy) = scene.cameras, scene.cameras.center
    head = f"1 PINHOLE {cameras.width} {cameras.height} {cameras.focal} {cameras.focal} {cx} {cy}\n"
    (folder / "cameras.txt").write_text(head)
    by_camera = np.argsort(found.camera, kind="stable")
    bounds = np.searchsorted(found.camera[by_camera], np.arange(len(cameras) + 1))
    slot = np.empty(len(by_camera), np.int64)
    lines = []
    for i, pose in enumerate(cameras.camera_to_worlds):
        these = by_camera[bounds[i] : bounds[i + 1]]
        slot[these] = np.arange(len(these))
        # World to camera, with y down and z ahead.
        rotation = np.diag([1.0, -1.0, -1.0]) @ pose[:, :3].T
        numbers = [*quaternion(rotation), *(-rotation @ pose[:, 3])]
        lines.append(f"{i + 1} {' '.join(repr(float(n)) for n in numbers)} 1 {image_name(i)}")
        keypoints = zip(found.pixel[these].tolist(), found.point[these].tolist(), strict=True)
        lines.append(" ".join(f"{x:.4f} {y:.4f} {p + 1}" for (x, y), p in keypoints))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    _write_points(found, found.errors(scene), slot, folder / "points3D.txt")


def _write_points(found: SfmPoints, errors: Array, slot: np.ndarray, path: Path) -> None:
    starts = np.searchsorted(found.point, np.arange(len(found.points) + 1))
    pairs = np.stack([found.camera + 1, slot], -1).tolist()
    rows = []
    for p, (xyz, rgb) in enumerate(zip(found.points.tolist(), found.colors.tolist(), strict=True)):
        track = slice(starts[p], starts[p + 1])
        seen = " ".join(f"{i} {k}" for i, k in pairs[track])
        rows.append(f"{p + 1} {' '.join(map(repr, xyz))} {' '.join(map(str, rgb))} {errors[track].mean():.4f} {seen}")
    path.write_text("\n".join(rows) + "\n")


def quaternion(rotation: Array) -> Array:
    """(w, x, y, z) of a rotation matrix [3, 3], w >= 0: the top eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [[a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g],
         [c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e]]
    )  # fmt: skip
    q = np.linalg.eigh(matrix)[1][:, -1]
    return q if q[0] >= 0 else -q
