"""Our trainer: phases in the optimisers' schedulers, plan files, atomic checkpoints that resume exactly."""

from __future__ import annotations

import os
import pickle
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from mmpi_ns.checks import brief
from mmpi_ns.mmpi_model import MMPIModel
from mmpi_ns.phases import Schedule
from mmpi_ns.placement.plan import ScenePlan

PLAN_FILE = "plan.json"


@dataclass
class PhaseSchedulerConfig(SchedulerConfig):
    """Learning rate of one parameter kind: 0 where it is frozen, decaying over each phase in which it trains."""

    _target: type = field(default_factory=lambda: PhaseScheduler)
    kind: str = "density"
    """Which parameter kind the group holds."""


class PhaseScheduler(Scheduler):
    """Follows a ``Schedule``; without one (a config used outside our trainer) the rate stays constant."""

    config: PhaseSchedulerConfig
    schedule: Schedule | None = None

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        kind = self.config.kind
        return LambdaLR(optimizer, lambda step: self.schedule.rate_factor(kind, step) if self.schedule else 1.0)


@dataclass
class MMPITrainerConfig(TrainerConfig):
    """nerfstudio's trainer settings; max-num-iterations is the length of the whole run, resumed or not."""

    _target: type = field(default_factory=lambda: MMPITrainer)


class MMPITrainer(Trainer):
    """Trainer with phases, exact resume and atomic checkpoints."""

    config: MMPITrainerConfig

    @property
    def _model(self) -> MMPIModel:
        model = self.pipeline.model
        assert isinstance(model, MMPIModel), "MMPITrainer trains MMPIModel only"
        return model

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        _check_device(self.config.machine.device_type)
        self.config.pipeline.model.total_steps = self.config.max_num_iterations  # type: ignore[attr-defined]
        self._total_steps = self.config.max_num_iterations
        super().setup(test_mode)
        plan: ScenePlan = self._model.field.full_plan
        self.base_dir.mkdir(parents=True, exist_ok=True)
        _write_atomically(self.base_dir / PLAN_FILE, lambda path: path.write_text(plan.to_json(), encoding="utf-8"))
        CONSOLE.print(_describe(plan))

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with schedulers that know the phases."""
        model = self._model

        class Bound(PhaseScheduler):
            @property
            def schedule(self) -> Schedule:  # type: ignore[override]
                return model.schedule  # a checkpoint that is loaded later brings its own

        config: dict[str, Any] = {}
        for name, entry in self.config.optimizers.items():
            scheduler = entry["scheduler"]
            if isinstance(scheduler, PhaseSchedulerConfig):
                scheduler = PhaseSchedulerConfig(_target=Bound, kind=scheduler.kind)
            config[name] = {"optimizer": entry["optimizer"], "scheduler": scheduler}
        return Optimizers(config, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Runs up to max-num-iterations in all; 1.1.5 would run as many again after a resume."""
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = max(0, self._total_steps - self._start_step)
        if self.config.max_num_iterations == 0:
            CONSOLE.print(
                f"The checkpoint already holds {self._start_step} of {self._total_steps} steps: nothing to do."
            )
            return
        try:
            super().train()
        finally:
            self.config.max_num_iterations = self._total_steps

    def train_iteration(self, step: int) -> Any:
        """One step; remembers that it ran."""
        result = super().train_iteration(step)
        self._last_step = step
        return result

    def _after_train(self) -> None:
        """Saves the last step that ran; 1.1.5 would save the next one's number when training is stopped."""
        self.step = self._last_step
        super()._after_train()

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Writes beside the checkpoint folder, then moves the finished file in: a kill or a full disk loses nothing.

        Names inside the folder are parsed as steps by nerfstudio, so the unfinished file must not lie there.
        """
        if step < 0:
            return  # stopped before the first step: there is nothing to save
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {k: v.state_dict() for k, v in self.optimizers.optimizers.items()},
            "schedulers": {k: v.state_dict() for k, v in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "rng": {"torch": torch.get_rng_state()},
        }
        _write_atomically(path, lambda p: torch.save(state, p), self.base_dir)
        if self.config.save_only_latest_checkpoint:
            for old in self.checkpoint_dir.glob("*.ckpt"):
                if old != path:
                    old.unlink()

    def _load_checkpoint(self) -> None:
        path = self._checkpoint_path()
        if path is not None:
            state = _read_checkpoint(path)
            self._check_same_plan(state["pipeline"], path)
            if "rng" in state:
                torch.set_rng_state(state["rng"]["torch"])
            del state
        super()._load_checkpoint()

    def _checkpoint_path(self) -> Path | None:
        path = self.config.load_checkpoint
        if path is not None:
            if not path.is_file():
                raise ValueError(f"There is no checkpoint at {path}: check --load-checkpoint.")
            return path
        if self.config.load_dir is None:
            return None
        steps = [int(p.stem.split("-")[1]) for p in self.config.load_dir.glob("step-*.ckpt")]
        if not steps:
            raise ValueError(f"There is no checkpoint in {self.config.load_dir}: give the nerfstudio_models folder.")
        step = self.config.load_step if self.config.load_step is not None else max(steps)
        if step not in steps:
            raise ValueError(f"There is no step {step} in {self.config.load_dir}: it holds {sorted(steps)}.")
        return self.config.load_dir / f"step-{step:09d}.ckpt"

    def _check_same_plan(self, pipeline_state: dict[str, Any], path: Path) -> None:
        stored = pipeline_state.get("_model.field.plan_bytes")
        if stored is None:
            raise ValueError(f"{path} holds no scene plan: it was not written by this method.")
        theirs, ours = ScenePlan.from_json(bytes(stored.numpy().tolist()).decode()), self._model.field.full_plan
        if theirs != ours:
            raise ValueError(
                f"{path} was trained with another scene plan ({len(theirs.mpis)} MPIs there, "
                f"{len(ours.mpis)} here): resume with the settings in its config.yml, or give "
                f"its {PLAN_FILE} with --pipeline.model.plan-file."
            )


def _check_device(device_type: str) -> None:
    there = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}
    if device_type in there and not there[device_type]():
        raise ValueError(
            f"--machine.device-type {device_type} asks for a GPU and torch sees none: check the driver and torch's "
            "build, or train with --machine.device-type cpu."
        )


def _read_checkpoint(path: Path) -> dict[str, Any]:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"{path} cannot be read ({brief(error)}): resume from another one with --load-step."
        ) from error


def _write_atomically(path: Path, write: Any, folder: Path | None = None) -> None:
    """Writes to a temporary file on the same disk and renames it; removes it when writing fails."""
    temporary = (folder or path.parent) / f".{path.name}.{os.getpid()}.tmp"
    try:
        write(temporary)
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save has a RuntimeError, without a reason, for a full disk
        free = shutil.disk_usage(temporary.parent).free / 2**20
        temporary.unlink(missing_ok=True)
        raise OSError(
            f"{path} could not be written ({brief(error)}; {free:.0f} MB free): earlier files are "
            "untouched, so make room and start again (--load-dir goes on from the last checkpoint)."
        ) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _describe(plan: ScenePlan) -> str:
    lines = [f"Scene plan ({plan.origin_of_plan}): {len(plan.mpis)} MPIs, {plan.texels / 1e6:.1f} M texels"]
    for m in plan.mpis:
        tangents = " ".join(f"{t:.2f}" for t in m.extent)
        lines.append(
            f"  {m.name}: {m.planes} planes of {m.height} x {m.width}, "
            f"depths {m.near:.3g} to {m.far:.3g}, tangents {tangents}"
        )
    if plan.cube is not None:
        lines.append(f"  cube: {' x '.join(str(n) for n in plan.cube.shape)} voxels")
    return "\n".join(lines)
