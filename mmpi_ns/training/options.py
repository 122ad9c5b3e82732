"""Checks of a run's options before anything is written, and of those of a config.yml before they are used."""

from __future__ import annotations

import copy
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig

from mmpi_ns.placement.defaults import NOT_NEGATIVE, POSITIVE, check_placement
from mmpi_ns.settings import LossWeights, MMPITrainerConfig
from mmpi_ns.training.checkpoints import WINDOWS_FOLDER, checkpoint_to_load, claim
from mmpi_ns.training.phases import check_schedule
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.machine import unused_gpu
from mmpi_ns.utils.values import Number, check_options

COUNT, SHARE = Number(0, whole=True), Number(0, 1)
RANGES = {
    "": {"max_num_iterations": Number(0, 10**9, whole=True)},
    "machine": {"seed": Number(0, 2**32 - 1, whole=True)},
    "pipeline.datamanager": {
        "train_num_rays_per_batch": Number(1, 10**8, whole=True),
        "keypoint_rays": COUNT,
        **dict.fromkeys(("new_view_share", "pixel_jitter", "resident_pixels"), NOT_NEGATIVE),
        "camera_res_scale_factor": POSITIVE,
    },
    "pipeline.model": {"eval_num_rays_per_chunk": COUNT, "size": POSITIVE},
    "pipeline.model.schedule": {
        **dict.fromkeys(("blend_share", "finetune_share", "decay_from", "growth_shares", "release_shares"), SHARE),
        **dict.fromkeys(("decay_decades", "release_weight"), NOT_NEGATIVE),
    },
    "pipeline.model.sampling": {"cube_alpha": Number(0, 1, above=True), "threshold": SHARE},
    "pipeline.model.colour": {
        "feature_channels": Number(3, 256, whole=True),
        "hidden_width": Number(1, 4096, whole=True),
    },
    "pipeline.model.rendering": {"threshold": SHARE, "resident_gib": NOT_NEGATIVE, "nearest_images": COUNT},
    "pipeline.model.loss": {f.name: NOT_NEGATIVE for f in fields(LossWeights)},
}
"""Values of the options that a run can use, by the options' group."""


def checked(config: MMPITrainerConfig) -> TrainerConfig:
    """Checks the options of a run and makes its folder; the settings for its config.yml.

    They contain absolute paths of the capture and the windows for ns-eval and ns-render, but not the checkpoint that
    this run resumes from, which these must not load.
    """
    check_run(config)
    checkpoint_to_load(config)
    folder = config.get_base_dir()
    claim(folder, config.get_checkpoint_dir(), config.load_checkpoint or config.load_dir)
    written = copy.deepcopy(config)
    written.load_dir = written.load_step = written.load_checkpoint = None
    manager: Any = written.pipeline.datamanager
    for part, name in ((written, "output_dir"), (written, "data"), (manager, "data"), (manager.dataparser, "data")):
        path = getattr(part, name)
        if path not in (None, Path()):
            setattr(part, name, path.absolute())
    written.pipeline.model.windows_folder = (folder / WINDOWS_FOLDER).absolute()  # type: ignore[attr-defined]
    return written


def check_run(config: TrainerConfig) -> None:
    """Raises InputError naming the option that cannot be used."""
    model: Any = config.pipeline.model
    for group, ranges in RANGES.items():
        check_options(attrgetter(group)(config) if group else config, ranges, f"--{group}." if group else "--")
    if config.max_num_iterations == 0 and model.placement.arrangement != "automatic":
        raise InputError(f"{config.method_name} has no number of steps of its own: give --max-num-iterations.")
    check_schedule(model.schedule)
    check_placement(model.placement, "--pipeline.model.placement.")
    if config.load_step is not None and config.load_dir is None:
        raise InputError("--load-step says nothing without --load-dir: give the folder of the checkpoint too.")
    if config.steps_per_eval_batch:
        raise InputError("--steps-per-eval-batch must be 0: --steps-per-eval-image scores whole test images.")
    if config.machine.device_type == "cpu" and (config.mixed_precision or config.use_grad_scaler):
        raise InputError("--mixed-precision and --use-grad-scaler have no effect on a CPU: leave them out.")
    if config.machine.device_type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--machine.device-type cuda asks for a GPU, and torch sees none: "
            f"{unused_gpu() or 'check the driver and the build of torch'}; --machine.device-type cpu trains without."
        )
    if config.machine.num_devices > 1 or config.machine.num_machines > 1:
        raise InputError("A run trains on one device: leave --machine.num-devices and --machine.num-machines at 1.")
    if config.machine.device_type == "mps":
        raise InputError("--machine.device-type mps has no compiled operations: use cpu.")
