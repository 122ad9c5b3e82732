"""The registered methods (paper settings: sec. IV; ours: docs/results)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from mmpi_ns.data.datamanager import MMPIDataManagerConfig
from mmpi_ns.placement.defaults import PLACEMENT, RAYS
from mmpi_ns.settings import (
    ColourConfig,
    LossWeights,
    MMPIModelConfig,
    MMPIPipelineConfig,
    MMPITrainerConfig,
    PlacementConfig,
    RenderingConfig,
    ScheduleConfig,
    TouchedAdamConfig,
)
from mmpi_priors.settings import CapturePriorsConfig

PAPER_DATA = {
    "keypoint_rays": 0,
    "new_view_share": 0.0,
    "pixel_jitter": 0.0,
    "priors": CapturePriorsConfig(dense_depth=False, depth_images=False, mask_moving=False, correct_exposure=False),
}
"""The paper trains on the colours of pixels alone; point clouds are not read either."""
PAPER_SCHEDULE = ScheduleConfig(decay_from=0.0, decay_decades=1.5, release_weight=0.0)
"""The paper's rates fall from the start, as DVGO's, and no bricks are released."""
POSE_RATE = 1e-4
"""Learning rate of refined poses, radians and scene units: a tenth of nerfacto's (docs/ablations.md)."""


def _method(
    name: str, description: str, *, steps: int, rays: int, model: MMPIModelConfig, paper: bool = False
) -> MethodSpecification:
    rates = {"density": 0.1, "features": 0.1, "colour": 1e-3 if paper else 3e-3, "reliability": 0.1}
    optimizers: dict = {kind: TouchedAdamConfig(lr=lr) for kind, lr in rates.items()}
    optimizers["camera_opt"] = AdamOptimizerConfig(lr=POSE_RATE, eps=1e-15)
    if paper:  # from DVGO: total variation and nine features; and a network evaluated for every sample
        model.loss = LossWeights(tv_density=1e-5, tv_features=1e-6, tv_chroma=0.0)
        model.colour = ColourConfig(shading="sample", feature_channels=9)
    data: dict[str, Any] = PAPER_DATA if paper else {"priors": CapturePriorsConfig()}
    config = MMPITrainerConfig(
        method_name=name,
        max_num_iterations=steps,
        machine=MachineConfig(seed=0, device_type="cuda" if torch.cuda.is_available() else "cpu"),
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        logging=LoggingConfig(profiler="none"),
        pipeline=MMPIPipelineConfig(
            datamanager=MMPIDataManagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=not paper),
                train_num_rays_per_batch=rays,
                **data,
            ),
            model=model,
        ),
        optimizers={k: {"optimizer": x, "scheduler": None} for k, x in optimizers.items()},
        viewer=ViewerConfig(websocket_host="127.0.0.1", num_rays_per_chunk=1 << 14, quit_on_train_completion=True),
        vis="viewer+tensorboard",
    )
    return MethodSpecification(config=config, description=description)


mmpi, mmpi_small = (
    _method(name, text, steps=0, rays=RAYS, model=MMPIModelConfig(placement=PLACEMENT))
    for name, text in (
        ("mmpi", "MMPI: several multi-plane images, placed among the training cameras; minutes on a CPU."),
        ("mmpi-small", "Another name of mmpi."),
    )
)
mmpi_kitti = _method(
    "mmpi-kitti",
    "MMPI with the paper's KITTI settings: front, left, right, below; each alone, then reliability.",
    steps=40000,
    rays=4096,
    paper=True,
    model=MMPIModelConfig(
        placement=PlacementConfig(arrangement="drive", window_length=0.0, planes=256, height=270, width=270),
        rendering=RenderingConfig(nearest_images=0),
        schedule=replace(
            PAPER_SCHEDULE, training="two-phase", rays_per_mpi="split", blend_share=0.25, finetune_share=0.0
        ),
    ),
)


mmpi_scannet, mmpi_scannet_short = (
    _method(
        name,
        f"MMPI with the paper's ScanNet settings{what}.",
        steps=steps,
        rays=4096,
        paper=True,
        model=MMPIModelConfig(
            placement=PlacementConfig(
                arrangement="room", window_length=0.0, planes=128, height=192, width=192, cube_voxels=160
            ),
            rendering=RenderingConfig(nearest_images=0),
            schedule=replace(PAPER_SCHEDULE, training="joint"),
        ),
    )
    for name, what, steps in (
        ("mmpi-scannet", ": five MPIs and a cube, all together", 30000),
        ("mmpi-scannet-short", " and a third of the steps", 10000),
    )
)
