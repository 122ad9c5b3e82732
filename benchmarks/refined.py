"""Cameras of test images, refined against a trained model that stays as it is."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from mmpi_ns.data.rays import image_rays
from mmpi_ns.rendering.details import moved_cameras
from mmpi_ns.utils.random_draws import generator

STEPS = 80
"""Optimisation steps for each image."""
RAYS = 1024
"""Pixels of each step."""
RATES = (2e-3, 5e-5)
"""Learning rates at the start and at the end: radians, and scene units."""


def refined_camera(pipeline: Any, camera: Cameras, image: Tensor, seed: int) -> tuple[Cameras, float, float]:
    """A camera refined to the pose from which a frozen model renders its image best, at the exposure of the image.

    If the training poses were wrong, or were refined, the model does not match the test poses exactly. The pose is
    optimised by the colours of the same pixels that are then scored, so this is no score of view synthesis.

    Args:
        pipeline: ``MMPIPipeline``, in evaluation.
        camera: one.
        image: [H, W, 3] of it, over the model's background.
        seed: of the draw of pixels.

    Returns:
        The refined camera, its rotation in degrees, and its translation in scene units.
    """
    model, maker, exposure = pipeline.model, pipeline.datamanager.maker, None
    if model.exposures.mean is not None:  # as MMPIPipeline.as_exposed
        exposures, outputs = (model.exposures.factors, model.exposures.falloff), model.get_outputs_for_camera(camera)
        exposure = maker.exposure_of(pipeline.datamanager.observations, *exposures, camera, image, outputs)
    adjustment: CameraOptimizer = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=1, device=model.device)
    optimizer = torch.optim.Adam(adjustment.parameters(), lr=RATES[0])
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATES[1] / RATES[0]) ** (1 / STEPS))
    rays = image_rays(camera).flatten()
    observed = image.reshape(-1, 3).to(model.device)
    frozen = [p.requires_grad_(False) for p in model.parameters() if p.requires_grad]
    try:
        for step in range(STEPS):
            chosen = torch.randint(len(observed), (RAYS,), generator=generator(seed, step, "eval poses", "cpu"))
            bundle = rays[chosen.to(model.device)]
            bundle.camera_indices = torch.zeros_like(chosen, device=model.device)[:, None]
            with torch.enable_grad():
                adjustment.apply_to_raybundle(bundle)
                outputs = model.image_outputs(bundle)
                rgb = outputs["rgb"] if exposure is None else (exposure * outputs["radiance"]).clamp(0, 1)
                loss = ((rgb - observed[chosen]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()
    finally:
        for p in frozen:
            p.requires_grad_(True)
    sizes: dict[str, Any] = {}
    adjustment.get_metrics_dict(sizes)
    return (
        moved_cameras(camera, adjustment),
        float(sizes["camera_opt_rotation_max"]),
        float(sizes["camera_opt_translation_max"]),
    )
