"""Settings of the priors of a capture, quick to import: ``maker`` is imported only when a capture is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mmpi_ns.data.priors import PriorsConfig
from mmpi_ns.settings import Later


@dataclass
class CapturePriorsConfig(PriorsConfig):
    """Priors that are computed for a capture: ``--pipeline.datamanager.priors.*``."""

    _target: Callable[..., Any] = field(default_factory=lambda: Later("mmpi_priors.maker", "CapturePriors"))
    sfm_path: Path = Path("colmap/sparse/0")
    """COLMAP model with the tracks, relative to the data, in the frame of transforms.json (colmap parser: its own)."""
    triangulate: bool = True
    """Scenes without tracks: match and triangulate the training images' features at the start (a second or so each)."""
    trust_cameras: bool = False
    """Train even if the cameras contradict the images (checked in scenes without tracks)."""
    dense_depth: bool = True
    """Match the originals of neighbouring training images densely at the start, for the depth of most pixels (about a
    second for a million pixels on one core, on all cores; kept in ~/.cache/mmpi_ns for the next start)."""
    depth_images: bool = True
    """Use the depth images that a data parser lists (depth_file_path)."""
    mask_moving: bool = True
    """Mask moving objects (cars, people) in the training images that have no mask: their pixels are not trained on."""
    correct_exposure: bool = True
    """Calibrate exposure and white balance of the images by surfaces that several of them see and by EXIF, and compute
    the colour loss at each image's exposure, if that explains their differences."""
