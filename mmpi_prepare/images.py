"""The images of a capture: found in a folder and copied upright, or the frames of a video that image motion and
sharpness choose; their EXIF and masks."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from mmpi_ns.data.exif import kept_tags, positive_number, tags_of
from mmpi_ns.utils.errors import InputError, log, progress
from mmpi_ns.utils.files import natural_key, opened, whole
from mmpi_prepare.gps import Place, place_of

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
QUALITY = 97
"""Of JPEG."""
FILM_WIDTH = 36.0
"""Millimetres: EXIF's 35-mm equivalent refers to film this wide."""
SIDE, TRACK_WIDTH = 640, 320
"""Longer side at which sharpness is measured, and width at which motion is; pixels."""
LOST = 0.15
"""Motion, relative to the width, assumed for frames that cannot be tracked from the last (a cut, a blank frame)."""
MOST_MOTION = 0.15
"""Motion between chosen frames beyond which SfM gets difficult."""


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
    place: Place | None = None
    """By the GPS of EXIF, as ``place_of`` has it."""


def find_images(folder: Path) -> list[Path]:
    """The images in a folder in natural order; in its subfolders if it has none itself. Raises InputError for fewer
    than two."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder of images and no video ({', '.join(VIDEOS)}).")
    readable = IMAGES
    with suppress(ImportError):  # without it Pillow reads no HEIC
        from pillow_heif import register_heif_opener  # type: ignore[import-not-found]

        register_heif_opener()
        readable += HEIF
    files = [p for p in folder.rglob("*") if not p.is_dir() and not p.name.startswith(".")]
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
        log(f"{len(names)} {kind} files {why} ({in_short(names)}).", "yellow")
    if len(images) < 2:
        count = "no image" if not images else f"one image only ({images[0].name})"
        raise InputError(
            f"{folder} holds {count} ({', '.join(readable)}): a scene needs at least two views, better twenty."
        )
    return sorted(images, key=lambda p: natural_key(str(p.relative_to(folder))))


def in_short(names: Sequence[str], most: int = 4) -> str:
    """The first names, and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def gather(folder: Path, files: Sequence[Path], target: Path) -> list[Photo]:
    """Copies images upright into ``target/images``, unless they are there, under their names with those of subfolders
    before; reads sizes and EXIF. Raises InputError naming an image that cannot be read."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    photos, used = [], set()
    with progress("Reading images", len(files)) as advance:
        for file in files:
            # COLMAP takes UTF-8; in its list of pairs blanks separate and # begins a comment. Masks go by the stem.
            stem = "-".join(file.relative_to(folder).with_suffix("").parts).encode("utf-8", "replace").decode()
            stem = re.sub(r"[\s?#]+", "_", stem)
            while stem.lower() in used:
                stem += "_"
            used.add(stem.lower())
            kind = file.suffix.lower()
            name = stem + (file.suffix if kind in (".jpg", ".jpeg", ".png") else ".jpg" if kind in HEIF else ".png")
            copy = target / "images" / name
            with opened(file) as image:
                image.load()
            exif = tags_of(image)
            is_turned = exif.get(ExifTags.Base.Orientation, 1) not in (0, 1)
            size = ImageOps.exif_transpose(image).size if is_turned else image.size
            if not copy.exists():
                is_read = kind in KEPT.get(image.format or "", ()) and image.mode in ("L", "RGB", "RGBA")
                with whole(copy) as partial:
                    if is_read and not is_turned:
                        shutil.copyfile(file, partial)
                    else:  # upright in 8 bits: nerfstudio would show it rotated, or not read it
                        upright = ImageOps.exif_transpose(image) if is_turned else image
                        if upright.mode.startswith(("I", "F")):
                            values = np.asarray(upright, dtype=np.float64)
                            is_deep = upright.mode.startswith("I") and values.max() > 255
                            top = 65535.0 if is_deep else max(float(values.max()), 1e-9)
                            upright = Image.fromarray(np.clip(values / top * 255, 0, 255).astype(np.uint8))
                        has_alpha = upright.mode in ("RGBA", "LA", "PA") and copy.suffix.lower() == ".png"
                        upright = upright.convert("L" if upright.mode in ("1", "L") else "RGBA" if has_alpha else "RGB")
                        form = "PNG" if copy.suffix.lower() == ".png" else "JPEG"
                        upright.save(partial, format=form, quality=QUALITY, subsampling=0, exif=kept_tags(image))
            shot = exif.get_ifd(ExifTags.IFD.Exif)
            parts = [exif.get(tag) for tag in BODY_TAGS] + [shot.get(tag) for tag in FOCAL_TAGS]
            lens = " ".join(str(part).strip() for part in parts if part)
            focal = positive_number(shot.get(FOCAL_TAGS[1]))
            focal = focal and focal / FILM_WIDTH * max(size)
            place = place_of(exif.get_ifd(ExifTags.IFD.GPSInfo))
            photos.append(Photo(name, *size, lens, focal, str(file.relative_to(folder)), place))
            advance(1)
    return photos


def gather_masks(folder: Path, photos: Sequence[Photo], target: Path) -> int:
    """Writes a mask for each image to ``target/NAME.png``: white is used, black (zero) is left out.

    Returns the number of images that had a mask; the others get an all-white one, since nerfstudio wants all or none.
    Raises InputError if no mask fits an image, or one has another size.
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
            with opened(source) as image:
                mask = ImageOps.exif_transpose(image).convert("L").point(lambda v: 255 if v else 0)
            if mask.size != (photo.width, photo.height):
                raise InputError(
                    f"Mask {source} is {mask.size[0]}x{mask.size[1]}, its image {photo.name} "
                    f"{photo.width}x{photo.height}: they must be of one size."
                )
        mask.save(target / f"{photo.name}.png")
    if not count:
        raise InputError(f"No mask in {folder} is named like an image (a.png or a.jpg.png for a.jpg).")
    if count < len(photos):
        log(f"{len(photos) - count} of {len(photos)} images have no mask: all their pixels are used.", "yellow")
    return count


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over that of the image, at a fixed size: independent of contrast, lowered by blur."""
    scale = SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    values = gray.astype(np.float32)
    return float(cv2.Laplacian(values, cv2.CV_32F).var() / max(float(values.var()), 1.0))


def select_frames(video: Path, target: Path, max_frames: int, step: float) -> list[Photo]:
    """Writes the chosen frames of a video to ``target/images``. Raises InputError if it cannot be read, or shows no
    motion."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    motion, sharp = np.array(measure(video))
    chosen, used = choose_frames(motion, sharp, max_frames, step)
    frames = len(motion)
    if len(chosen) < 2:
        raise InputError(f"{video} shows no motion in {frames} frames: there is no second view.")
    log(f"{len(chosen)} of {frames} frames taken: the sharpest for every {used:.1%} of the width of motion.")
    if used > MOST_MOTION:
        remedy = f"raise --max-frames above {max_frames} or cut the video into shorter ones"
        log(f"{used:.0%} of the width between frames is much: {remedy}.", "yellow")
    capture, photos = cv2.VideoCapture(str(video)), []
    with progress("Writing frames", len(chosen)) as advance:
        for index in range(chosen[-1] + 1):
            if not capture.grab():
                raise InputError(f"{video} could be read for {index} frames this time: it changed, or is damaged.")
            if index != chosen[len(photos)]:
                continue
            _, frame = capture.retrieve()
            name = f"frame_{index:06d}.jpg"
            path = target / "images" / name
            if not path.exists():
                is_encoded, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
                if not is_encoded:
                    raise InputError(f"Frame {index} of {video} cannot be written.")
                with whole(path) as partial:
                    partial.write_bytes(data.tobytes())
            photos.append(Photo(name, frame.shape[1], frame.shape[0], source=name))
            advance(1)
    capture.release()
    return photos


def measure(video: Path) -> tuple[list[float], list[float]]:
    """First pass, with two small frames in memory: motion of each since the one before over the width, and sharpness.
    Raises InputError if the video cannot be read."""
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise InputError(f"{video} cannot be opened as a video: it is damaged, or its codec is unknown here.")
    total = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    motion, sharp, last = [], [], None
    with progress("Reading the video", total or None) as advance:
        while True:
            ok, frame = capture.read()
            if not ok:
                break
            gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            sharp.append(sharpness(gray))  # type: ignore[arg-type]
            scale = TRACK_WIDTH / gray.shape[1]
            small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            motion.append(0.0 if last is None else median_motion(last, small))  # type: ignore[arg-type]
            last = small
            advance(1)
    capture.release()
    if not motion:
        raise InputError(f"{video} holds no frame that can be read: it is damaged, or its codec is unknown here.")
    if total and len(motion) < 0.9 * total:
        log(f"{video.name} breaks off after {len(motion)} of {total} frames: the rest is left out.", "yellow")
    return motion, sharp


def median_motion(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Median optical flow of corners between two gray images, as a share of the width."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 7)
    if corners is None or len(corners) < 8:
        return LOST
    moved, is_tracked, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(15, 15), maxLevel=3)  # type: ignore[call-overload]
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None, winSize=(15, 15), maxLevel=3)  # type: ignore[call-overload]
    good = (is_tracked & is_back).ravel().astype(bool) & (np.linalg.norm(back - corners, axis=-1).ravel() < 1)
    if good.sum() < 8:
        return LOST
    return float(np.median(np.linalg.norm(moved - corners, axis=-1).ravel()[good])) / before.shape[1]


def choose_frames(
    motion: NDArray[np.float64], sharp: NDArray[np.float64], max_frames: int, step: float
) -> tuple[list[int], float]:
    """The sharpest frame of every stretch of equal motion, by the motion of each frame since the one before, as a share
    of the width [N], and its sharpness [N]; and the length of a stretch: ``step``, or more for ``max_frames`` at most.

    A camera that stands still adds no frame. The first and last stretch count like the others.
    """
    path = np.cumsum(motion)
    used = max(step, float(path[-1]) / max(max_frames - 1, 1) * (1 + 1e-9))
    stretch = np.floor(path / used + 0.5).astype(int)
    chosen = []
    for number in np.unique(stretch):
        frames = np.nonzero(stretch == number)[0]
        # near the middle of its stretch unless another is clearly sharper, to keep the spacing even
        off = np.abs(path[frames] / used - number)
        chosen.append(int(frames[np.argmax(sharp[frames] * (1 - 0.5 * off))]))
    return chosen, used
