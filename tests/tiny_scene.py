"""A tiny capture in nerfstudio's format: a textured wall in front of a far background, with a COLMAP model.

World axes: x right, y up, the cameras look along -z. The wall stands at z = -4 and fills the lower left of the images;
behind it lies a background at infinity. Everything is computed, so the true colour of any ray is known.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 32, 24, 28.0
WALL = -4.0
TRAIN, TEST = (0, 1, 3, 4, 6, 7), (2, 5)


def name_of(i):
    return f"frame_{i + 1:05d}.png"


def pose_of(i):
    """Camera to world (OpenGL axes): a sideways walk with a slight turn."""
    angle = np.radians(3.0 * np.sin(2.2 * i))
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [-1.05 + 0.3 * i, 0.05 * (i % 3), 0.1 * (i % 2)]
    return pose


def on_wall(x, y):
    return (x < 1.0) & (y < 0.6)


def color_of(origins, directions):
    """True colours [N, 3] of rays."""
    t = (WALL - origins[:, 2]) / directions[:, 2]
    x, y = (origins + t[:, None] * directions)[:, :2].T
    wall = np.stack([0.5 + 0.4 * np.sin(2.5 * x), 0.5 + 0.4 * np.cos(3 * y), 0.3 + 0.2 * np.sin(4 * (x + y))], -1)
    up = directions[:, 1] / np.abs(directions[:, 2])
    sky = np.stack([0.6 + 0.3 * up, 0.75 + 0.1 * up, np.full_like(up, 0.95)], -1)
    return np.where((on_wall(x, y) & (t > 0) & (directions[:, 2] < 0))[:, None], wall, sky).clip(0, 1)


def pixel_rays(width=WIDTH, height=HEIGHT, focal=FOCAL, undistort=lambda p: np.append(p, -np.ones((len(p), 1)), 1)):
    """Directions [H W, 3] of all pixels in camera axes; ``undistort`` takes ((x - cx) / f, -(y - cy) / f)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = undistort(np.stack([(x - width / 2) / focal, -(y - height / 2) / focal], -1).reshape(-1, 2))
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def image_of(i):
    """True image [H, W, 3] in [0, 1]."""
    pose = pose_of(i)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(x - WIDTH / 2) / FOCAL, -(y - HEIGHT / 2) / FOCAL, -np.ones_like(x)], -1).reshape(-1, 3)
    directions = local @ pose[:3, :3].T
    return color_of(np.broadcast_to(pose[:3, 3], directions.shape), directions).reshape(HEIGHT, WIDTH, 3)


def write_scene(folder: Path, *, masks=False, alpha=False, sfm=True) -> Path:
    """Writes 8 images and transforms.json; masks hide the right half, alpha makes the top quarter see-through."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(8):
        image = (image_of(i) * 255).round().astype(np.uint8)
        frame = {"file_path": f"images/{name_of(i)}", "transform_matrix": pose_of(i).tolist()}
        if alpha:
            opacity = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
            opacity[: HEIGHT // 4] = 0
            image = np.concatenate([image, opacity], -1)
        Image.fromarray(image).save(folder / "images" / name_of(i))
        if masks:
            (folder / "masks").mkdir(exist_ok=True)
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[:, WIDTH // 2 :] = 0
            Image.fromarray(mask).save(folder / "masks" / name_of(i))
            frame["mask_path"] = f"masks/{name_of(i)}"
        frames.append(frame)
    split = {"train": TRAIN, "val": TEST, "test": TEST}
    meta = {
        "camera_model": "OPENCV",
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "applied_transform": np.eye(4)[:3].tolist(),
        "frames": frames,
        **{f"{key}_filenames": [f"images/{name_of(i)}" for i in split[key]] for key in split},
    }
    (folder / "transforms.json").write_text(json.dumps(meta))
    if sfm:
        write_colmap(folder / "colmap" / "sparse" / "0")
    return folder


def edit(data: Path, change) -> None:
    """Changes the contents of transforms.json."""
    meta = json.loads((data / "transforms.json").read_text())
    change(meta)
    (data / "transforms.json").write_text(json.dumps(meta))


def expose(data: Path, factors) -> Path:
    """Takes the images anew, as a camera with automatic exposure does: their colours times factors [8, 3]."""
    for i, factor in enumerate(factors):
        Image.fromarray((255 * image_of(i) * factor).round().astype(np.uint8)).save(data / "images" / name_of(i))
    return data


def equidistant(points):
    """Directions [N, 3] of a fisheye at ((x - cx) / f, (cy - y) / f): the angle grows with the distance."""
    angle = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
    return np.append(points / angle * np.sin(angle), -np.cos(angle), 1)


def undistort(x, y, lens):
    """Tangents whose OpenCV distortion (k1, k2, p1, p2) falls on (x, y), y down."""
    points, whole = np.stack([x, y], -1).reshape(-1, 1, 2), np.eye(3)
    actual = cv2.undistortPointsIter(points, whole, np.array([*lens]), whole, whole, (3, 60, 1e-12))
    return np.moveaxis(actual.reshape(*x.shape, 2), -1, 0)


def wall_points():
    """SfM points [P, 3] on the wall."""
    x, y = np.meshgrid(np.linspace(-2.6, 0.9, 9), np.linspace(-1.5, 0.5, 5))
    return np.stack([x, y, np.full_like(x, WALL)], -1).reshape(-1, 3)


def project(i, points):
    """Pixels [P, 2] and whether each lies in image i."""
    pose = pose_of(i)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    pixels = np.stack([local[:, 0], -local[:, 1]], -1) / -local[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]
    return pixels, ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(-1) & (local[:, 2] < 0)


def write_colmap(folder: Path) -> None:
    """A COLMAP text model of all 8 images in the frame of transforms.json."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    points, tracks, lines = wall_points(), {}, []
    for i in range(8):
        # World to camera with y down and z ahead.
        rotation = np.diag([1.0, -1, -1]) @ pose_of(i)[:3, :3].T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        shift = -rotation @ pose_of(i)[:3, 3]
        lines.append(" ".join(str(float(v)) for v in (w, x, y, z, *shift)).join([f"{i + 1} ", f" 1 {name_of(i)}"]))
        pixels, seen = project(i, points)
        row = []
        for p in seen.nonzero()[0]:
            tracks.setdefault(int(p), []).append((i + 1, len(row)))
            row.append(f"{pixels[p, 0]} {pixels[p, 1]} {p + 1}")
        lines.append(" ".join(row))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{p + 1} {points[p, 0]} {points[p, 1]} {points[p, 2]} 128 128 128 0.5 " + " ".join(f"{a} {b}" for a, b in t)
        for p, t in sorted(tracks.items())
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
