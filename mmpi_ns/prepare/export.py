"""The scene as nerfstudio-data and mmpi read it: transforms.json, points, COLMAP model, images, masks."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from mmpi_ns.capture.exif import kept_tags
from mmpi_ns.prepare.cameras import Intrinsics, read_intrinsics
from mmpi_ns.prepare.frame import camera_poses
from mmpi_ns.prepare.images import Photo
from mmpi_ns.prepare.stages import PrepareError, progress, whole, write_text

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
"""Written explicitly: without it, nerfstudio-data assumes an axis swap if colmap/sparse/0 exists."""
SCENE_PARTS = ("images", "masks", "colmap", "sparse_pc.ply", "report.md", "report", "transforms.json")
"""The parts of a scene besides downscaled copies; transforms.json last, as the mark of a complete scene."""


@dataclass(frozen=True)
class Split:
    """Which images train and which test."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    says: str


def split_by_count(names: Sequence[str], test_every: int | None, train_every: int | None) -> Split:
    """Every n-th image tests, or trains, starting from the middle of the first n.

    Raises:
        PrepareError: a side would be empty.
    """
    if test_every == 0:
        return Split(
            tuple(names),
            tuple(names),
            "every image is used for training and testing (--test-every 0): scores are meaningless",
        )
    every = train_every or test_every or min(8, len(names))
    picked = {n for i, n in enumerate(names) if i % every == every // 2}
    rest = {n for n in names if n not in picked}
    train, test = (picked, rest) if train_every else (rest, picked)
    if not train or not test:
        raise PrepareError(f"One image in {every} of {len(names)} leaves nothing to train or to test: use another.")
    role = "trains, the others test" if train_every else "tests, the others train"
    says = f"one image in {every} {role}, from the {every // 2 + 1}. on"
    return Split(tuple(n for n in names if n in train), tuple(n for n in names if n in test), says)


def split_from(lists: dict[str, Any], names: Sequence[str], source: str) -> Split:
    """The split of another scene's transforms.json; images it does not list are left out of both.

    Raises:
        PrepareError: the lists name none of the images.
    """
    sides = []
    for key in ("train_filenames", "test_filenames"):
        wanted = {Path(str(n)).name for n in lists[key]}
        sides.append(tuple(n for n in names if n in wanted))
        if not sides[-1]:
            raise PrepareError(f"None of the {len(wanted)} {key} of {source} is among the registered images.")
    return Split(sides[0], sides[1], f"as listed in {source}")


def check_fisheye(lenses: Sequence[Intrinsics]) -> None:
    if len({lens.fisheye for lens in lenses}) > 1:
        raise PrepareError("Fisheye and perspective lenses in one scene: prepare them separately, or with --undistort.")


def transforms(model: pycolmap.Reconstruction, split: Split, masks: bool, notes: dict[str, Any]) -> dict[str, Any]:
    """transforms.json for the registered images. Intrinsics are at the top level if all images share them."""
    lenses = {n: read_intrinsics(c) for n, c in model.cameras.items()}
    check_fisheye(list(lenses.values()))
    entries = {n: _camera_entry(lenses[n], model.cameras[n]) for n in lenses}
    names, poses = camera_poses(model)
    shared = len(entries) == 1
    frames = []
    by_name = {image.name: image for image in model.images.values()}
    for name, pose in sorted(zip(names, poses, strict=True), key=lambda pair: pair[0]):
        frame: dict[str, Any] = {"file_path": f"images/{name}"}
        if masks:
            frame["mask_path"] = f"masks/{mask_name(name)}"
        frame |= {} if shared else entries[by_name[name].camera_id]
        frames.append({**frame, "transform_matrix": (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()})
    fisheye = any(lens.fisheye for lens in lenses.values())
    test = [f"images/{n}" for n in split.test]
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        **(next(iter(entries.values())) if shared else {}),
        "frames": frames,
        "train_filenames": [f"images/{n}" for n in split.train],
        "val_filenames": test,
        "test_filenames": test,
        "ply_file_path": "sparse_pc.ply",
        "applied_transform": IDENTITY,
        "mmpi_prepare": notes,
    }


def mask_name(image_name: str) -> str:
    return Path(image_name).stem + ".png"


def _camera_entry(lens: Intrinsics, camera: pycolmap.Camera) -> dict[str, Any]:
    keys = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2")
    entry: dict[str, Any] = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    entry |= {"w": camera.width, "h": camera.height}
    return entry | dict(zip(keys, lens.distortion, strict=True))


def write_images(source: Path, photos: Sequence[Photo], scene: Path, factors: Sequence[int]) -> None:
    """Images and their downscaled copies. Complete copies are kept."""
    with progress("Writing images", len(photos)) as advance:
        for photo in photos:
            copy_once(source / photo.name, scene / "images" / photo.name)
            for factor in factors:
                downscale(scene / "images" / photo.name, scene / f"images_{factor}" / photo.name, factor)
            advance(1)


def write_masks(source: Path, photos: Sequence[Photo], scene: Path, factors: Sequence[int]) -> None:
    """Masks under the stems of their images, and downscaled: a pixel that contains a masked one is masked."""
    for photo in photos:
        mask = scene / "masks" / mask_name(photo.name)
        copy_once(source / f"{photo.name}.png", mask)
        for factor in factors:
            downscale(mask, scene / f"masks_{factor}" / mask.name, factor, mask=True)


def copy_once(source: Path, target: Path) -> None:
    if target.exists():
        return
    with whole(target) as partial:
        shutil.copyfile(source, partial)


def downscale(source: Path, target: Path, factor: int, mask: bool = False) -> None:
    """Box-filtered copy of floor(size / factor) pixels, cut at the far edges so that cameras scale by 1 / factor."""
    if target.exists():
        return
    with Image.open(source) as image:
        tags = kept_tags(image)
        width, height = (n // factor * factor for n in image.size)
        image = image.crop((0, 0, width, height))
        if mask:
            blocks = np.asarray(image).reshape(height // factor, factor, width // factor, factor)
            small = Image.fromarray(blocks.min((1, 3)))
        else:
            small = image.reduce(factor)
    save_like(small, target, tags)


def save_like(image: Image.Image, target: Path, tags: Image.Exif) -> None:
    """Writes an image with its EXIF atomically, JPEG at high quality."""
    with whole(target) as partial:
        if target.suffix.lower() == ".png":
            image.save(partial, format="PNG", exif=tags)
        else:
            image = image.convert("L" if image.mode == "L" else "RGB")
            image.save(partial, format="JPEG", quality=97, subsampling=0, exif=tags)


def write_scene(model: pycolmap.Reconstruction, scene: Path, content: dict[str, Any]) -> None:
    """Everything that is derived from the model; transforms.json last."""
    (scene / "colmap" / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    model.write(scene / "colmap" / "sparse" / "0")
    model.export_PLY(scene / "sparse_pc.ply")
    write_text(scene / "transforms.json", json.dumps(content, indent=1))


def publish(built: Path, scene: Path, replaced: Path) -> None:
    """Moves a finished scene into place, transforms.json last; what it replaces is moved aside first, not deleted."""
    parts = sorted((p.name for p in built.iterdir()), key=lambda n: n == "transforms.json")
    old = [n for n in (*parts[::-1], *existing_parts(scene)) if (scene / n).exists()]
    for name in dict.fromkeys(old):
        replaced.mkdir(parents=True, exist_ok=True)
        (scene / name).rename(replaced / name)
    for name in parts:
        (built / name).rename(scene / name)


def existing_parts(scene: Path) -> list[str]:
    """Names in a folder that a scene would use, transforms.json first."""
    if not scene.is_dir():
        return []
    found = [p.name for p in scene.iterdir() if p.name in SCENE_PARTS or is_downscaled(p.name)]
    return sorted(found, key=lambda n: (n != "transforms.json", n))


def is_downscaled(name: str) -> bool:
    stem, _, factor = name.rpartition("_")
    return stem in ("images", "masks") and factor.isdigit()
