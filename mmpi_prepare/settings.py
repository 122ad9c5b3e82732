"""The options of mmpi-prepare."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mmpi_ns.utils.errors import InputError, looked_at
from mmpi_ns.utils.values import Number, check_options
from mmpi_prepare.features import Matching
from mmpi_prepare.poses import GIVEN_COUNTS, Lens, Sharing


@dataclass(frozen=True)
class Settings:
    """Makes a scene for ns-train from a folder of images or a video, by structure from motion or from given poses.

    An interrupted run continues when it is started again with the same options.
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
    """Folder of images or panoramas, or a video."""
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder for the scene."""
    masks: Path | None = None
    """Folder of masks named like the images; black pixels are excluded from SfM and training."""
    moving: Literal["mask", "keep"] = "mask"
    """Treatment of moving objects in the training images, unless --masks are given: mask them in training, or not."""
    depths: Path | None = None
    """Folder of depth images of an RGB-D camera, one for each image, named alike (or by time, as TUM's) and registered
    to it: 16-bit PNG in millimetres, or .npy in metres. They give the scale, unless --poses or --camera-height do."""
    poses: Path | None = None
    """Given poses: a KITTI or TUM file, a transforms.json, or a folder of 4x4 text files."""
    poses_axes: Literal["auto", "opencv", "opengl"] = "auto"
    """Camera axes of --poses (camera to world). auto: opengl for transforms.json and opencv for the others, or what the
    matches show."""
    refine_poses: bool = False
    """Refine given poses by bundle adjustment; frame and scale are kept."""
    focal: float | None = None
    """Focal length in pixels of the input images; kept fixed unless --refine-intrinsics."""
    camera: tuple[float, ...] | None = None
    """f cx cy | fx fy cx cy | fx fy cx cy k1 k2 p1 p2 in pixels of the input; kept fixed unless --refine-intrinsics."""
    lens: Lens = "auto"
    """Distortion to fit, with --focal only by --refine-intrinsics; --camera has its own (k1 to k4 with fisheye). auto:
    none with --focal; else one radial term, or OpenCV's four if better."""
    intrinsics: Sharing = "auto"
    """auto: images with the same size, EXIF body and lens share a camera."""
    refine_intrinsics: bool = False
    """Refine given intrinsics."""
    matching: Matching = "auto"
    """auto: all pairs of few images; neighbours and revisits of a sequence; similar images of many."""
    overlap: int = 10
    """Frames before and after that each frame of a sequence is matched with."""
    max_features: int = 4096
    """Maximum SIFT features of an image; small images get one for every hundred pixels, or 2,048."""
    camera_height: float | None = None
    """Camera height above the ground in metres: sets the scale, and the up direction by the normal of the ground."""
    test_every: int | None = None
    """Every n-th image is a test image (default 8); 0: all are used for training and testing."""
    downscales: tuple[int, ...] = (2, 4)
    """Downscale factors of the copies."""
    max_frames: int = 300
    """Maximum number of frames from a video."""
    frame_motion: float = 0.01
    """Median motion between frames taken from a video, relative to the image width."""
    allow_partial: bool = False
    """Make a scene even if less than half of the images are registered."""
    allow_doubtful: bool = False
    """Make a scene even if the evidence shows that its track is wrong."""
    overwrite: bool = False
    """Replace the contents of the scene folder; the old files are moved to a folder beside the new ones."""
    keep_work: bool = False
    """Keep the features, matches and models in SCENE/.prepare."""
    threads: Annotated[int, tyro.conf.arg(metavar="N")] = -1
    """CPU threads; -1 for all cores."""


RANGES = {
    **dict.fromkeys(("focal", "camera_height", "frame_motion"), Number(0, above=True)),
    **dict.fromkeys(("overlap", "max_features"), Number(1, whole=True)),
    **dict.fromkeys(("max_frames", "downscales"), Number(2, whole=True)),
    "camera": Number(),
}


def check(s: Settings) -> None:
    """Raises InputError if an option is out of range, contradicts another or names no file."""
    check_options(s, {name: number for name, number in RANGES.items() if getattr(s, name) is not None}, "--")
    kinds = " or ".join(GIVEN_COUNTS.values())
    camera = (1.0,) * 4 if s.camera is None else s.camera
    focals = camera[: 1 if len(camera) == 3 else 2]
    is_kept = s.camera is not None or (s.focal is not None and not s.refine_intrinsics)
    faults = {
        f"--camera takes {kinds}, not {len(camera)} numbers.": len(camera) not in GIVEN_COUNTS,
        "--camera: focal lengths must be positive, in pixels.": min(focals, default=1) <= 0,
        "--focal and --camera both give a focal length: leave one out.": None not in (s.focal, s.camera),
        f"--lens {s.lens} is not fitted to a given camera: give --camera with its terms, or --focal and "
        "--refine-intrinsics.": is_kept and s.lens in ("radial", "opencv") and len(camera) < 8,
        f"--test-every takes 2 or more, not {s.test_every}; or 0: all images train and test.": (s.test_every or 2) < 2,
        f"--downscales takes different numbers, not {s.downscales}.": len(set(s.downscales)) < len(s.downscales),
        f"--threads takes a number of threads, or -1 for all cores, not {s.threads}.": s.threads < 1
        and s.threads != -1,
        "--refine-poses refines known poses: give them with --poses.": s.refine_poses and s.poses is None,
        f"--poses {s.poses} does not exist.": s.poses is not None and not s.poses.exists(),
        f"--masks {s.masks} is no folder.": s.masks is not None and not s.masks.is_dir(),
        f"--depths {s.depths} is no folder.": s.depths is not None and not s.depths.is_dir(),
        f"There is no {looked_at(s.input)}: check the path.": not s.input.exists(),
        f"{s.scene} is a file: name a folder for the scene.": s.scene.is_file(),
    }
    for summary in (summary for summary, is_wrong in faults.items() if is_wrong):
        raise InputError(summary)
