"""Trainers on the tiny scene, small enough to train in a second."""

from __future__ import annotations

import copy
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine import trainer as nerfstudio_trainer

from mmpi_ns.config import mmpi_small
from mmpi_ns.data.datamanager import MMPIDataManagerConfig
from mmpi_ns.scene.plan import CubePlan, MPIPlan, ScenePlan
from mmpi_ns.scene.windows import Window, WindowedPlan
from mmpi_ns.settings import ScheduleConfig
from mmpi_ns.training.phases import make_schedule

WINDOW_STEPS = 6
"""Of each window in the runs of `tests/training`."""


def datamanager(data: Path, test_mode="val", **settings):
    config = copy.deepcopy(mmpi_small.config.pipeline.datamanager)
    assert isinstance(config, MMPIDataManagerConfig)
    config.data = data
    config.train_num_rays_per_batch = 64
    config.keypoint_rays = 16
    config.new_view_share = 0.0
    for name, value in settings.items():
        setattr(config.priors if hasattr(config.priors, name) else config, name, value)
    return config.setup(device="cpu", test_mode=test_mode)


def in_capture_frame(manager, origins, directions):
    """Rays as they are in the capture's own axes and units."""
    outputs = manager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double().numpy()
    rotation = transform[:, :3]
    return (origins / outputs.dataparser_scale - transform[:, 3]) @ rotation, directions @ rotation


def plan_of(observations, num_mpis=2, with_cube=False, planes=12) -> ScenePlan:
    """MPIs side by side behind the cameras of the tiny scene, which all see most of it; no two planes coincide."""
    x, y, z = observations.mean_axes
    center, size = observations.centers.mean(0), np.ptp(observations.centers, axis=0).max()
    mpis = tuple(
        MPIPlan(
            f"mpi{k}",
            tuple(float(v) for v in center + (0.5 * (k - (num_mpis - 1) / 2) * x - (0.3 + 0.07 * k) * z) * size),
            tuple(tuple(float(v) for v in row) for row in (x, y, z)),
            float(size),
            (-1.0, 1.0, -0.8, 0.8),
            planes,
            12,
            16,
        )
        for k in range(num_mpis)
    )
    cube = None
    if with_cube:
        middle, half = center + 1.5 * size * z, 0.6 * size
        cube = CubePlan(tuple(float(v) for v in middle - half), tuple(float(v) for v in middle + half), (8, 8, 8))
    return ScenePlan(mpis, cube, 0.1 * float(size), 1.2 * float(size))


def write_plan(data: Path, path: Path, **settings) -> Path:
    path.write_text(plan_of(datamanager(data, test_mode="inference").observations, **settings).to_json())
    return path


def write_windows(data: Path, path: Path) -> Path:
    """Two windows of the tiny scene's walk, one with two MPIs and one with one."""
    seen = datamanager(data, test_mode="inference").observations
    centers = seen.centers[np.argsort(seen.centers @ seen.mean_axes[0])]
    length = np.linalg.norm(centers[-1] - centers[0])
    middles = [centers[0] + (centers[-1] - centers[0]) * share for share in (0.25, 0.75)]
    windows = tuple(
        Window(tuple(m.tolist()), 0.3 * float(length), 0.1 * float(length), plan_of(seen, num_mpis=k))
        for m, k in zip(middles, (2, 1), strict=True)
    )
    path.write_text(WindowedPlan(windows).to_json())
    return path


def trainer_config(data: Path, plan: Path, output: Path, steps=24, **model):
    """mmpi-small on the tiny scene: individual, blend and finetune, with two doublings of the texels; no bricks go."""
    config = copy.deepcopy(mmpi_small.config)
    config.output_dir, config.experiment_name, config.timestamp = output, "tiny", "run"
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = steps, 1, False
    config.machine.device_type, config.machine.num_devices = "cpu", 1
    config.logging.local_writer.enable = False
    config.logging.profiler = "none"
    config.vis = "tensorboard"
    config.data = config.pipeline.datamanager.data = data
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    config.pipeline.datamanager.keypoint_rays, config.pipeline.datamanager.new_view_share = 16, 0.0
    settings = {
        "plan_file": plan,
        "training": "two-phase",
        "rays_per_mpi": "split",
        "blend_share": 0.25,
        "finetune_share": 0.25,
        "growth_shares": (1 / 8, 1 / 4),
        "release_weight": 0.0,
    }
    settings |= {"hidden_width": 8, "feature_channels": 4, "cube_alpha": 0.03}
    set_options(config.pipeline.model, **(settings | model))
    return config


def set_options(model, **settings):
    """Sets options of a model's config by their names; those of one name in two groups as group__name."""
    groups = {name: group for name, group in vars(model).items() if is_dataclass(group)}
    for path, value in settings.items():
        group, _, name = path.rpartition("__")
        places = [groups[group]] if group else [model, *groups.values()]
        (place,) = [p for p in places if name in {f.name for f in fields(p)}]
        setattr(place, name, value)


def schedule_of(training, steps, windows=1, **settings):
    """A schedule with the paper's settings, unless they are named."""
    paper = {"blend_share": 0.25, "finetune_share": 0.0, "decay_decades": 1.5, "decay_from": 0.0}
    paper |= {"release_shares": ()}
    return make_schedule(ScheduleConfig(training, **(paper | settings)), steps, windows)


def ready(config, **changes):
    """A trainer that is set up (and has loaded its checkpoint where the config names one)."""
    for name, value in changes.items():
        setattr(config, name, value)
    nerfstudio_trainer.writer.EVENT_WRITERS.clear()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def differences(a, b, path=""):
    """Where two nested states differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        if set(map(str, a)) != set(map(str, b)):
            return [f"{path}: {sorted(map(str, a))} and {sorted(map(str, b))}"]
        return [d for k in a for d in differences(a[k], b[k], f"{path}/{k}")]
    if isinstance(a, (list, tuple)):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{path}/{i}")]
    if isinstance(a, torch.Tensor):
        return [] if a.shape == b.shape and torch.equal(a, b) else [path]
    return [] if a == b else [f"{path}: {a} and {b}"]


def load(folder, step):
    return torch.load(folder / f"step-{step:09d}.ckpt", map_location="cpu", weights_only=True)


def compared(state):
    return {k: state[k] for k in ("step", "pipeline", "optimizers", "schedulers", "scalers")}


def facing(model, origins) -> torch.Tensor:
    """Rays along the axis of the first MPI."""
    axis = np.asarray(model.progress.windows.plans[0].mpis[0].axes)[2]
    return torch.tensor(axis).float().expand(len(origins), 3)


def rendered(model, origins) -> dict[str, torch.Tensor]:
    ones = torch.ones(len(origins), 1)
    bundle = RayBundle(origins, facing(model, origins), ones, torch.zeros_like(ones).long())
    with torch.no_grad():
        return model.eval().get_outputs(bundle)
