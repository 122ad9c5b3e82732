"""Details for baked scenes of random bricks: of training cameras with several lenses, beside the first of the path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from random_bricks import random_window, scene_of

from mmpi_ns.rendering.details import Details, details_of, write_details
from mmpi_show.details import stored_view
from mmpi_show.files import BakedScene

HEIGHT, WIDTH = 36, 52
LENSES = [[0.0] * 6, [0.2, -0.06, 0.02, 0.01, 0.03, -0.02], [0.05, -0.02, 0.0, 0.0, 0.0, 0.0]]
KINDS = [CameraType.PERSPECTIVE, CameraType.PERSPECTIVE, CameraType.FISHEYE]


def opaque_window(seed: int = 0):
    """A window whose first planes hide what is behind them, so that depths are those of planes."""
    return random_window(num_mpis=1, seed=seed, stored=1.0, density=(250, 255))


def training_cameras(scene: BakedScene) -> Cameras:
    pose = torch.tensor(scene.path[0].to_world)
    poses = pose.repeat(3, 1, 1)
    for i, (x, y) in enumerate([(0.03, 0.0), (-0.05, 0.03), (0.02, -0.05)]):
        poses[i, :, 3] += x * pose[:, 0] + y * pose[:, 1] + 0.12 * i * pose[:, 2]  # the later ones farther behind
    kinds = torch.tensor([kind.value for kind in KINDS])
    return Cameras(poses, 38.0, 41.0, 25.5, 18.5, WIDTH, HEIGHT, torch.tensor(LENSES), camera_type=kinds)


def details_for(scene: BakedScene, folder: Path) -> Details:
    """Smooth differences of three training images at the scene's surfaces; the left of the second one is masked."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / 3.0

    def image_of(i):
        waves = np.stack([np.sin(x + i), np.cos(y + 2 * i), np.sin(x + y)], -1)
        usable = np.ones((HEIGHT, WIDTH), np.uint8)
        usable[:, : WIDTH // 3] = i != 1
        return (127.5 + 70 * waves).astype(np.uint8), usable

    def outputs_of(bundle):
        depth = scene.render(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))["depth"]
        return {"rgb": torch.full((HEIGHT, WIDTH, 3), 0.5), "depth": depth.view(HEIGHT, WIDTH, 1)}

    write_details(folder, 0, training_cameras(scene), torch.zeros(0, 3), image_of, outputs_of)
    details = details_of(folder, 0)
    assert details is not None
    return details


def with_details(scene: BakedScene, folder: Path, nearest: int = 3) -> BakedScene:
    details = details_for(scene, folder)
    views = tuple(stored_view(details.view(i, torch.device("cpu"))) for i in range(3))
    return replace(scene, views=views, nearest=nearest)


def detailed_scene(folder: Path, nearest: int = 3) -> BakedScene:
    return with_details(scene_of(opaque_window()), folder, nearest)
