"""Folder of a run: plan and checkpoints, from which only a run of the same capture can resume."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor, nn
from torch.optim import Optimizer

from mmpi_ns.field.tables import in_half_precision
from mmpi_ns.placement.observations import Observations
from mmpi_ns.scene.windows import WindowedPlan, to_text
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.errors import InputError, brief, quoted
from mmpi_ns.utils.files import write_errors
from mmpi_ns.utils.pages import all_zero

HOLDS = {"step", "pipeline", "optimizers", "schedulers", "scalers", "rng", "rays", "capture"}
"""Keys of every checkpoint of this method."""
PLAN_FILE, WINDOWS_FOLDER = "plan.json", "windows"


def checkpoints_in(folder: Path) -> dict[int, Path]:
    """The checkpoints in a folder by their steps."""
    named = ((re.fullmatch(r"step-(\d+)\.ckpt", path.name), path) for path in folder.glob("step-*.ckpt"))
    return {int(name[1]): path for name, path in named if name and path.is_file()}


def claim(folder: Path, checkpoints: Path, resumes_from: Path | None) -> None:
    """Makes a run's folder, and removes files left half-written by killed runs. Raises InputError if its folder of
    ``checkpoints`` holds some and this run does not resume from them, WriteError if it cannot be written."""
    with write_errors(folder, "--output-dir"):
        folder.mkdir(parents=True, exist_ok=True)
    source = None if resumes_from is None else resumes_from.resolve()
    resumes = source is not None and checkpoints.resolve() in (source, source.parent)
    if checkpoints_in(checkpoints) and not resumes:
        raise InputError(
            f"{checkpoints} holds checkpoints of an earlier run: go on from them with --load-dir "
            f"{quoted(checkpoints)}, or give another --timestamp."
        )
    for unfinished in [*folder.glob(".*.tmp"), *folder.glob("windows/.*.tmp")]:
        unfinished.unlink(missing_ok=True)


def last_checkpoint(folder: Path) -> Path:
    """The checkpoint of the latest step in a folder. Raises InputError if there is none."""
    steps = checkpoints_in(folder)
    if not steps:
        raise InputError(
            f"There is no checkpoint in {folder}: it must be the nerfstudio_models folder of a run that trained."
        )
    return steps[max(steps)]


def checkpoint_to_load(config: TrainerConfig) -> Path | None:
    """The checkpoint that a run resumes from; None for a new run. Raises InputError if it is missing."""
    path = config.load_checkpoint
    if path is not None:
        if not path.is_file():
            raise InputError(f"There is no checkpoint at {path}: check --load-checkpoint.")
        return path
    if config.load_dir is None:
        return None
    last, step, steps = last_checkpoint(config.load_dir), config.load_step, checkpoints_in(config.load_dir)
    if step is not None and step not in steps:
        raise InputError(f"There is no step {step} in {config.load_dir}: it holds {sorted(steps)}.")
    return last if step is None else steps[step]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint. Raises InputError if it is damaged."""
    try:
        # Memory-mapped: only what is used is read, but a truncated file is still detected.
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"{path} cannot be read ({brief(error)}): resume from another one with --load-step, or copy it anew."
        ) from error
    is_ours = isinstance(state, dict) and HOLDS <= set(state) and isinstance(state["pipeline"], dict)
    if not is_ours or "_model.progress.windows_bytes" not in state["pipeline"]:
        raise InputError(f"{path} holds no scene plan: it was not written by this method.")
    return state


def states_of(pipeline: nn.Module, optimizers: Mapping[str, Optimizer], goes_on: bool) -> dict[str, Any]:
    """States of a pipeline and its optimisers for a file. The last one has no moments, which are half of all bytes, and
    tables in half precision."""
    state = pipeline.state_dict() if goes_on else in_half_precision(pipeline.state_dict())
    # A tensor of zeros alone, as untrained reliability, takes one number.
    zeros = {k: v.new_zeros(()).expand(v.shape) for k, v in state.items() if v.numel() > 1 and all_zero(v)}
    unused: dict[str, Any] = {} if goes_on else {"state": {}}
    moments = {k: v.state_dict() | unused for k, v in optimizers.items()}
    return {"pipeline": {**state, **zeros}, "optimizers": moments}


def cameras_in_short(observations: Observations) -> Float[Tensor, "M 18"]:
    """Poses, intrinsics and sizes of the training cameras, which identify a capture."""
    poses = observations.camera_to_worlds.reshape(-1, 12)
    return torch.from_numpy(np.concatenate([poses, observations.intrinsics, observations.sizes], -1)).float()


def check_same_run(
    state: dict[str, Any],
    path: Path,
    data: Path,
    observations: Observations,
    plan: WindowedPlan,
    steps_here: int,
    pose_mode: str,
    rays: dict[str, int] | None,
) -> None:
    """Raises InputError if a run of this capture, its training cameras, plan, steps of each of several windows and mode
    of the camera optimiser cannot resume from a checkpoint, read from ``path``. ``rays``: of a step; None if they do
    not follow the device."""
    drawn = state["rays"]
    steps = Schedule.from_json(to_text(state["pipeline"]["_model.progress.schedule_bytes"])).window_steps
    if rays is not None and drawn != rays:
        raise InputError(
            f"{path} is of a run of {steps:,} steps of {drawn['pixel']:,} rays, and {rays['pixel']:,} a step suit "
            f"this device: resume with --max-num-iterations {steps} --pipeline.datamanager.train-num-rays-per-batch "
            f"{drawn['pixel']} --pipeline.datamanager.keypoint-rays {drawn['keypoint']}."
        )
    theirs, ours = state["capture"]["cameras"], cameras_in_short(observations)
    if theirs.shape != ours.shape or not torch.allclose(theirs, ours, rtol=1e-4, atol=1e-4):
        raise InputError(
            f"{path} was trained on another capture ({state['capture']['data']}, and {data} here, whose training "
            "cameras are not the same): resume with the same --data and the same options of its parser, or train anew."
        )
    stored = WindowedPlan.from_json(to_text(state["pipeline"]["_model.progress.windows_bytes"]))
    if stored != plan:
        raise InputError(
            f"{path} was trained with another scene plan: resume with the settings in its config.yml, or give its "
            f"{PLAN_FILE} with --pipeline.model.plan-file."
        )
    if len(plan) > 1 and steps != steps_here:
        raise InputError(f"{path} has {steps:,} steps a window: resume with --max-num-iterations {steps}.")
    if ("_model.camera_optimizer.pose_adjustment" in state["pipeline"]) == (pose_mode == "off"):
        there, as_there = ("unrefined", "off") if pose_mode != "off" else ("refined", "SO3xR3")
        raise InputError(
            f"{path} was trained with {there} poses: resume with --pipeline.model.camera-optimizer.mode {as_there}."
        )
