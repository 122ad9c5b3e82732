"""config.yml: read from anywhere, also those of earlier versions, whose options were not in groups."""

from __future__ import annotations

import copy
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.values import shown

MOVED = {
    **{
        name: f"schedule.{name}"
        for name in (
            "training", "rays_per_mpi", "blend_share", "finetune_share", "finetune_rate", "decay_decades",
            "decay_from", "growth_shares", "growing_rays", "release_shares", "release_weight",
        )
    },
    **{name: f"sampling.{name}" for name in ("samples_per_voxel", "cube_alpha")},
    **{
        name: f"colour.{name}"
        for name in (
            "shading", "feature_channels", "hidden_width", "position_frequencies", "direction_frequencies",
        )
    },
    **{name: f"rendering.{name}" for name in ("background", "resident_gib", "half_windows")},
    "train_threshold": "sampling.threshold",
    "render_threshold": "rendering.threshold",
    "render": "rendering.mode",
}  # fmt: skip
"""Options of the model that were not in groups, and where they are now."""
LEFT = {"blend_form": "paper", "shared_colour": False, "render_shares": "exact"}
"""Options that this version may lack, with the value that it stands for."""


def grouped(state: dict[str, Any], usual: Any) -> dict[str, Any]:
    """The attributes of a model's config with every option in its group.

    Args:
        state: attributes as a config.yml has them.
        usual: a config with the default groups, which is filled. Options without a group stay where they are.
    """
    state = dict(state)
    for old, new in MOVED.items():
        group, _, name = new.partition(".")
        if old in state and name in {f.name for f in fields(getattr(usual, group))} and group not in state:
            setattr(getattr(usual, group), name, state.pop(old))
    return vars(usual) | state


def with_absolute_paths(config: TrainerConfig) -> TrainerConfig:
    """The settings of a run as its config.yml keeps them: for any working folder, and without a checkpoint to load."""
    config = copy.deepcopy(config)
    config.load_dir = config.load_step = config.load_checkpoint = None
    manager: Any = config.pipeline.datamanager
    for settings, name in ((config, "output_dir"), (config, "data"), (manager, "data"), (manager.dataparser, "data")):
        path = getattr(settings, name)
        if path not in (None, Path()):
            setattr(settings, name, path.absolute())
    model: Any = config.pipeline.model
    model.windows_folder = model.windows_folder.absolute()
    return config


def check_nothing_left(model: Any) -> None:
    """Raises InputError naming an option of a loaded config that this version lacks and that changes the images."""
    groups = {"": model} | {f"{name}.": group for name, group in vars(model).items() if is_dataclass(group)}
    for prefix, group in groups.items():
        for name in vars(group).keys() - {f.name for f in fields(group)}:
            if name not in LEFT or getattr(group, name) != LEFT[name]:
                option = f"--pipeline.model.{prefix}{name}".replace("_", "-")
                raise InputError(
                    f"The run's config.yml asks for {option} {shown(getattr(group, name))}, which this version lacks: "
                    "use the version that trained the run, or train anew without it."
                )
