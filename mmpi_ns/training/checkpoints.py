"""Checkpoint files: which there are, and whether a run can go on from one."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig

from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.utils.files import to_text
from mmpi_ns.utils.messages import brief


def checkpoints_in(folder: Path, steps: range | None = None) -> dict[int, Path]:
    """The checkpoints in a folder by their steps, all or those of some steps."""
    found = {int(p.stem.split("-")[1]): p for p in folder.glob("step-*.ckpt")}
    return {step: path for step, path in found.items() if steps is None or step in steps}


def checkpoint_to_load(config: TrainerConfig) -> Path | None:
    """The checkpoint that a run is to go on from; None for a new one.

    Raises:
        ValueError: it is not there.
    """
    path = config.load_checkpoint
    if path is not None:
        if not path.is_file():
            raise ValueError(f"There is no checkpoint at {path}: check --load-checkpoint.")
        return path
    if config.load_dir is None:
        return None
    steps = checkpoints_in(config.load_dir)
    if not steps:
        raise ValueError(f"There is no checkpoint in {config.load_dir}: give the nerfstudio_models folder.")
    step = config.load_step if config.load_step is not None else max(steps)
    if step not in steps:
        raise ValueError(f"There is no step {step} in {config.load_dir}: it holds {sorted(steps)}.")
    return steps[step]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint holds.

    Raises:
        ValueError: it is damaged.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"{path} cannot be read ({brief(error)}): resume from another one with --load-step."
        ) from error


def check_same_plan(state: dict[str, Any], path: Path, ours: WindowedPlan, plan_file: str) -> None:
    """Raises ValueError where a checkpoint was trained with another plan than this run has.

    Args:
        state: of the pipeline, in the checkpoint.
        path: the checkpoint.
        ours: the plan of this run.
        plan_file: what a run calls the file of its plan.
    """
    stored = state.get("_model.progress.windows_bytes")
    if stored is None:
        raise ValueError(f"{path} holds no scene plan: it was not written by this method.")
    theirs = WindowedPlan.from_json(to_text(stored))
    if theirs != ours:
        raise ValueError(
            f"{path} was trained with another scene plan ({_in_short(theirs)} there, {_in_short(ours)} here): "
            f"resume with the settings in its config.yml, or give its {plan_file} with --pipeline.model.plan-file."
        )


def _in_short(windows: WindowedPlan) -> str:
    mpis = f"{sum(len(plan.mpis) for plan in windows.plans)} MPIs"
    return mpis if len(windows) == 1 else f"{len(windows)} windows with {mpis}"
