"""A flight along the capture's path: rendering, depth and winning MPI below each other."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.camera_utils import quaternion_from_matrix, quaternion_matrix, quaternion_slerp
from nerfstudio.cameras.cameras import Cameras
from painting import depth_colors, image_of, write
from PIL import Image, ImageDraw
from views import Run, View, render_view

SWAY, TURN = 0.015, 0.12
"""How far the path leaves the cameras' own to either side (share of its extent) and how far it looks round (radians):
a film along the training path alone would show less than the model knows."""
ENCODERS = ("libx264", "mpeg4")
STRIP = 640
"""Width of the film, pixels."""


def fly_path(cameras: Cameras, frames: int) -> Cameras:
    """Cameras along the path of some cameras in their order, swaying to the sides."""
    poses = cameras.camera_to_worlds.cpu().numpy().astype(np.float64)
    extent = float(np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)))
    found = []
    for share in np.linspace(0, 1, frames):
        place = share * (len(poses) - 1)
        k = min(int(place), len(poses) - 2) if len(poses) > 1 else 0
        pose = _between(poses[k], poses[min(k + 1, len(poses) - 1)], place - k)
        wave = np.sin(4 * np.pi * share)
        pose[:, 3] += SWAY * extent * wave * pose[:, 0]
        sine, cosine = np.sin(TURN * wave), np.cos(TURN * wave)
        # About the camera's own up, so that it looks back to the middle of the path.
        pose[:, :3] = pose[:, :3] @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        found.append(pose)
    first = cameras[0:1]
    return Cameras(
        torch.from_numpy(np.stack(found)).float(), first.fx, first.fy, first.cx, first.cy, first.width, first.height
    )


def film_frames(
    run: Run, frames: int, nearest: float, progress: Callable[[Iterable[int]], Iterable[int]] = iter
) -> Iterator[Image.Image]:
    """Renders the film, frame by frame.

    Args:
        run: the model and the cameras to fly past.
        frames: how many.
        nearest: distance drawn brightest, in units of the capture.
        progress: wraps the frame numbers.
    """
    path = fly_path(run.tests.cameras, frames)
    colors = np.asarray(run.colors, np.float32)
    for i in progress(range(frames)):
        yield _frame(render_view(run, path[i : i + 1]), colors, nearest)


def write_film(images: Iterable[Image.Image], folder: Path, rate: int = 12) -> Path:
    """Writes fly.mp4 or, without an encoder, a folder fly/ of PNG frames; returns its path."""
    target, frames = folder / "fly.mp4", folder / "fly"
    shutil.rmtree(frames, ignore_errors=True)
    encoder = find_encoder()
    if encoder is None:
        frames.mkdir()
        for i, image in enumerate(images):
            image.save(frames / f"{i:04d}.png")
        return frames
    _encode(images, target, encoder, rate)
    return target


def find_encoder() -> str | None:
    """An encoder of PyAV, which nerfstudio brings; None where it has none."""
    try:
        import av
    except ImportError:
        return None
    return next((name for name in ENCODERS if name in av.codecs_available), None)


def _encode(images: Iterable[Image.Image], target: Path, encoder: str, rate: int) -> None:
    import av

    unfinished = target.with_name("unfinished.mp4")
    with av.open(str(unfinished), "w") as container:
        stream = container.add_stream(encoder, rate=rate)
        for i, image in enumerate(images):
            # Encoders want even sides.
            image = image.crop((0, 0, image.width // 2 * 2, image.height // 2 * 2))
            if i == 0:
                stream.width, stream.height, stream.pix_fmt = image.width, image.height, "yuv420p"  # type: ignore
                stream.bit_rate = 2_000_000  # type: ignore
            container.mux(stream.encode(av.VideoFrame.from_image(image)))  # type: ignore
        container.mux(stream.encode(None))  # type: ignore
    unfinished.replace(target)


def _frame(view: View, colors: np.ndarray, nearest: float) -> Image.Image:
    strips = [
        ("rendering", image_of(view.color, STRIP)),
        ("depth (near is bright)", image_of(depth_colors(view.inverse_depth, nearest), STRIP)),
        ("winning MPI", image_of(colors[view.winner], STRIP)),
    ]
    frame = Image.new("RGB", (STRIP, sum(image.height for _, image in strips)))
    y = 0
    for text, image in strips:
        frame.paste(image, (0, y))
        draw = ImageDraw.Draw(frame)
        for dx, dy, fill in ((1, 1, (0, 0, 0)), (0, 0, (255, 255, 255))):
            write(draw, (8 + dx, y + 6 + dy), text, 15, bold=True, fill=fill)
        y += image.height
    return frame


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """A pose [3, 4] between two, at a share in [0, 1] of the way."""
    turns = (quaternion_from_matrix(a[:, :3]), quaternion_from_matrix(b[:, :3]))
    rotation = quaternion_matrix(quaternion_slerp(*turns, share))[:3, :3]
    return np.concatenate([rotation, (1 - share) * a[:, 3:] + share * b[:, 3:]], 1)
