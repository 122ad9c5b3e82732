"""EXIF of photos: the exposure that a camera noted, and the tags that copies of a photo keep."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

BODY = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.DateTime)
SHOT = (
    ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.DateTimeOriginal,
    ExifTags.Base.ShutterSpeedValue, ExifTags.Base.ApertureValue, ExifTags.Base.BrightnessValue,
    ExifTags.Base.ExposureBiasValue, ExifTags.Base.FocalLength, ExifTags.Base.WhiteBalance,
    ExifTags.Base.FocalLengthIn35mmFilm,
)  # fmt: skip
"""Tags about body and shot. The others (orientation, sizes, thumbnails, maker notes) are wrong in a changed copy."""


@dataclass(frozen=True)
class Exposure:
    """What the camera chose for one photo: the light recorded grows as time * sensitivity / aperture squared."""

    time: float
    """Seconds."""
    sensitivity: float | None
    """ISO."""
    aperture: float | None
    """Focal length over the diameter of the aperture (f-number)."""


def exposure_of(file: Path) -> Exposure | None:
    """Exposure of an image file by its EXIF; None where it has none, as frames of videos do.

    Raises:
        OSError: the file is no image.

    Source: CIPA DC-008 (Exif 2.32), tags ExposureTime, PhotographicSensitivity and FNumber.
    """
    with Image.open(file) as image:
        tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    time, sensitivity, aperture = (positive_number(tags.get(tag)) for tag in SHOT[:1] + SHOT[2:3] + SHOT[1:2])
    return None if time is None else Exposure(time, sensitivity, aperture)


def light_of(file: Path) -> float:
    """Light that an image got by its EXIF, in arbitrary units; NaN where it is not noted or the file is damaged, which
    is told when its pixels are read."""
    try:
        exposure = exposure_of(file)
    except OSError:
        exposure = None
    if exposure is None:
        return float("nan")
    return exposure.time * (exposure.sensitivity or 100.0) / (exposure.aperture or 1.0) ** 2


def positive_number(value: Any) -> float | None:
    """A tag's number; None where it is missing, no number, or not positive (0/0 stands for unknown)."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def kept_tags(image: Image.Image) -> Image.Exif:
    """The tags of a photo about its body and its shot, for a turned, converted or downscaled copy."""
    source, kept = image.getexif(), Image.Exif()
    for tag in BODY:
        if tag in source:
            kept[tag] = source[tag]
    shot = source.get_ifd(ExifTags.IFD.Exif)
    if shot:
        kept[ExifTags.IFD.Exif] = {tag: shot[tag] for tag in SHOT if tag in shot}
    return kept
