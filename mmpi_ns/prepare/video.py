"""Frames of a video, chosen by image motion and sharpness."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mmpi_ns.prepare.checks import sharpness
from mmpi_ns.prepare.images import Photo
from mmpi_ns.utils.errors import InputError, progress, say
from mmpi_ns.utils.files import whole, write_text

TRACK_WIDTH = 320
"""Width at which motion is measured."""
LOST = 0.15
"""Motion, relative to the width, assumed for frames that cannot be tracked from the last (a cut, a blank frame)."""
MOST_MOTION = 0.15
"""Motion between chosen frames beyond which SfM gets difficult."""


def select_frames(video: Path, target: Path, max_frames: int, step: float) -> list[Photo]:
    """Writes the chosen frames of a video to ``target/images``.

    Raises:
        InputError: the video cannot be read, or shows no motion.
    """
    (target / "images").mkdir(parents=True, exist_ok=True)
    log = target / "measured.json"
    if not log.exists():
        write_text(log, json.dumps(measure(video)))
    motion, sharp = np.array(json.loads(log.read_text(encoding="utf-8")))
    chosen, used = choose_frames(motion, sharp, max_frames, step)
    frames = len(motion)
    if len(chosen) < 2:
        raise InputError(f"{video} shows no motion in {frames} frames: there is no second view.")
    say(f"{len(chosen)} of {frames} frames taken: the sharpest for every {used:.1%} of the width of motion.")
    if used > MOST_MOTION:
        remedy = f"raise --max-frames above {max_frames} or cut the video into shorter ones"
        say(f"{used:.0%} of the width between frames is much: {remedy}.", "yellow")
    capture, _ = _open(video)
    photos = []
    with progress("Writing frames", len(chosen)) as advance:
        for index in range(chosen[-1] + 1):
            if not capture.grab():
                raise InputError(f"{video} could be read to frame {index - 1} this time: it changed, or is damaged.")
            if index != chosen[len(photos)]:
                continue
            _, frame = capture.retrieve()
            name = f"frame_{index:06d}.jpg"
            path = target / "images" / name
            if not path.exists():
                is_encoded, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 97])
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

    Raises:
        InputError: the video cannot be read.
    """
    capture, total = _open(video)
    motion, sharp = [], []
    last = None
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
        say(f"{video.name} breaks off after {len(motion)} of {total} frames: the rest is left out.", "yellow")
    return motion, sharp


def _open(video: Path) -> tuple[cv2.VideoCapture, int]:
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise InputError(f"{video} cannot be opened as a video: it is damaged, or its codec is unknown here.")
    return capture, max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


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
    """The sharpest frame of every stretch of equal motion.

    A camera that stands still adds no frame. The first and last stretch count like the others.

    Args:
        motion: since the frame before, as a share of the width. [N]
        sharp: sharpness of every frame. [N]
        max_frames: maximum number of frames; the step is increased if necessary.
        step: motion of a stretch, as a share of the width.

    Returns:
        Indices of the frames, and the step used.
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
