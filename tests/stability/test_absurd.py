"""Trainings with absurd settings on a tiny procedural scene end with finite numbers or one clear sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from methods import TWO_PHASE
from still_life import still_life
from trainers import Scene, config_of, train_words, trainer_of

from mmpi_ns.scene.plan import MPIPlan
from mmpi_ns.training.trainer import MMPITrainer
from mmpi_scene.dataset import write_dataset

WIDTH, HEIGHT, IMAGES = 32, 24, 9
RAYS = 64
STEPS = 60
"""The phases are shares of them; 2,000 ended no other way."""


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


def _turned(mpi: MPIPlan) -> MPIPlan:
    x, y, z = mpi.axes
    back = tuple(tuple(-v for v in row) for row in (x, z))
    return replace(mpi, name="facing away", axes=(back[0], y, back[1]))  # type: ignore[arg-type]


ABSURDITIES = (
    Absurdity("learning rates x 100", _rates),
    Absurdity("raw densities start at N(0, 1) x 1e3", start=_dense),
    Absurdity("two identical MPIs", mpis=lambda mpis: (mpis[0], replace(mpis[0], name="its twin"))),
    Absurdity("the only MPI faces away", mpis=lambda mpis: (_turned(mpis[0]),)),
)
OPTIONS = (
    *("--pipeline.datamanager.train-num-rays-per-batch", str(RAYS), "--pipeline.datamanager.keypoint-rays", "16"),
    *(*TWO_PHASE, "--pipeline.model.colour.hidden-width", "16", "--pipeline.model.placement.max-planes", "32"),
)
"""mmpi-small with both phases and a fine-tune, few rays and small networks."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("still-life")
    still = still_life(count=IMAGES, width=WIDTH, height=HEIGHT)
    write_dataset(still, folder, points=150, overwrite=True)
    return folder


def train(absurdity: Absurdity, scene: Path, folder: Path) -> MMPITrainer:
    """Trains to the end, or raises."""
    config = config_of(train_words("mmpi-small", OPTIONS, Scene(scene, 1), folder, STEPS, 0, "cpu"))
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
    return trainer


def broken(trainer: MMPITrainer) -> list[str]:
    """Numbers of the model, and of a test image, that are not finite."""
    model, test_images = trainer.pipeline.model.eval(), trainer.pipeline.datamanager.eval_dataset
    assert test_images is not None
    with torch.no_grad():
        image = model.get_outputs_for_camera(test_images.cameras[0:1])
    state = {k: v for k, v in model.state_dict().items() if v.is_floating_point()} | image
    return sorted(k for k, v in state.items() if not bool(torch.isfinite(v).all()))


@pytest.mark.parametrize("absurdity", ABSURDITIES, ids=lambda a: a.name)
def test_an_absurd_training_ends_with_finite_numbers_or_one_sentence(absurdity, scene, tmp_path):
    try:
        trainer = train(absurdity, scene, tmp_path)
    except ValueError as error:
        assert 20 < len(str(error)) < 400 and "\n" not in str(error).strip()
    else:
        assert trainer._last_step + 1 == STEPS and not broken(trainer)


def test_a_training_that_ends_in_nan_is_seen(scene, tmp_path):
    def poison(trainer):
        trainer._run.field.features.data[64:] = math.nan  # all texels: the rows before them hold nothing

    assert broken(train(Absurdity("poisoned", start=poison), scene, tmp_path))
