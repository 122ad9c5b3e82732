"""The registered methods (paper settings: sec. IV; ours: docs/results)."""

from __future__ import annotations

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from mmpi_ns.mmpi_datamanager import MMPIDataManagerConfig
from mmpi_ns.mmpi_model import MMPIModelConfig
from mmpi_ns.mmpi_trainer import MMPITrainerConfig, PhaseSchedulerConfig
from mmpi_ns.touched_adam import TouchedAdamConfig


def _optimizers() -> dict:
    rates = {"density": 0.1, "features": 0.1, "colour": 1e-3, "reliability": 0.1}
    return {
        kind: {"optimizer": TouchedAdamConfig(lr=lr), "scheduler": PhaseSchedulerConfig(kind=kind)}
        for kind, lr in rates.items()
    }


def _method(name: str, description: str, steps: int, rays: int, model: MMPIModelConfig) -> MethodSpecification:
    config = MMPITrainerConfig(
        method_name=name,
        max_num_iterations=steps,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        steps_per_save=max(500, steps // 4),
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        pipeline=VanillaPipelineConfig(
            datamanager=MMPIDataManagerConfig(dataparser=NerfstudioDataParserConfig(), train_num_rays_per_batch=rays),
            model=model,
        ),
        optimizers=_optimizers(),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 14, quit_on_train_completion=True),
        vis="tensorboard",
    )
    return MethodSpecification(config=config, description=description)


mmpi = _method("mmpi", "MMPI: several multi-plane images, blended by reliability.", 20000, 4096, MMPIModelConfig())
mmpi_small = _method("mmpi-small", "MMPI for a two-core CPU.", 4000, 1024, MMPIModelConfig(hidden_width=32))
mmpi_kitti = _method("mmpi-kitti", "MMPI with the paper's KITTI settings.", 40000, 4096, MMPIModelConfig())
mmpi_scannet = _method("mmpi-scannet", "MMPI with the paper's ScanNet settings.", 30000, 4096, MMPIModelConfig())
mmpi_scannet_short = _method(
    "mmpi-scannet-short", "MMPI with the paper's short ScanNet schedule.", 10000, 4096, MMPIModelConfig()
)
