"""The scene as nerfstudio-data and mmpi read it: transforms.json, points, COLMAP model, images, masks."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from mmpi_ns.data.exif import kept_tags
from mmpi_ns.utils.errors import InputError, progress
from mmpi_ns.utils.files import whole
from mmpi_prepare.adjustment import camera_poses
from mmpi_prepare.images import QUALITY, Photo
from mmpi_prepare.poses import opencv_intrinsics

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
"""Written explicitly: without it, nerfstudio-data assumes an axis swap if colmap/sparse/0 exists."""
PART = re.compile(r"(images|masks|depths)(_\d+)?|colmap|sparse_pc\.ply|report\.md|report|transforms\.json")
"""The parts of a scene."""


@dataclass(frozen=True)
class Split:
    """Names of the training and the test images."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    summary: str


def split_images(
    names: Sequence[str],
    test_every: int | None = None,
    lists: Mapping[str, Any] | None = None,
    source: str = "",
) -> Split:
    """Every n-th image tests, from the middle of the first n on; or as the lists of another scene's transforms.json
    (``source``) say, and images that they do not name are left out of both. Raises InputError if no image is left to
    train or to test."""
    if lists is not None:
        sides = []
        for key in ("train_filenames", "test_filenames"):
            listed = {Path(str(n)).name for n in lists[key]}
            sides.append(tuple(n for n in names if n in listed))
            if not sides[-1]:
                raise InputError(f"None of the {len(listed)} {key} of {source} is among the registered images.")
        return Split(sides[0], sides[1], f"as listed in {source}")
    if test_every == 0:
        summary = "every image is used for training and testing (--test-every 0): scores are meaningless"
        return Split(tuple(names), tuple(names), summary)
    every = test_every or min(8, len(names))
    test = tuple(n for i, n in enumerate(names) if i % every == every // 2)
    train = tuple(n for i, n in enumerate(names) if i % every != every // 2)
    if not train or not test:
        raise InputError(f"One image in {every} of {len(names)} leaves nothing to train or to test: use another.")
    return Split(train, test, f"one image in {every} tests, from the {every // 2 + 1}. on")


def transforms(
    model: pycolmap.Reconstruction, split: Split, masks: bool, depths: Mapping[str, str], notes: dict[str, Any]
) -> dict[str, Any]:
    """transforms.json for the registered images; intrinsics that all share are at the top level. ``depths`` are paths
    of depth images by name of the image, if any. Raises InputError if nerfstudio-data reads no scene with these
    lenses."""
    lenses = {number: opencv_intrinsics(camera) for number, camera in model.cameras.items()}
    kinds = {is_fisheye for _, is_fisheye in lenses.values()}
    if len(kinds) > 1:
        raise InputError("Fisheye and perspective lenses in one scene: prepare them separately.")
    keys = ("k1", "k2", "k3", "k4") if True in kinds else ("k1", "k2", "p1", "p2", "k3")
    entries: dict[int, dict[str, Any]] = {}
    for number, (values, _) in lenses.items():
        size = {"w": model.cameras[number].width, "h": model.cameras[number].height}
        entry = dict(zip(("fl_x", "fl_y", "cx", "cy"), values[:4], strict=True)) | size
        entries[number] = entry | dict(zip(keys, values[4:], strict=False))
    is_shared = len({tuple(entry.values()) for entry in entries.values()}) == 1
    camera_of = {image.name: image.camera_id for image in model.images.values()}
    frames = []
    for name, pose in sorted(zip(*camera_poses(model), strict=True), key=lambda pair: pair[0]):
        frame: dict[str, Any] = {"file_path": f"images/{name}"}
        if masks:
            frame["mask_path"] = f"masks/{Path(name).stem}.png"
        if depths:
            frame["depth_file_path"] = depths[name]
        frame |= {} if is_shared else entries[camera_of[name]]
        frames.append({**frame, "transform_matrix": (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()})
    test = [f"images/{n}" for n in split.test]
    return {
        "camera_model": "OPENCV_FISHEYE" if True in kinds else "OPENCV",
        **(next(iter(entries.values())) if is_shared else {}),
        "frames": frames,
        "train_filenames": [f"images/{n}" for n in split.train],
        "val_filenames": test,
        "test_filenames": test,
        "ply_file_path": "sparse_pc.ply",
        "applied_transform": IDENTITY,
        "mmpi_prepare": notes,
    }


def write_images(
    images: Path, masks: Path | None, photos: Sequence[Photo], scene: Path, factors: Sequence[int]
) -> None:
    """Images, masks under the stems of their images, and downscaled copies of both."""
    with progress("Writing images", len(photos)) as advance:
        for photo in photos:
            files = [(images / photo.name, "images", photo.name)]
            files += [(masks / f"{photo.name}.png", "masks", f"{Path(photo.name).stem}.png")] if masks else []
            for source, folder, name in files:
                target = scene / folder / name
                with whole(target) as partial:
                    shutil.copyfile(source, partial)
                for factor in factors:
                    downscale(target, scene / f"{folder}_{factor}" / name, factor, mask=folder == "masks")
            advance(1)


def downscale(source: Path, target: Path, factor: int, mask: bool = False) -> None:
    """Box-filtered copy of floor(size / factor) pixels, cut at the far edges so that cameras scale by 1 / factor.

    A pixel of a mask that contains a masked one is masked. JPEG is written at high quality.
    """
    with Image.open(source) as image:
        tags = kept_tags(image)
        width, height = (n // factor * factor for n in image.size)
        image = image.crop((0, 0, width, height))
        if mask:
            blocks = np.asarray(image).reshape(height // factor, factor, width // factor, factor)
            small = Image.fromarray(blocks.min((1, 3)))
        else:
            small = image.reduce(factor)
    kind = "PNG" if target.suffix.lower() == ".png" else "JPEG"
    if kind == "JPEG" and small.mode != "L":
        small = small.convert("RGB")
    with whole(target) as partial:
        small.save(partial, format=kind, quality=QUALITY, subsampling=0, exif=tags)


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
    parts = [p.name for p in scene.iterdir() if PART.fullmatch(p.name)] if scene.is_dir() else []
    return sorted(parts, key=lambda n: (n != "transforms.json", n))
