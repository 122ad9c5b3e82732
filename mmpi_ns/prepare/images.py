"""The images of a capture: finding them, upright copies, masks, EXIF, and the cameras that SfM starts from."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from mmpi_ns.capture.exif import kept_tags, positive_number
from mmpi_ns.utils.errors import InputError, progress, say
from mmpi_ns.utils.files import whole

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
HEIF = (".heic", ".heif")
"""Written by phones; read if pillow-heif is installed."""
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg")
SUFFIXES = re.compile(rf"({'|'.join(map(re.escape, IMAGES))}){{1,2}}$", re.IGNORECASE)
"""Of a mask: a.jpg.png is that of a.jpg."""
BODY_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model)
FOCAL_TAGS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
KEPT = {"JPEG": (".jpg", ".jpeg"), "PNG": (".png",)}
"""Formats that are copied unchanged; others become PNG."""
FILM_WIDTH = 36.0
"""Millimetres: EXIF's 35-mm equivalent refers to film this wide."""
Lens = Literal["auto", "pinhole", "radial", "opencv", "fisheye"]
Sharing = Literal["auto", "shared", "per-image"]
MODELS = {"pinhole": "PINHOLE", "radial": "SIMPLE_RADIAL", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
GUESSED_FOCAL = 1.2
"""Focal length over the longer side if nothing is known: COLMAP's guess."""
GIVEN_COUNTS = {3: "f cx cy", 4: "fx fy cx cy", 8: "fx fy cx cy k1 k2 p1 p2"}


@dataclass(frozen=True)
class Photo:
    """An image of the scene."""

    name: str
    """Unique file name in the scene."""
    width: int
    height: int
    lens: str = ""
    """Body and lens from EXIF: images that differ in them do not share intrinsics."""
    exif_focal: float | None = None
    """Pixels."""
    source: str = ""
    """Where it came from, below the input folder."""


def find_images(folder: Path) -> list[Path]:
    """The images in a folder in natural order; in its subfolders if it has none itself. Raises InputError for fewer
    than two."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder of images and no video ({', '.join(VIDEOS)}).")
    readable = (*IMAGES, *(HEIF if reads_heif() else ()))
    files = [p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")]
    images = [p for p in files if p.suffix.lower() in readable]
    images = [p for p in images if p.parent == folder] or images
    kinds: dict[str, list[str]] = {}
    for file in sorted(set(files) - set(images)):
        kinds.setdefault(file.suffix.lower() or "no suffix", []).append(str(file.relative_to(folder)))
    for kind, names in sorted(kinds.items()):
        why = "are not read"
        if kind in HEIF:
            why = "are not read: pip install pillow-heif, and start again"
        elif kind in IMAGES:
            why = "are in subfolders and left out, because the folder has images of its own"
        say(f"{len(names)} {kind} files {why} ({in_short(names)}).", "yellow")
    if len(images) < 2:
        count = "no image" if not images else f"one image only ({images[0].name})"
        raise InputError(
            f"{folder} holds {count} ({', '.join(readable)}): a scene needs at least two views, better twenty."
        )
    return sorted(images, key=lambda p: natural_key(str(p.relative_to(folder))))


def reads_heif() -> bool:
    """Whether Pillow reads HEIC, which pillow-heif teaches it."""
    try:
        from pillow_heif import register_heif_opener  # type: ignore[import-not-found]
    except ImportError:
        return False
    register_heif_opener()
    return True


def in_short(names: Sequence[str], most: int = 4) -> str:
    """The first names, and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def natural_key(text: str) -> list[tuple[int, int | str]]:
    """Sort key by which 9 comes before 10."""
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", text) if part]


def scene_names(files: Sequence[Path], folder: Path) -> list[str]:
    """Unique names in the scene: the file names, prefixed with the names of their subfolders."""
    names, used = [], set()
    for file in files:
        # COLMAP's list of pairs is split at blanks
        stem = re.sub(r"\s+", "_", "-".join(file.relative_to(folder).with_suffix("").parts))
        kind = file.suffix.lower()
        name = stem + (file.suffix if kind in (".jpg", ".jpeg", ".png") else ".jpg" if kind in HEIF else ".png")
        while Path(name).stem.lower() in used:  # masks and downscaled copies go by the stem
            name = Path(name).stem + "_" + Path(name).suffix
        used.add(Path(name).stem.lower())
        names.append(name)
    return names


def gather(folder: Path, files: Sequence[Path], target: Path) -> list[Photo]:
    """Copies images upright into ``target/images``, unless they are there; reads sizes and EXIF. Raises InputError
    naming an image that cannot be read."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    photos = []
    with progress("Reading images", len(files)) as advance:
        for file, name in zip(files, scene_names(files, folder), strict=True):
            image, copy = open_image(file), target / "images" / name
            exif = image.getexif()
            is_turned = exif.get(ExifTags.Base.Orientation, 1) not in (0, 1)
            size = ImageOps.exif_transpose(image).size if is_turned else image.size
            if not copy.exists():
                is_read = file.suffix.lower() in KEPT.get(image.format or "", ()) and image.mode in ("L", "RGB", "RGBA")
                with whole(copy) as partial:
                    if is_read and not is_turned:
                        shutil.copyfile(file, partial)
                    else:  # upright in 8 bits: nerfstudio would show it rotated, or not read it
                        upright = ImageOps.exif_transpose(image)
                        if upright.mode.startswith(("I", "F")):
                            values = np.asarray(upright, dtype=np.float64)
                            is_deep = upright.mode.startswith("I") and values.max() > 255
                            top = 65535.0 if is_deep else max(float(values.max()), 1e-9)
                            upright = Image.fromarray(np.clip(values / top * 255, 0, 255).astype(np.uint8))
                        has_alpha = upright.mode in ("RGBA", "LA", "PA") and copy.suffix.lower() == ".png"
                        upright = upright.convert("L" if upright.mode in ("1", "L") else "RGBA" if has_alpha else "RGB")
                        tags = kept_tags(image)
                        if copy.suffix.lower() == ".png":
                            upright.save(partial, format="PNG", exif=tags)
                        else:
                            upright.save(partial, format="JPEG", quality=97, subsampling=0, exif=tags)
            shot = exif.get_ifd(ExifTags.IFD.Exif)
            parts = [exif.get(tag) for tag in BODY_TAGS] + [shot.get(tag) for tag in FOCAL_TAGS]
            lens = " ".join(str(part).strip() for part in parts if part)
            focal = positive_number(shot.get(FOCAL_TAGS[1]))
            focal = focal and focal / FILM_WIDTH * max(size)
            photos.append(Photo(name, *size, lens, focal, str(file.relative_to(folder))))
            advance(1)
    return photos


def open_image(path: Path) -> Image.Image:
    """An image, decoded. Raises InputError naming the file if it cannot be read."""
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read ({error}): repair or remove it.") from error


def gather_masks(folder: Path, photos: Sequence[Photo], target: Path) -> int:
    """Writes a mask for each image to ``target/NAME.png``: white is used, black (zero) is left out.

    Returns:
        Images that had a mask; the others get an all-white one, since nerfstudio wants all or none.

    Raises:
        InputError: no mask fits an image, or one has another size.
    """
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in IMAGES]
    bare = [SUFFIXES.sub("", p.relative_to(folder).as_posix()) for p in files]
    stems = [Path(b).name for b in bare]
    by_name = dict(zip(bare, files, strict=True))
    by_name |= {stem: p for stem, p in zip(stems, files, strict=True) if stems.count(stem) == 1}
    target.mkdir(parents=True, exist_ok=True)
    count = 0
    for photo in photos:
        names = (photo.source.rpartition(".")[0], Path(photo.name).stem, Path(photo.source).stem)
        source = next((by_name[n] for n in names if n in by_name), None)
        mask = Image.new("L", (photo.width, photo.height), 255)
        if source is not None:
            count += 1
            mask = ImageOps.exif_transpose(open_image(source)).convert("L").point(lambda v: 255 if v else 0)
            if mask.size != (photo.width, photo.height):
                raise InputError(
                    f"Mask {source} is {mask.size[0]}x{mask.size[1]}, its image {photo.name} "
                    f"{photo.width}x{photo.height}: they must be of one size."
                )
        mask.save(target / f"{photo.name}.png")
    if not count:
        raise InputError(f"No mask in {folder} is named like an image (a.png or a.jpg.png for a.jpg).")
    if count < len(photos):
        say(f"{len(photos) - count} of {len(photos)} images have no mask: all their pixels are used.", "yellow")
    return count


@dataclass(frozen=True)
class Intrinsics:
    """A lens in pixels of one image: OpenCV's pinhole and distortion, or OpenCV's fisheye."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2; k1 to k4 of a fisheye lens."""
    fisheye: bool = False


def parse_camera(values: Sequence[float], fisheye: bool) -> Intrinsics:
    """The camera of ``--camera``. Raises InputError if the numbers fit none or a focal length is not positive."""
    if len(values) not in GIVEN_COUNTS:
        raise InputError(f"--camera takes {' or '.join(GIVEN_COUNTS.values())}, not {len(values)} numbers.")
    if len(values) == 3:
        values = (values[0], *values)
    if min(values[:2]) <= 0:
        raise InputError("--camera: focal lengths must be positive, in pixels.")
    lens = tuple(values[4:]) or (0.0,) * 4
    return Intrinsics(*values[:4], distortion=lens, fisheye=fisheye)  # type: ignore[arg-type]


def make_cameras(
    photos: Sequence[Photo], sharing: Sharing, lenses: dict[str, Intrinsics], focal: float | None, lens: Lens
) -> tuple[list[int], list[pycolmap.Camera]]:
    """Cameras from given intrinsics, else from EXIF, else guessed.

    Args:
        photos: the images.
        sharing: which of them share a camera; auto: those of one size, lens and known intrinsics.
        lenses: known intrinsics by image name.
        focal: focal length in pixels, from the command line.
        lens: distortion model if none is given.

    Returns:
        Camera of each image, numbered from 1, and the cameras in this order.

    Raises:
        InputError: images of different sizes are to share one camera.
    """
    sizes = {(p.width, p.height) for p in photos}
    if sharing == "shared" and len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise InputError(f"--intrinsics shared, but the images are of different sizes ({listed}): use auto.")
    by_key: dict[Any, int] = {}
    numbers: list[int] = []
    cameras: list[pycolmap.Camera] = []
    for photo in photos:
        intrinsics = lenses.get(photo.name)
        key = (photo.width, photo.height, "" if sharing == "shared" else photo.lens, intrinsics)
        number = by_key.setdefault(photo.name if sharing == "per-image" else key, len(cameras) + 1)
        numbers.append(number)
        if number <= len(cameras):
            continue
        if intrinsics is not None:
            params = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
            is_bent = intrinsics.fisheye or any(intrinsics.distortion)
            model = "OPENCV_FISHEYE" if intrinsics.fisheye else "OPENCV" if is_bent else "PINHOLE"
            params += intrinsics.distortion if is_bent else ()
            size = {"width": photo.width, "height": photo.height, "camera_id": number}
            camera = pycolmap.Camera(model=model, params=params, **size)
        else:
            model = MODELS["radial" if lens == "auto" and focal is None else "pinhole" if lens == "auto" else lens]
            guess = focal or photo.exif_focal or GUESSED_FOCAL * max(photo.width, photo.height)
            camera = pycolmap.Camera.create_from_model_name(number, model, guess, photo.width, photo.height)
        camera.has_prior_focal_length = bool(intrinsics or focal or photo.exif_focal)
        cameras.append(camera)
    return numbers, cameras


def read_intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """A pycolmap camera as OpenCV's. Raises InputError if nerfstudio-data does not support the lens model."""
    name, terms = camera.model.name, [float(v) for v in camera.params[camera.extra_params_idxs()]]
    if name not in (*MODELS.values(), "SIMPLE_PINHOLE", "RADIAL"):
        raise InputError(f"Lens model {name} is not supported in transforms.json.")
    f = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
    k1, k2, k3, k4 = (*terms, 0.0, 0.0, 0.0, 0.0)[:4]
    return Intrinsics(*f, distortion=(k1, k2, k3, k4), fisheye=name == "OPENCV_FISHEYE")
