"""Poses of test images refined against a trained model, to score it if poses are not exact.

If the training poses were wrong, or were refined, the model does not match the given test poses exactly. So the pose of
each test image is optimised with the frozen model: six numbers for an image, by the colours of the same pixels that are
then scored. This is not a score of view synthesis, and is reported in addition to the plain one, never instead.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.random_draws import generator

STEPS = 80
"""Optimisation steps for each image."""
RAYS = 1024
"""Pixels of each step."""
RATES = (2e-3, 5e-5)
"""Learning rates at the start and at the end: radians, and scene units."""


def refined_camera(model: Any, camera: Cameras, image: Tensor, seed: int) -> tuple[Cameras, float, float]:
    """A camera moved to the pose from which a frozen model renders its image best.

    Args:
        model: ``MMPIModel``, in evaluation.
        camera: one.
        image: [H, W, 3] of it, over the model's background.
        seed: of the draw of pixels.

    Returns:
        The moved camera, its rotation in degrees, and its translation in scene units.

    Raises:
        InputError: the model renders what has no gradients.
    """
    if model.config.rendering.mode == "baked":
        raise InputError(
            "Poses are refined by gradients: use --pipeline.model.rendering.mode exact, or no refine-eval-poses."
        )
    moves: CameraOptimizer = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=1, device=model.device)
    optimizer = torch.optim.Adam(moves.parameters(), lr=RATES[0])
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATES[1] / RATES[0]) ** (1 / STEPS))
    rays = camera.generate_rays(0, keep_shape=True).flatten()
    observed = image.reshape(-1, 3).to(model.device)
    frozen = [p for p in model.parameters() if p.requires_grad]
    try:
        for p in frozen:
            p.requires_grad_(False)
        for step in range(STEPS):
            chosen = torch.randint(len(observed), (RAYS,), generator=generator(seed, step, "eval poses", "cpu"))
            bundle = rays[chosen.to(model.device)]
            bundle.camera_indices = torch.zeros_like(chosen, device=model.device)[:, None]
            with torch.enable_grad():
                moves.apply_to_raybundle(bundle)
                loss = ((model.image_outputs(bundle)["rgb"] - observed[chosen]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()
    finally:
        for p in frozen:
            p.requires_grad_(True)
    moved = copy.deepcopy(camera)
    moved.metadata = {"cam_idx": 0}
    with torch.no_grad():
        moved.camera_to_worlds = moves.apply_to_camera(moved)
    found: dict[str, Any] = {}
    moves.get_metrics_dict(found)
    return moved, float(found["camera_opt_rotation_max"]), float(found["camera_opt_translation_max"])
