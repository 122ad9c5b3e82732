"""Trainings with absurd settings on a tiny procedural scene: each must end with finite weights or one clear error."""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mmpi_ns.bench.methods import TWO_PHASE, Method
from mmpi_ns.bench.report import Scene, commit
from mmpi_ns.bench.trainers import config_of, trainer_of
from mmpi_ns.rendering.metrics import ImageMetrics
from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.synthetic.catalogue import make_scene
from mmpi_ns.synthetic.dataset import write_dataset
from mmpi_ns.training.trainer import MMPITrainer

WIDTH, HEIGHT, IMAGES = 32, 24, 9
RAYS = 64


@dataclass(frozen=True)
class Absurdity:
    """One training that nobody should ask for, and that must end with finite weights."""

    name: str
    change: Callable[[Any, Path], None] | None = None
    """Alters the config before the trainer is made; the folder is the scene's."""
    mpis: Callable[[tuple[MPIPlan, ...]], tuple[MPIPlan, ...]] | None = None
    """MPIs to train, from those that the scene would get."""
    start: Callable[[MMPITrainer], None] | None = None
    """Alters the model before the first step."""


def _rates(config: Any, _: Path) -> None:
    for entry in config.optimizers.values():
        entry["optimizer"].lr *= 100


def _dense(trainer: MMPITrainer) -> None:
    trainer._run.field.density.data.normal_(generator=torch.Generator().manual_seed(0)).mul_(1e3)


def _one_image(config: Any, scene: Path) -> None:
    path = scene / "one-image.json"
    meta = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    meta["train_filenames"] = meta["train_filenames"][:1]
    path.write_text(json.dumps(meta), encoding="utf-8")
    config.data = config.pipeline.datamanager.data = path
    config.pipeline.datamanager.dataparser.data = path


def _turned(mpi: MPIPlan) -> MPIPlan:
    x, y, z = mpi.axes
    back = tuple(tuple(-v for v in row) for row in (x, z))
    return replace(mpi, name="facing away", axes=(back[0], y, back[1]))  # type: ignore[arg-type]


ABSURDITIES = (
    Absurdity("learning rates x 100", _rates),
    Absurdity("raw densities start at N(0, 1) x 1e3", start=_dense),
    Absurdity("one training image", _one_image),
    Absurdity("two identical MPIs", mpis=lambda mpis: (mpis[0], replace(mpis[0], name="its twin"))),
    Absurdity("one of two MPIs faces away", mpis=lambda mpis: (mpis[0], _turned(mpis[0]))),
    Absurdity("the only MPI faces away", mpis=lambda mpis: (_turned(mpis[0]),)),
)
OPTIONS = (
    *("--pipeline.datamanager.train-num-rays-per-batch", str(RAYS), "--pipeline.datamanager.keypoint-rays", "16"),
    *(*TWO_PHASE, "--pipeline.model.hidden-width", "16", "--pipeline.model.placement.max-planes", "32"),
)
"""mmpi-small with both phases and a fine-tune, few rays and small networks."""


def train(absurdity: Absurdity, work: Path, steps: int) -> dict[str, Any]:
    """Trains to the end or to an error; which numbers of the model are not finite."""
    scene, folder = work / "scene", work / absurdity.name.replace(" ", "-")
    if not (scene / "transforms.json").is_file():
        still = make_scene("still-life", count=IMAGES, width=WIDTH, height=HEIGHT)
        write_dataset(still, scene, points=150, overwrite=True)
    folder.mkdir(parents=True, exist_ok=True)
    method = Method("absurd", "mmpi-small", OPTIONS)
    config = config_of(method.words(Scene(scene, 1), folder, steps, None, 0, "cpu"))
    row: dict[str, Any] = {"expectation": "finite weights", "steps": steps, "commit": commit()}
    start = time.perf_counter()
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            if absurdity.change is not None:
                absurdity.change(config, scene)
            if absurdity.mpis is not None:
                plan = trainer_of(config)._run.field.full_plan
                config.pipeline.model.plan_file = folder / "plan.json"
                config.pipeline.model.plan_file.write_text(replace(plan, mpis=absurdity.mpis(plan.mpis)).to_json())
            trainer = trainer_of(config)
            if absurdity.start is not None:
                absurdity.start(trainer)
            trainer.train()
    except ValueError as error:
        said = str(error).strip()
        row.update(outcome=f"error: {error}", ok=20 < len(said) < 400 and "\n" not in said)
    except Exception as error:  # anything else is no message to a user, whatever it says: a failure to be reported
        row.update(outcome=f"{type(error).__name__}: {error}", ok=False)
    else:
        row.update(_weights(trainer, steps))
    return row | {"seconds": time.perf_counter() - start}


def _weights(trainer: MMPITrainer, steps: int) -> dict[str, Any]:
    """Whether every step ran, every number is finite, and what a test image gets."""
    model, test_images = trainer.pipeline.model.eval(), trainer.pipeline.datamanager.eval_dataset
    assert test_images is not None
    state = {k: v for k, v in model.state_dict().items() if v.is_floating_point()}
    broken = sorted(k for k, v in state.items() if not bool(torch.isfinite(v).all()))
    largest = max((float(v.abs().max()) for v in state.values() if v.numel()), default=0.0)
    with torch.no_grad():
        image = model.get_outputs_for_camera(test_images.cameras[0:1])
    broken += sorted(f"output {k}" for k, v in image.items() if not bool(torch.isfinite(v).all()))
    psnr = ImageMetrics("none")(image["rgb"], test_images.get_image_float32(0)[..., :3])["psnr"]
    ran = trainer._last_step + 1
    said = "finite weights" if not broken else f"not finite: {', '.join(broken)}"
    said += "" if ran == steps else f" after {ran} of {steps} steps"
    return {"outcome": said, "ok": ran == steps and not broken, "largest": largest, "psnr": psnr}
