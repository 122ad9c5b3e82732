"""Checks of what a user gives, before nerfstudio reads it, whose own errors name neither frame nor remedy.

The sentences are listed in docs/errors.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mmpi_ns.utils.messages import brief

SAME_PLACE = 1e-6
"""Cameras nearer to each other than this share of their distance from the origin stand in one place."""


def check_transforms(data: Path, *, auto_scale: bool, opens_first_image: bool) -> None:
    """Reads the frames of a capture and their poses.

    Args:
        data: folder with a transforms.json, or a file of that kind.
        auto_scale: the data parser divides by the extent of the cameras, which one place does not have.
        opens_first_image: the data parser takes its downscale factor from the size of the first image.

    Raises:
        ValueError: one sentence with the file, the frame where there is one, and what to do.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    frames = _frames(path)
    centers = np.stack([_pose(frame, i, path)[:3, 3] for i, frame in enumerate(frames)])
    if opens_first_image:
        _check_image(path.parent / frames[0]["file_path"])
    if auto_scale and in_one_place(centers):
        raise ValueError(
            f"All {len(centers)} camera(s) of {path} stand in one place, so no distance can be learned: give images "
            "from two places, or learn colours alone (nerfstudio-data --auto-scale-poses False --eval-mode all)."
        )


def in_one_place(centers: NDArray[np.float64]) -> bool:
    """Whether camera centres [M, 3] are the same but for rounding."""
    return float(np.ptp(centers, axis=0).max()) <= SAME_PLACE * max(1.0, float(np.abs(centers).max()))


def _frames(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        raise ValueError(
            f"There is no {path}: check --data, make one with mmpi-prepare, or name the data parser of another "
            "format after the options (for example: ns-train mmpi-small --data FOLDER colmap)."
        )
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as JSON ({brief(error)}): repair it or make it again.") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise ValueError(f"{path} lists no frames: it needs 'frames', each with file_path and transform_matrix.")
    return frames


def _pose(frame: dict[str, Any], index: int, path: Path) -> NDArray[np.float64]:
    name = frame.get("file_path", f"number {index + 1}")
    if "file_path" not in frame or "transform_matrix" not in frame:
        missing = "file_path" if "file_path" not in frame else "transform_matrix"
        raise ValueError(f"Frame {name} of {path} has no {missing}: add it or remove the frame.")
    try:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(
            f"The transform_matrix of frame {name} of {path} is not a 4 x 4 matrix of finite numbers: correct it or "
            "remove the frame."
        )
    return pose


def _check_image(path: Path) -> None:
    try:
        with Image.open(path):
            pass
    except OSError as error:
        raise ValueError(f"Image {path} cannot be read ({brief(error)}): repair it or remove its frame.") from error
