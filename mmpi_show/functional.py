"""Baked scenes as functions: ``load`` one, and ``mmpi_ns.render`` images of it."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import torch

from mmpi_ns.data.rays import image_rays
from mmpi_ns.functional import CameraPath, Scene
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.utils.errors import InputError
from mmpi_show.files import HEADER, read_baked


def load(path: str | Path, device: str | torch.device = "cpu") -> Scene:
    """A scene written by ``mmpi-export bake`` or ``mmpi-export web``. It renders about twice as fast as the exact model
    on a CPU and loses 0.01 dB (docs/export.md).

    Args:
        path: the folder.
        device: where images are moved; they are rendered on the CPU.

    Raises:
        InputError: there is no scene.
        ValueError: its files are damaged; the message names the file and the remedy.
    """
    if not (Path(path) / HEADER).is_file():
        raise InputError(
            f"There is no baked scene at {path}: give a folder that mmpi-export bake or mmpi-export web wrote (with "
            f"{HEADER}). Runs are read by mmpi_ns.load."
        )
    baked = read_baked(Path(path))
    cameras = torch.tensor([[*chain(*pose.to_world), *pose.focal, *pose.center, *pose.size] for pose in baked.path])
    names = WindowedPlan(tuple(place for place, _ in baked.windows)).names
    return Scene(
        names, CameraPath.of(cameras), torch.device(device), lambda camera: baked.image(image_rays(camera.to("cpu")))
    )
