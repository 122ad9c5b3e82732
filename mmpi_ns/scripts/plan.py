"""``mmpi-plan``: shows where MPIs would stand in a scene, why, and what each of them is good for."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from mmpi_ns.placement.rule import PlacementConfig


@dataclass
class PlanCommand:
    """Places MPIs in a scene without training: a table, plan.json, and pictures.

    plan.json can be edited and given back with ``ns-train mmpi --pipeline.model.plan-file plan.json``.
    """

    scene: tyro.conf.Positional[Path]
    """Folder with transforms.json, or with images and a COLMAP model."""
    output: Path
    """Folder for plan.json, plan.md, plan.png and errors.png."""
    method: Literal["mmpi", "mmpi-small"] = "mmpi-small"
    """Whose defaults to place with."""
    downscale_factor: int | None = None
    """Size of the images, as for the data parser."""
    parser: Literal["auto", "nerfstudio", "colmap"] = "auto"
    """How the scene is stored."""
    plan_file: Path | None = None
    """Explain this plan instead of placing a new one."""
    training_rays: int = 0
    """Pixel rays of the training that the texels should suit; 0 for any number."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """The rule's settings."""

    def main(self) -> None:
        # Slow imports, which --help does not need.
        from mmpi_ns.mmpi_scene import load_observations
        from mmpi_ns.placement.content import find_content
        from mmpi_ns.placement.explain import explain, table
        from mmpi_ns.placement.pictures import draw_errors, draw_plan
        from mmpi_ns.placement.plan import ScenePlan
        from mmpi_ns.placement.rule import place

        observations = load_observations(self.scene, self.downscale_factor, self.parser)
        if self.plan_file is not None:
            plan = ScenePlan.load(self.plan_file)
        else:
            plan = place(observations, self.placement, self.training_rays or None)
        content = find_content(observations)
        report = explain(plan, observations, content)
        text = table(report)
        self.output.mkdir(parents=True, exist_ok=True)
        (self.output / "plan.json").write_text(plan.to_json(), encoding="utf-8")
        (self.output / "plan.md").write_text(f"# Plan of {self.scene.resolve().name}\n\n{text}\n", encoding="utf-8")
        draw_plan(self.output / "plan.png", plan, observations, content)
        draw_errors(self.output / "errors.png", plan, report)
        print(text)
        print(f"\nWrote plan.json, plan.md, plan.png and errors.png in {self.output}.")
        print(
            f"Train with it: ns-train {self.method} --pipeline.model.plan-file {self.output / 'plan.json'} --data ..."
        )


def _defaults(arguments: list[str]) -> PlanCommand:
    """The command with the placement and the rays of the method that the arguments name."""
    from mmpi_ns.mmpi_config import mmpi, mmpi_small

    words = [w for argument in arguments for w in argument.split("=", 1)]
    named = words[words.index("--method") + 1] if "--method" in words[:-1] else "mmpi-small"
    config = (mmpi if named == "mmpi" else mmpi_small).config
    rays = config.max_num_iterations * config.pipeline.datamanager.train_num_rays_per_batch  # type: ignore
    placement = config.pipeline.model.placement  # type: ignore
    missing = tyro.MISSING
    return PlanCommand(scene=missing, output=missing, training_rays=rays, placement=placement)


def entrypoint() -> None:
    """The command ``mmpi-plan``; a problem with the scene or the plan ends it with one sentence and status 1."""
    command = tyro.cli(PlanCommand, default=_defaults(sys.argv[1:]), description=PlanCommand.__doc__)
    try:
        command.main()
    except ValueError as error:
        sys.exit(f"mmpi-plan: {error}")


if __name__ == "__main__":
    entrypoint()
