"""Reads a COLMAP model: points, and which image saw which point at which pixel."""

from __future__ import annotations

import signal
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import current_thread, main_thread
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mmpi_ns.capture.sfm_files import check_model_files
from mmpi_ns.utils.errors import InputError, brief

if TYPE_CHECKING:
    import pycolmap

OLDEST_PYCOLMAP = 4
"""First major version with the functions that this package calls."""
MIN_TRACK = 3
"""Points seen by fewer images are too uncertain to supervise depth."""
MAX_ERROR_PX = 2.0
"""Points with a larger mean reprojection error are left out."""


@dataclass(frozen=True)
class SfmModel:
    """Sparse points and their keypoints."""

    points: NDArray[np.float64]
    """[P, 3] in the model's frame."""
    names: tuple[str, ...]
    """Image file names."""
    keypoints: tuple[tuple[NDArray[np.int64], NDArray[np.float64]], ...]
    """For each image: point of each keypoint [Q], and its position relative to width and height [Q, 2]."""
    off: float | None = None
    """Median distance of the matches from the epipolar lines of given poses, relative to the width of the image; None
    for a model read from files."""

    def keypoints_of(
        self, image_names: Sequence[str]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """(index into ``image_names``, point, relative position) of the keypoints of these images only."""
        by_name = dict(zip(self.names, self.keypoints, strict=True))
        rows = [(i, *by_name[name]) for i, name in enumerate(image_names) if name in by_name]
        if not rows:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
        cameras = np.concatenate([np.full(len(points), i, np.int64) for i, points, _ in rows])
        return cameras, np.concatenate([points for _, points, _ in rows]), np.concatenate([xy for *_, xy in rows])


def find_sfm_model(path: Path) -> SfmModel | None:
    """The COLMAP model in a folder; None where there is none.

    Raises:
        InputError: the folder holds a model that cannot be read.
    """
    if not (path / "images.bin").is_file() and not (path / "images.txt").is_file():
        return None
    with model_errors(path):
        check_model_files(path)
        return read_reconstruction(load_pycolmap().Reconstruction(str(path)))


@contextmanager
def model_errors(path: Path) -> Iterator[None]:
    """Turns any error while reading a model into one InputError."""
    try:
        yield
    except (ValueError, RuntimeError, OSError, LookupError, MemoryError, AssertionError, struct.error) as error:
        raise InputError(f"The COLMAP model in {path} cannot be read ({brief(error)}): repair or remove it.") from error


def load_pycolmap() -> ModuleType:
    """pycolmap, which is slow to import, with SIGTERM left as it was.

    It installs glog's handler, which prints a stack trace and may wait for ever, instead of whatever was there.

    Raises:
        InputError: pycolmap is too old.
    """
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if handler is not None and current_thread() is main_thread():
        signal.signal(signal.SIGTERM, handler)
    if int(pycolmap.__version__.split(".")[0]) < OLDEST_PYCOLMAP:
        raise InputError(
            f"pycolmap {pycolmap.__version__} is installed, which lacks rigs and the global mapper: "
            f"pip install 'pycolmap>={OLDEST_PYCOLMAP}'."
        )
    return pycolmap


def read_reconstruction(model: pycolmap.Reconstruction, min_track: int = MIN_TRACK) -> SfmModel:
    """The points of a reconstruction that at least ``min_track`` images see well, and their keypoints."""
    # In the order of the ids: that of the model itself may differ from one reading to the next.
    good = [i for i, p in sorted(model.points3D.items()) if p.track.length() >= min_track and p.error <= MAX_ERROR_PX]
    row = {point: n for n, point in enumerate(good)}
    points = np.array([model.points3D[i].xyz for i in good], dtype=np.float64).reshape(-1, 3)
    names, keypoints = [], []
    for _, image in sorted(model.images.items()):
        camera = model.cameras[image.camera_id]
        seen = [(row[p.point3D_id], *p.xy) for p in image.points2D if p.has_point3D() and p.point3D_id in row]
        table = np.array(seen, dtype=np.float64).reshape(-1, 3)
        names.append(Path(image.name).name)
        keypoints.append((table[:, 0].astype(np.int64), table[:, 1:] / [camera.width, camera.height]))
    return SfmModel(points, tuple(names), tuple(keypoints))
