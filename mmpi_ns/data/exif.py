"""EXIF of photos: their tags, and those that copies of a photo keep."""

from __future__ import annotations

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


def tags_of(image: Image.Image) -> Image.Exif:
    """All tags of an image; none where they are damaged, which Pillow finds out late in a PNG or WebP file."""
    try:
        return image.getexif()
    except (SyntaxError, ValueError):
        return Image.Exif()


def positive_number(value: Any) -> float | None:
    """A tag's number; None where it is missing, no number, or not positive (0/0 stands for unknown)."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def kept_tags(image: Image.Image) -> Image.Exif:
    """EXIF tags of a photo about camera and exposure, for a rotated, converted or downscaled copy."""
    source, kept = tags_of(image), Image.Exif()
    kept.update({tag: source[tag] for tag in BODY if tag in source})
    shot = source.get_ifd(ExifTags.IFD.Exif)
    if shot:
        kept[ExifTags.IFD.Exif] = {tag: shot[tag] for tag in SHOT if tag in shot}
    return kept
