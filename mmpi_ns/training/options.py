"""Options of a run, checked before anything is written; those of a config.yml, before they are used."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields, is_dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig

from mmpi_ns.placement.defaults import DEFAULTS, NOT_NEGATIVE, POSITIVE, check_placement
from mmpi_ns.training.losses import LossWeights
from mmpi_ns.training.phases import check_schedule
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.files import make_writable
from mmpi_ns.utils.host import arguments, command, values_of
from mmpi_ns.utils.machine import unused_gpu
from mmpi_ns.utils.values import Number, check_number, check_options, shown

COUNT, SHARE = Number(0, whole=True), Number(0, 1)
RENDERED = {
    "--interpolation-steps": Number(1, whole=True),
    "--frame-rate": Number(1, whole=True),
    "--seconds": POSITIVE,
    "--downscale-factor": POSITIVE,
    "--eval-num-rays-per-chunk": Number(1, whole=True),
}
"""Options of ns-render."""
LONGEST_NAME = 255
"""Bytes of a folder's name."""
RANGES = {
    "": {
        "max_num_iterations": Number(0, 10**9, whole=True),
        "steps_per_save": COUNT,
        "steps_per_eval_batch": COUNT,
        "steps_per_eval_image": COUNT,
        "steps_per_eval_all_images": COUNT,
    },
    "machine": {"seed": Number(0, 2**32 - 1, whole=True), "num_devices": Number(1, 10**4, whole=True)},
    "logging": {"steps_per_log": Number(1, whole=True)},
    "pipeline.datamanager": {
        "train_num_rays_per_batch": Number(1, 10**8, whole=True),
        "eval_num_rays_per_batch": Number(1, 10**8, whole=True),
        "keypoint_rays": Number(0, 10**8, whole=True),
        "new_view_share": NOT_NEGATIVE,
        "resident_pixels": NOT_NEGATIVE,
        "camera_res_scale_factor": POSITIVE,
    },
    "pipeline.model": {"eval_num_rays_per_chunk": COUNT},
    "pipeline.model.schedule": {
        "blend_share": SHARE,
        "finetune_share": SHARE,
        "decay_decades": NOT_NEGATIVE,
        "decay_from": SHARE,
        "growth_shares": SHARE,
        "release_shares": SHARE,
        "release_weight": NOT_NEGATIVE,
    },
    "pipeline.model.sampling": {
        "cube_alpha": Number(0, 1, above=True),
        "threshold": SHARE,
    },
    "pipeline.model.colour": {
        "feature_channels": Number(3, 256, whole=True),
        "hidden_width": Number(1, 4096, whole=True),
    },
    "pipeline.model.rendering": {"threshold": SHARE, "resident_gib": NOT_NEGATIVE, "nearest_images": COUNT},
    "pipeline.model.loss": {f.name: NOT_NEGATIVE for f in fields(LossWeights)},
}
"""Values of the options that a run can use, by the options' group."""
NO_EFFECT = {
    "pipeline.datamanager": (
        "train_num_images_to_sample_from",
        "train_num_times_to_repeat_images",
        "eval_num_images_to_sample_from",
        "eval_num_times_to_repeat_images",
        "eval_image_indices",
        "patch_size",
        "pixel_sampler",
        "images_on_gpu",
        "masks_on_gpu",
    ),
    "pipeline.model": ("enable_collider", "collider_params", "loss_coefficients", "prompt"),
}
"""nerfstudio's options that have no effect on this method."""
TRAINED = {"growing_rays", "texel_cost", "tv_every"}
"""Options that this version lacks and that changed the training alone."""


def check_nothing_left(model: Any) -> None:
    """Raises InputError naming an option of a loaded config that this version lacks and that changes the images."""
    groups = {"": model} | {f"{name}.": group for name, group in vars(model).items() if is_dataclass(group)}
    for prefix, group in groups.items():
        for name in vars(group).keys() - {f.name for f in fields(group)} - TRAINED:
            option = f"--pipeline.model.{prefix}{name}".replace("_", "-")
            raise InputError(
                f"The run's config.yml asks for {option} {shown(getattr(group, name))}, which this version lacks: "
                "use the version that trained the run, or train anew without it."
            )


def check_command() -> None:
    """Raises InputError if ns-eval or ns-render would end in an error after it has loaded the run."""
    if command() == "ns-render":
        check_rendering()
    for output in values_of("--output-path") if command() == "ns-eval" else ():
        if Path(output).suffix != ".json":
            raise InputError(f"--output-path {output} is no .json file: give the name of one, eval.json for example.")
        make_writable(Path(output).parent, "--output-path")


def check_rendering() -> None:
    """Raises InputError if ns-render would end in an error after it has loaded the run, or rendered."""
    is_dataset = "dataset" in arguments()
    if not is_dataset and shutil.which("ffmpeg") is None:
        raise InputError(
            "ns-render needs ffmpeg, for images too, and it is not installed: install it (apt or conda install ffmpeg)."
        )
    for option, number in RENDERED.items():
        for word in values_of(option):
            if word != "None":
                check_number(option, int(word) if word.lstrip("-").isdigit() else float(word), number)
    names, keeps_alpha = values_of("--rendered-output-names"), values_of("--image-format") == ["png"]
    if is_dataset and "rgba" in names and not keeps_alpha:
        raise InputError("The output rgba is transparent, which JPEG is not: add --image-format png.")
    writes_images = is_dataset or values_of("--output-format") == ["images"]
    keeps_alpha = keeps_alpha and names == ["rgba"] and writes_images
    if not is_dataset and "rgba" in names and not keeps_alpha:
        raise InputError(
            "The output rgba is transparent, which videos, JPEG and the outputs beside it are not: ask for it alone, "
            "with --output-format images --image-format png."
        )
    for output in values_of("--output-path"):
        if not (writes_images or Path(output).suffix):
            raise InputError(
                f"--output-path {output} says no format of a film: give a name that ends in .mp4, or add "
                "--output-format images."
            )
        make_writable(Path(output) if writes_images else Path(output).parent, "--output-path")
    if "camera-path" not in arguments():
        return
    file = Path(next(iter(values_of("--camera-path-filename")), "camera_path.json"))
    try:
        path = json.loads(file.read_text(encoding="utf-8"))
        size, cameras = [path["render_width"], path["render_height"], path["seconds"]], path["camera_path"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"The camera path {file} cannot be read ({brief(error)}): save it in the viewer, in the tab Render."
        ) from error
    if not cameras:
        raise InputError(f"The camera path {file} holds no camera: add some in the viewer's tab Render, and save it.")
    for name, value in zip(("render_width", "render_height", "seconds"), size, strict=True):
        check_number(f"The {name} of {file}", value, POSITIVE)


def check_run(config: TrainerConfig) -> None:
    """Raises InputError naming the option that cannot be used, or that would be ignored."""
    model: Any = config.pipeline.model
    for group, ranges in RANGES.items():
        check_options(attrgetter(group)(config) if group else config, ranges, f"--{group}." if group else "--")
    if config.max_num_iterations == 0 and config.method_name not in DEFAULTS:
        raise InputError(f"{config.method_name} has no number of steps of its own: give --max-num-iterations.")
    check_schedule(model.schedule)
    check_placement(model.placement, "--pipeline.model.placement.")
    for name, entry in config.optimizers.items():
        check_number(f"--optimizers.{name}.optimizer.lr", entry["optimizer"].lr, NOT_NEGATIVE)
    for path, names in NO_EFFECT.items():
        settings = attrgetter(path)(config)
        usual = type(settings)()
        for name in names:
            if getattr(settings, name) != getattr(usual, name):
                option = f"--{path}.{name}".replace("_", "-")
                raise InputError(f"{option} has no effect on this method: leave it out.")
    for name in ("experiment_name", "timestamp"):
        value = str(getattr(config, name))
        if any(len(part.encode()) > LONGEST_NAME for part in Path(value).parts):
            raise InputError(
                f"--{name.replace('_', '-')} is too long for a folder's name: give one of at most {LONGEST_NAME} bytes."
            )
    if config.load_step is not None and config.load_dir is None:
        raise InputError("--load-step says nothing without --load-dir: give the folder of the checkpoint too.")
    if config.machine.device_type == "cpu" and (config.mixed_precision or config.use_grad_scaler):
        raise InputError("--mixed-precision and --use-grad-scaler have no effect on a CPU: leave them out.")
    if config.machine.device_type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--machine.device-type cuda asks for a GPU, and torch sees none: "
            f"{unused_gpu() or 'check the driver and the build of torch'}; --machine.device-type cpu trains without."
        )
    processes = config.machine.num_devices
    if processes > max(1, torch.cuda.device_count()):
        raise InputError(
            f"--machine.num-devices {processes} asks for as many GPUs and torch sees {torch.cuda.device_count()}: give "
            f"fewer, or train on CPUs with torchrun --nproc-per-node {processes} -m mmpi_ns.scripts.train."
        )
    if config.machine.device_type == "mps":
        raise InputError("--machine.device-type mps has no compiled operations: use cpu.")
