"""Settings of the priors of a capture, light to import: what makes them is imported when a capture is read."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from mmpi_ns.data.priors import PriorsConfig

MAKER = "mmpi_priors.maker", "CapturePriors"
"""Module and class."""


@dataclass
class CapturePriorsConfig(PriorsConfig):
    """Which priors are made of a capture: ``--pipeline.datamanager.priors.*``."""

    sfm_path: Path = Path("colmap/sparse/0")
    """COLMAP model with the tracks, relative to the data, in the frame of transforms.json (colmap parser: its own)."""
    triangulate: bool = True
    """Scenes without tracks: match and triangulate the training images' features at the start (a second or so each)."""
    trust_cameras: bool = False
    """Train even if the cameras contradict the images (looked into in scenes without tracks)."""
    dense_depth: bool = True
    """Match the originals of neighbouring training images densely at the start, for the depth of most pixels (about a
    second for a million pixels on one core, on all cores; kept in ~/.cache/mmpi_ns for the next start)."""
    depth_images: bool = True
    """Use the depth images that a data parser lists (depth_file_path)."""
    mask_moving: bool = True
    """Mask what moves (cars, people) in the training images that have no mask: its pixels are not trained on."""
    correct_exposure: bool = True
    """Calibrate exposure and white balance of the images, by surfaces that several show and by EXIF, and compare each
    image with the scene at its own exposure, if that explains how images differ."""

    def setup(self, **kwargs: Any) -> Any:
        """What makes them (``maker.CapturePriors``)."""
        module, name = MAKER
        return getattr(import_module(module), name)(self, **kwargs)
