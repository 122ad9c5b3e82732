"""The images of a capture: finding them, upright copies, masks, and EXIF."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from mmpi_ns.capture.exif import kept_tags
from mmpi_ns.prepare.stages import PrepareError, progress, say, whole, write_text

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
HEIF = (".heic", ".heif")
"""Written by phones; read if pillow-heif is installed."""
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg")
KEPT = {"JPEG": (".jpg", ".jpeg"), "PNG": (".png",)}
"""Formats that are copied unchanged; others become PNG."""
FILM_WIDTH = 36.0
"""Millimetres: EXIF's 35-mm equivalent refers to film this wide."""


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
    """The images in a folder in natural order; those of its subfolders if it has none itself.

    Raises:
        PrepareError: fewer than two images.
    """
    if not folder.is_dir():
        raise PrepareError(f"{folder} is no folder of images and no video ({', '.join(VIDEOS)}).")
    readable = (*IMAGES, *(HEIF if reads_heif() else ()))
    files = [p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")]
    images = [p for p in files if p.suffix.lower() in readable]
    found = [p for p in images if p.parent == folder] or images
    _tell_unread(sorted(set(files) - set(found)), folder)
    if len(found) < 2:
        count = "no image" if not found else f"one image only ({found[0].name})"
        raise PrepareError(
            f"{folder} holds {count} ({', '.join(readable)}): a scene needs at least two views, better twenty."
        )
    return sorted(found, key=lambda p: natural_key(str(p.relative_to(folder))))


def reads_heif() -> bool:
    """Whether Pillow reads HEIC, which pillow-heif teaches it."""
    try:
        from pillow_heif import register_heif_opener  # type: ignore[import-not-found]
    except ImportError:
        return False
    register_heif_opener()
    return True


def _tell_unread(files: Sequence[Path], folder: Path) -> None:
    """Reports the files that are left out, by kind."""
    kinds: dict[str, list[str]] = {}
    for file in files:
        kinds.setdefault(file.suffix.lower() or "no suffix", []).append(str(file.relative_to(folder)))
    for kind, names in sorted(kinds.items()):
        why = "are not read"
        if kind in HEIF:
            why = "are not read: pip install pillow-heif, and start again"
        elif kind in IMAGES:
            why = "are in subfolders and left out, because the folder has images of its own"
        say(f"{len(names)} {kind} files {why} ({in_short(names)}).", "yellow")


def in_short(names: Sequence[str], most: int = 4) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def natural_key(text: str) -> list[tuple[int, int | str]]:
    """Sorts 9 before 10."""
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", text) if part]


def scene_names(files: Sequence[Path], folder: Path) -> list[str]:
    """Unique names in the scene: those of the files, prefixed with their subfolders if there are any."""
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
    """Copies images upright into ``target/images`` and notes their sizes and EXIF; skips those already there.

    Raises:
        PrepareError: an image cannot be read; names the file.
    """
    (target / "images").mkdir(parents=True, exist_ok=True)
    names = scene_names(files, folder)
    photos = []
    with progress("Reading images", len(files)) as advance:
        for file, name in zip(files, names, strict=True):
            photos.append(_gather_one(file, target / "images" / name, str(file.relative_to(folder))))
            advance(1)
    write_photos(photos, target)
    return photos


def write_photos(photos: Sequence[Photo], target: Path) -> None:
    write_text(target / "photos.json", json.dumps([asdict(p) for p in photos], indent=1))


def read_photos(target: Path) -> list[Photo]:
    """The images that ``gather`` or the frame selection left."""
    return [Photo(**entry) for entry in json.loads((target / "photos.json").read_text(encoding="utf-8"))]


def _gather_one(source: Path, copy: Path, shown: str) -> Photo:
    image = open_image(source)
    exif = image.getexif()
    turned = exif.get(ExifTags.Base.Orientation, 1) not in (0, 1)
    keep = not turned and source.suffix.lower() in KEPT.get(image.format or "", ())
    width, height = ImageOps.exif_transpose(image).size if turned else image.size
    if not copy.exists():
        with whole(copy) as partial:
            if keep and image.mode in ("L", "RGB", "RGBA"):
                shutil.copyfile(source, partial)
            else:
                _convert(image, partial, copy.suffix.lower())
    lens, focal = _read_exif(exif, max(width, height))
    return Photo(copy.name, width, height, lens, focal, shown)


def open_image(path: Path) -> Image.Image:
    """An image, decoded.

    Raises:
        PrepareError: it cannot be read; names the file.
    """
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise PrepareError(f"{path} cannot be read ({error}): repair or remove it.") from error


def _convert(image: Image.Image, path: Path, suffix: str) -> None:
    """Upright 8-bit copy of an image that nerfstudio would show rotated or not read."""
    upright = ImageOps.exif_transpose(image)
    if upright.mode.startswith(("I", "F")):
        values = np.asarray(upright, dtype=np.float64)
        top = 65535.0 if upright.mode.startswith("I") and values.max() > 255 else max(float(values.max()), 1e-9)
        upright = Image.fromarray(np.clip(values / top * 255, 0, 255).astype(np.uint8))
    mode = "L" if upright.mode in ("1", "L") else "RGBA" if upright.mode in ("RGBA", "LA", "PA") else "RGB"
    form = "PNG" if suffix == ".png" else "JPEG"
    upright = upright.convert("RGB" if form == "JPEG" and mode == "RGBA" else mode)
    options = {"quality": 97, "subsampling": 0} if form == "JPEG" else {}
    upright.save(path, format=form, exif=kept_tags(image), **options)


def _read_exif(exif: Image.Exif, longest: int) -> tuple[str, float | None]:
    """(body and lens in words, focal length in pixels if EXIF gives the 35-mm equivalent)."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    base, tags = ExifTags.Base, (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
    parts = [exif.get(base.Make), exif.get(base.Model), *(details.get(tag) for tag in tags)]
    lens = " ".join(str(p).strip() for p in parts if p)
    try:
        equivalent = float(details.get(tags[1], 0))
    except (TypeError, ValueError):
        equivalent = 0.0
    return lens, equivalent / FILM_WIDTH * longest if equivalent > 0 else None


def gather_masks(folder: Path, photos: Sequence[Photo], target: Path) -> int:
    """Writes a mask for each image to ``target/NAME.png``: white is used, black (zero) is left out.

    Returns:
        Images that had a mask; the others get an all-white one, since nerfstudio wants all or none.

    Raises:
        PrepareError: no mask fits an image, or one has another size.
    """
    by_name = _masks_by_name(folder)
    target.mkdir(parents=True, exist_ok=True)
    found = 0
    for photo in photos:
        names = (photo.source.rpartition(".")[0], Path(photo.name).stem, Path(photo.source).stem)
        source = next((by_name[n] for n in names if n in by_name), None)
        mask = Image.new("L", (photo.width, photo.height), 255)
        if source is not None:
            found += 1
            mask = ImageOps.exif_transpose(open_image(source)).convert("L").point(lambda v: 255 if v else 0)
            if mask.size != (photo.width, photo.height):
                raise PrepareError(
                    f"Mask {source} is {mask.size[0]}x{mask.size[1]}, its image {photo.name} "
                    f"{photo.width}x{photo.height}: they must be of one size."
                )
        mask.save(target / f"{photo.name}.png")
    if not found:
        raise PrepareError(f"No mask in {folder} is named like an image (a.png or a.jpg.png for a.jpg).")
    if found < len(photos):
        say(f"{len(photos) - found} of {len(photos)} images have no mask: all their pixels are used.", "yellow")
    return found


def _masks_by_name(folder: Path) -> dict[str, Path]:
    """Masks by their path below the folder without suffix, and by their stem if it is unique."""
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in IMAGES]
    by_name: dict[str, Path] = {}
    for with_folder in (True, False):
        keys = [_bare(p.relative_to(folder)).as_posix() if with_folder else _bare(p).name for p in files]
        by_name |= {k: p for k, p in zip(keys, files, strict=True) if with_folder or keys.count(k) == 1}
    return by_name


def _bare(path: Path) -> Path:
    """Without its suffix, or both of them: a.jpg.png is the mask of a.jpg."""
    path = path.with_suffix("")
    return path.with_suffix("") if path.suffix.lower() in IMAGES else path
