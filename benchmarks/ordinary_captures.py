"""Ordinary captures by script: any number of images of any size and lens, with tracks, points, or poses alone.

A walk down a procedural street of flat surfaces. Images are drawn small and enlarged, so that 400 photos of 12
megapixels take a minute; poses, lenses and points are exact.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

DRAWN = 240
"""Width of the drawn images, before they are enlarged."""
STEP = 0.25
"""Distance from one camera to the next; the street is 8 wide."""
HALF_WIDTH, EYE_LEVEL, ROOF = 4.0, 1.5, 3.0
REACH = 25.0
"""Points are tracked up to this distance."""
LENSES = {
    "none": ("OPENCV", {}),
    "opencv": ("OPENCV", {"k1": -0.08, "k2": 0.02, "p1": 1e-3, "p2": -5e-4}),
    "fisheye": ("OPENCV_FISHEYE", {"k1": 0.02, "k2": -0.005, "k3": 0.0, "k4": 0.0}),
}


@dataclass(frozen=True)
class Capture:
    """What a capture is like: one row of the matrix."""

    images: int
    pixels: int
    """Longer side of an image."""
    shape: str
    """"landscape" or "portrait", both 4:3, or "mixed": in turn, each third image of half the size."""
    lens: str
    """A key of ``LENSES``."""
    depth: str
    """"tracks": a COLMAP model; "points": a point cloud; "poses": neither."""
    windows: str
    """"one" or "several": into how many windows the run is split."""

    @property
    def name(self) -> str:
        return "-".join(str(value) for value in vars(self).values())

    @property
    def megapixels(self) -> float:
        """Of all images."""
        return sum(width * height for width, height in map(self.size, range(self.images))) / 1e6

    def size(self, i: int) -> tuple[int, int]:
        """Width and height of an image."""
        long = self.pixels // 2 if self.shape == "mixed" and i % 3 == 2 else self.pixels
        short = long * 3 // 4
        return (long, short) if self.shape == "landscape" or (self.shape == "mixed" and i % 2 == 0) else (short, long)

    def focal(self, i: int) -> float:
        """65 degrees along the longer side, 130 of a fisheye. Pixels."""
        return max(self.size(i)) * (0.45 if self.lens == "fisheye" else 0.8)

    def pose(self, i: int) -> Array:
        """Camera to world, x right, y up, looking along -z: down the street, swaying, turning a little. [4, 4]"""
        pose = np.eye(4)
        yaw, pitch = 0.25 * np.sin(0.17 * i), 0.03 * np.sin(1.3 * i)
        pose[:3, :3] = Rotation.from_euler("yx", [yaw, pitch]).as_matrix()
        pose[:3, 3] = [0.5 * np.sin(0.11 * i), EYE_LEVEL + 0.03 * np.sin(2.1 * i), -STEP * i]
        return pose

    def distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Where the lens puts directions (x, y, 1), in focal lengths from the principal point; y down."""
        k = LENSES[self.lens][1]
        if self.lens == "fisheye":
            radius = np.hypot(x, y)
            angle = np.arctan(radius)
            scale = angle * (1 + k["k1"] * angle**2 + k["k2"] * angle**4) / np.maximum(radius, 1e-12)
            return x * scale, y * scale
        if not k:
            return x, y
        r2 = x * x + y * y
        radial = 1 + k["k1"] * r2 + k["k2"] * r2 * r2
        shift_x = 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x)
        shift_y = k["p1"] * (r2 + 2 * y * y) + 2 * k["p2"] * x * y
        return x * radial + shift_x, y * radial + shift_y

    def directions(self, i: int, width: int, height: int) -> Array:
        """Directions in world axes through the pixels of an image drawn at another size. [H, W, 3]"""
        focal = self.focal(i) * width / self.size(i)[0]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = (columns - width / 2) / focal, (rows - height / 2) / focal
        if self.lens == "fisheye":
            radius = np.hypot(x, y)
            angle = radius
            for _ in range(20):
                angle = angle + radius - self.distorted(np.tan(angle), np.zeros_like(angle))[0]
            ahead = np.cos(angle)
            around = np.sin(angle) / np.maximum(radius, 1e-12)
            local = np.stack([x * around, -y * around, -ahead], -1)
        else:
            u, v = x, y
            for _ in range(20):
                du, dv = self.distorted(u, v)
                u, v = u + x - du, v + y - dv
            local = np.stack([u, -v, -np.ones_like(u)], -1)
        return local @ self.pose(i)[:3, :3].T

    def image(self, i: int) -> NDArray[np.uint8]:
        """[H, W, 3], red, green, blue."""
        width, height = self.size(i)
        small = min(1.0, DRAWN / max(width, height))
        drawn = round(width * small), round(height * small)
        colors = street_colors(self.pose(i)[:3, 3], self.directions(i, *drawn))
        picture = (255 * colors).round().astype(np.uint8)
        return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def street_colors(eye: Array, directions: Array) -> Array:
    """Colours of rays from one point: ground, a wall at either side with gaps above it, and the sky. [..., 3]"""
    dx, dy, _ = np.moveaxis(directions, -1, 0)
    with np.errstate(divide="ignore"):
        to_ground = np.where(dy < 0, -eye[1] / dy, np.inf)
        to_wall = np.where(dx > 0, HALF_WIDTH - eye[0], -HALF_WIDTH - eye[0]) / np.where(dx == 0, 1e-12, dx)
    hits_wall = (to_wall < to_ground) & (eye[1] + to_wall * dy < ROOF)
    t = np.where(hits_wall, to_wall, to_ground)
    point = eye + np.where(np.isfinite(t), t, 0.0)[..., None] * directions
    along, across = point[..., 2], np.where(hits_wall, point[..., 1], point[..., 0])
    cell = np.floor(along * 1.5) * 57 + np.floor(across * 2) * 131 + 7 * hits_wall + 3 * (dx > 0) * hits_wall
    shade = np.stack([np.modf(np.abs(np.sin(cell * k)) * 43.7)[0] for k in (12.9898, 78.233, 37.719)], -1)
    wave = 0.1 * np.sin(5 * along) * np.cos(7 * across)
    sky = np.stack([0.5 + 0.3 * dy, 0.7 + 0.2 * dy, np.full_like(dy, 0.95)], -1)
    return np.where((np.isfinite(t) & (t < 200))[..., None], 0.15 + 0.7 * shade + wave[..., None], sky).clip(0, 1)


def write_capture(capture: Capture, folder: Path) -> Path:
    """Writes images, transforms.json, and a COLMAP model or a point cloud.

    Of more than 30 images two are test images, else nerfstudio's own split holds.
    """
    (folder / "images").mkdir(parents=True)
    model, coefficients = LENSES[capture.lens]
    names = [f"images/frame_{i:05d}.jpg" for i in range(capture.images)]
    frames = []
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), capture.image(i)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        (width, height), focal = capture.size(i), capture.focal(i)
        lens = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
        frames.append({"file_path": name, "transform_matrix": capture.pose(i).tolist(), **lens, **coefficients})
    meta = {"camera_model": model, "frames": frames}
    if capture.images > 30:
        tests = {names[capture.images // 3], names[2 * capture.images // 3]}
        meta["train_filenames"] = [name for name in names if name not in tests]
        meta["val_filenames"] = meta["test_filenames"] = sorted(tests)
    points = street_points(capture.images)
    if capture.depth == "points":
        meta["ply_file_path"] = "points.ply"
        rows = "\n".join(" ".join(f"{v:.6f}" for v in p) + " 128 128 128" for p in points)
        kinds = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
            f"property uchar {color}\n" for color in ("red", "green", "blue")
        )
        header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{kinds}end_header\n"
        (folder / "points.ply").write_text(header + rows + "\n")
    elif capture.depth == "tracks":
        meta["applied_transform"] = np.eye(4)[:3].tolist()
        write_colmap(capture, points, folder / "colmap/sparse/0")
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def street_points(images: int) -> Array:
    """Points on ground and walls along the way. [P, 3]"""
    rng = np.random.default_rng(0)
    count = 100 + 12 * images
    along = rng.uniform(-STEP * images - REACH, -2, count)
    side = rng.choice([-HALF_WIDTH, HALF_WIDTH], count)
    on_wall = rng.random(count) < 0.6
    x = np.where(on_wall, side, rng.uniform(-HALF_WIDTH, HALF_WIDTH, count))
    return np.stack([x, np.where(on_wall, rng.uniform(0, ROOF, count), 0.0), along], -1)


def write_colmap(capture: Capture, points: Array, folder: Path) -> None:
    """A COLMAP text model of all images, in the frame of transforms.json."""
    folder.mkdir(parents=True)
    kind, coefficients = LENSES[capture.lens]
    cameras, images, tracks = [], [], [[] for _ in points]
    for i in range(capture.images):
        (width, height), focal, pose = capture.size(i), capture.focal(i), capture.pose(i)
        values = [focal, focal, width / 2, height / 2, *(coefficients.values() or (0, 0, 0, 0))]
        cameras.append(f"{i + 1} {kind} {width} {height} {' '.join(map(str, values))}")
        to_camera = np.diag([1.0, -1, -1]) @ pose[:3, :3].T  # x right, y down, z ahead
        local = (points - pose[:3, 3]) @ to_camera.T
        depth = np.where(local[:, 2] > 0.2, local[:, 2], np.inf)
        at = np.stack(capture.distorted(*(local[:, :2] / depth[:, None]).T), -1) * focal + [width / 2, height / 2]
        seen = ((at > 0) & (at < [width, height])).all(-1) & (depth < REACH)
        x, y, z, w = Rotation.from_matrix(to_camera).as_quat()
        pose_row = " ".join(f"{v:.12g}" for v in (w, x, y, z, *(-to_camera @ pose[:3, 3])))
        images.append(f"{i + 1} {pose_row} {i + 1} frame_{i:05d}.jpg")
        images.append(" ".join(f"{at[p, 0]:.4f} {at[p, 1]:.4f} {p + 1}" for p in seen.nonzero()[0]))
        for place, p in enumerate(seen.nonzero()[0]):
            tracks[p].append(f"{i + 1} {place}")
    rows = [
        f"{p + 1} {' '.join(map(str, points[p]))} 128 128 128 0.1 {' '.join(track)}"
        for p, track in enumerate(tracks) if len(track) > 1
    ]  # fmt: skip
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", rows)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


MATRIX = tuple(
    Capture(*row)
    for row in (
        (2, 320, "portrait", "fisheye", "points", "several"),
        (2, 1000, "mixed", "none", "poses", "several"),
        (2, 1600, "landscape", "opencv", "tracks", "one"),
        (2, 4000, "portrait", "none", "poses", "one"),
        (5, 320, "landscape", "opencv", "poses", "several"),
        (5, 1000, "portrait", "fisheye", "points", "one"),
        (5, 1600, "mixed", "none", "points", "one"),
        (5, 4000, "mixed", "opencv", "tracks", "one"),
        (11, 320, "landscape", "none", "tracks", "one"),
        (11, 1000, "mixed", "opencv", "points", "several"),
        (11, 1600, "portrait", "none", "poses", "several"),
        (11, 4000, "landscape", "fisheye", "tracks", "several"),
        (30, 320, "portrait", "none", "tracks", "several"),
        (30, 1000, "mixed", "opencv", "poses", "several"),
        (30, 1600, "landscape", "opencv", "points", "one"),
        (30, 4000, "landscape", "fisheye", "tracks", "several"),
        (150, 320, "mixed", "none", "poses", "several"),
        (150, 1000, "portrait", "opencv", "tracks", "one"),
        (150, 1600, "landscape", "fisheye", "tracks", "one"),
        (150, 4000, "mixed", "opencv", "points", "several"),
        (400, 320, "mixed", "fisheye", "poses", "several"),
        (400, 1000, "landscape", "opencv", "points", "several"),
        (400, 1600, "portrait", "opencv", "tracks", "several"),
        (400, 4000, "mixed", "none", "tracks", "one"),
    )
)
"""Every number of images with every size, and every other pair of properties at least once."""
