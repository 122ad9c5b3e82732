"""A trained run, loaded for rendering pictures: its cameras, all MPIs merged, and each one alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.eval_utils import eval_setup
from numpy.typing import NDArray

from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.model import MMPIModel
from mmpi_ns.placement.observations import Observations
from mmpi_ns.rendering.metrics import head_palette
from mmpi_ns.scene.plan import CubePlan, MPIPlan
from mmpi_ns.scene.windows import WindowedPlan

Picture = NDArray[np.float32]


@dataclass(frozen=True)
class Run:
    """A model with the cameras that it is shown from."""

    model: MMPIModel
    observations: Observations
    """Training cameras and SfM points, scene units."""
    tests: InputDataset
    """The images that were held out."""
    scale: float
    """Scene units in a unit of the capture (a metre, for the procedural scenes)."""

    @property
    def windows(self) -> WindowedPlan:
        return self.model.progress.windows

    @property
    def heads(self) -> list[MPIPlan | CubePlan]:
        """The MPIs and the cube of every window, in the order in which the winner of a pixel counts them."""
        return [h for plan in self.windows.plans for h in (*plan.mpis, *([plan.cube] if plan.cube else []))]

    @property
    def colors(self) -> list[tuple[float, float, float]]:
        """A colour for each MPI, the same in every picture."""
        return [(r, g, b) for r, g, b in head_palette(len(self.heads), "cpu").tolist()]


@dataclass(frozen=True)
class View:
    """One camera's image, rendered."""

    color: Picture
    """[H, W, 3]"""
    inverse_depth: Picture
    """[H, W] 1 / distance, per unit of the capture."""
    winner: NDArray[np.int64]
    """[H, W] the MPI that gives the pixel most of its colour."""


def load_run(config: Path) -> Run:
    """Loads the last checkpoint of a run.

    Args:
        config: the run's config.yml.

    Raises:
        ValueError: the run is of another method.
    """
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model, manager = pipeline.model, pipeline.datamanager
    if not isinstance(model, MMPIModel) or not isinstance(manager, MMPIDataManager):
        raise ValueError(f"{config} belongs to another method: give the config.yml of an mmpi run.")
    scale = float(manager.train_dataparser_outputs.dataparser_scale)
    return Run(model, manager.observations, manager.eval_dataset, scale)


def truth_of(run: Run, index: int) -> Picture:
    """The true image [H, W, 3] of a test camera."""
    return run.tests.get_data(index, image_type="float32")["image"][..., :3].numpy()


def render_view(run: Run, camera: Cameras) -> View:
    """All MPIs, merged. ``camera``: one, of shape [1]."""
    outputs = _render(run, camera, "all")
    depth = outputs["depth"][..., 0] / run.scale
    winner = outputs["winning_mpi"][..., 0].round().long()
    return View(outputs["rgb"].numpy(), (1 / depth).numpy(), winner.numpy())


def render_alone(run: Run, camera: Cameras, name: str) -> Picture:
    """What one MPI holds [H, W, 4]: colour and opacity, as in the viewer's "Show MPI"."""
    return run.model.get_rgba_image(_render(run, camera, name)).numpy()


@torch.no_grad()
def _render(run: Run, camera: Cameras, show: str) -> dict[str, torch.Tensor]:
    before = run.model.show.value
    run.model.show.value = show
    try:
        outputs = run.model.get_outputs_for_camera(camera.to(run.model.device))
    finally:
        run.model.show.value = before
    return {name: values.cpu() for name, values in outputs.items()}
