"""``mmpi-plan``: draws and explains the placement of the MPIs in a scene."""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mmpi_ns.placement.defaults import PLACEMENT, RAYS, check_placement, steps_for
from mmpi_ns.scripts.command import run
from mmpi_ns.settings import PlacementConfig
from mmpi_ns.utils.errors import InputError, log, looked_at, quoted
from mmpi_ns.utils.values import Number, check_options

if TYPE_CHECKING:
    from mmpi_ns.data.datamanager import MMPIDataManager
    from mmpi_ns.placement.observations import Observations


@dataclass
class PlanCommand:
    """Places MPIs in a scene without training: a table, plan.json, and a picture.

    plan.json can be edited and used with ``ns-train mmpi --pipeline.model.plan-file plan.json``.
    """

    scene: tyro.conf.Positional[Path]
    """Folder with transforms.json, or with images and a COLMAP model."""
    output: Path
    """Folder for plan.json, plan.md and plan.png."""
    downscale_factor: int | None = None
    """Size of the images, as for the data parser."""
    plan_file: Path | None = None
    """Evaluate this plan instead of making a new one."""
    size: float = 1.0
    """As ``--pipeline.model.size`` of ns-train."""
    placement: PlacementConfig = field(default_factory=lambda: PLACEMENT)
    """The rule's settings."""

    def main(self) -> None:
        # Slow imports, which --help does not need.
        from mmpi_ns.placement.show import draw_plan, explain
        from mmpi_ns.placement.split import find_balls, most_pixels, place_windows
        from mmpi_ns.scene.windows import WindowedPlan
        from mmpi_ns.utils.files import make_writable, write_plan, write_text

        check_options(self, {"size": Number(0, above=True)}, "--")
        check_placement(self.placement, "--placement.")
        if not self.scene.exists():
            raise InputError(f"There is no scene at {looked_at(self.scene)}: check the path.")
        make_writable(self.output, "--output")
        # Before the images are read, so that an error in the plan is reported at once.
        windows = None if self.plan_file is None else WindowedPlan.load(self.plan_file)
        observations, manager = load_observations(self.scene, self.downscale_factor)
        if windows is None:
            balls = find_balls(observations, self.placement.window_length)
            steps = steps_for(most_pixels(observations, balls), self.size)
            sized = replace(self.placement, max_texels=min(self.size, 1.0) * self.placement.max_texels)
            windows = place_windows(observations, sized, steps * RAYS)
        draw_plan(self.output / "plan.png", windows, observations)
        text = explain(windows, observations)
        if manager.priors is not None and manager.priors.movers:
            text += f"\n\n{manager.priors.movers}."
        plan = self.output / "plan.json"
        write_plan(plan, windows.to_json())
        write_text(self.output / "plan.md", f"# Plan of {self.scene.resolve().name}\n\n{text}\n")
        print(text)
        print(f"\nWrote plan.json, plan.md and plan.png in {self.output}.")
        print(f"Train with it: ns-train mmpi --pipeline.model.plan-file {quoted(plan)} --data ...")


def load_observations(data: Path, downscale_factor: int | None) -> tuple[Observations, MMPIDataManager]:
    """The observations that training on a scene would use for placement, and the data manager. Raises InputError if the
    folder holds no scene, or one that cannot be trained. ``downscale_factor`` is as for the data parser."""
    # Slow imports, which --help does not need.
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    from mmpi_ns.config import mmpi_small
    from mmpi_ns.data.checks import colmap_models

    config: Any = copy.deepcopy(mmpi_small.config.pipeline.datamanager)
    if data.suffix != ".json" and not (data / "transforms.json").is_file():
        models = colmap_models(data)
        if not models:
            raise InputError(f"{data} holds neither a transforms.json nor a COLMAP model: it is not a scene.")
        config.priors.sfm_path = Path(models[0])
        config.dataparser = ColmapDataParserConfig(colmap_path=config.priors.sfm_path)
    config.data = config.dataparser.data = data
    config.dataparser.downscale_factor = downscale_factor
    # As ns-train does, with the same refusals and depth priors.
    config.priors = replace(config.priors, correct_exposure=False)  # placement does not use it
    config.new_view_share = 0.0
    manager = config.setup(device="cpu", test_mode="inference")
    if not any(Path(file).is_file() for file in manager.train_dataset.image_filenames):
        log(f"The images of {data} are not there: its cameras and points alone are judged.")
        return manager.observations, manager
    manager = config.setup(device="cpu", test_mode="val")
    return manager.priors.placement, manager


def entrypoint() -> None:
    """The command ``mmpi-plan``; a problem with the scene or the plan ends it with one sentence and status 1."""
    sys.exit(run("mmpi-plan", PlanCommand, description=PlanCommand.__doc__))


if __name__ == "__main__":
    entrypoint()
