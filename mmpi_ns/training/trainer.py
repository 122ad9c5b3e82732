"""nerfstudio's trainer with phases, one window after the other, and checkpoints that resume exactly."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE

from mmpi_ns.capture.datamanager import MMPIDataManager
from mmpi_ns.training.checkpoints import check_same_plan, checkpoint_to_load, checkpoints_in, read_checkpoint
from mmpi_ns.training.learning_rates import following
from mmpi_ns.training.memory import describe, training_bytes
from mmpi_ns.training.run import TrainingRun
from mmpi_ns.utils.files import write_atomically

PLAN_FILE = "plan.json"
WINDOWS_FOLDER = "windows"


@dataclass
class MMPITrainerConfig(TrainerConfig):
    """nerfstudio's trainer settings; max-num-iterations is the length of the whole run, resumed or not.

    A capture so long that it is split into windows gets as many steps for each of them.
    """

    _target: type = field(default_factory=lambda: MMPITrainer)

    def save_config(self) -> None:
        """Writes config.yml, from which ns-eval and ns-render learn where the windows of a long capture lie."""
        self.pipeline.model.windows_folder = self.get_base_dir() / WINDOWS_FOLDER  # type: ignore[attr-defined]
        super().save_config()


class MMPITrainer(Trainer):
    """Trainer with phases, exact resume and atomic checkpoints."""

    config: MMPITrainerConfig

    @property
    def _run(self) -> TrainingRun:
        run = getattr(self.pipeline.model, "run", None)
        assert isinstance(run, TrainingRun), "MMPITrainer trains MMPIModel only"
        return run

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        _check_device(self.config.machine.device_type)
        model_config: Any = self.config.pipeline.model
        self._window_steps = model_config.total_steps = self.config.max_num_iterations
        model_config.windows_folder = self.base_dir / WINDOWS_FOLDER
        # Processes share the windows out among them; nerfstudio would have all of them average their gradients.
        self._processes, self._process, self.world_size = self.world_size, comms.get_rank(), 1
        self._resumes_from = self.config.load_dir
        if self._processes > 1:
            self.config.load_dir = None
        super().setup(test_mode)
        self.config.max_num_iterations = self._window_steps
        plan = self._run.progress.windows
        self.base_dir.mkdir(parents=True, exist_ok=True)
        write_atomically(self.base_dir / PLAN_FILE, lambda path: path.write_text(plan.to_json(), encoding="utf-8"))
        CONSOLE.print(describe(plan, self._window_steps, *self._expected_memory()))
        if 1 < self._processes and len(plan) < self._processes:
            raise ValueError(
                f"The capture has {len(plan)} window(s), too few to share out among {self._processes} processes: start "
                "fewer, or make windows shorter with --pipeline.model.placement.window-length."
            )

    def _expected_memory(self) -> tuple[list[int], list[int]]:
        """Bytes that the training of each window holds: of tables with their moments, and of pixels."""
        run, manager = self._run, self.pipeline.datamanager
        blends = any(phase.name == "blend" for phase in run.progress.schedule.phases)
        tables = [
            training_bytes(plan, run.views_of(w), run.field.feature_channels, blends)
            for w, plan in enumerate(run.progress.windows.plans)
        ]
        assert isinstance(manager, MMPIDataManager), "MMPITrainer trains from MMPIDataManager"
        if len(tables) == 1:
            return tables, [manager.pixel_bytes()]
        centers = manager.observations.centers
        return tables, [manager.pixel_bytes(run.cameras_of(centers, w)) for w in range(len(tables))]

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with schedulers that know the phases."""
        progress = self._run.progress
        # nerfstudio shows what is left
        self._total_steps = self.config.max_num_iterations = progress.schedule.total_steps
        config: dict[str, Any] = {
            name: {"optimizer": entry["optimizer"], "scheduler": following(entry["scheduler"], progress)}
            for name, entry in self.config.optimizers.items()
        }
        return Optimizers(config, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Runs up to max-num-iterations in all (a window); 1.1.5 would run as many again after a resume."""
        if self._processes > 1:
            own = range(self._process, len(self._run.progress.windows), self._processes)
            for window in [w for w in own if not self._is_finished(w)]:
                self._train_window(window)
            return
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
            self.config.max_num_iterations = self._window_steps

    def _checkpoints_of(self, window: int) -> dict[int, Path]:
        """Checkpoints of one window of several, here and in the run that this one goes on from."""
        steps = range(window * self._window_steps, (window + 1) * self._window_steps)
        folders = [self.checkpoint_dir, *([self._resumes_from] if self._resumes_from else [])]
        return {step: path for folder in folders for step, path in checkpoints_in(folder, steps).items()}

    def _is_finished(self, window: int) -> bool:
        """Whether a window of several need not be trained; takes over its file where another run finished it."""
        store, windows = self._run.store, self._run.progress.windows
        if self._resumes_from:
            store.adopt(self._resumes_from.parent / WINDOWS_FOLDER, {window: windows.plans[window]})
        # Of the last window the checkpoint is needed too: evaluation begins there.
        is_last = window == len(windows) - 1
        finished = store.path(window).is_file() and (
            not is_last or (window + 1) * self._window_steps - 1 in self._checkpoints_of(window)
        )
        if finished:
            CONSOLE.print(f"Window {window} is finished already.")
        return finished

    def _train_window(self, window: int) -> None:
        """Trains one window of several, from where another run left it."""
        first, known = window * self._window_steps, self._checkpoints_of(window)
        self._start_step = first
        if known:
            self.config.load_checkpoint = known[max(known)]
            self._load_checkpoint()
            self.config.load_checkpoint = None
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = first + self._window_steps - self._start_step
        try:
            super().train()
        finally:
            self.config.max_num_iterations = self._window_steps
        if window != len(self._run.progress.windows) - 1:  # its file is all that is needed of it
            for path in checkpoints_in(self.checkpoint_dir, range(first, first + self._window_steps)).values():
                path.unlink()

    def train_iteration(self, step: int) -> Any:
        """One step; remembers that it ran, and puts a window of several away when it was its last."""
        result = super().train_iteration(step)
        self._last_step = step
        run, progress = self._run, self._run.progress
        if len(progress.windows) > 1 and (step + 1) % progress.schedule.window_steps == 0:
            run.store.save(progress.window, run.field)
        return result

    def _after_train(self) -> None:
        """Saves the last step that ran; 1.1.5 would save the next one's number when training is stopped."""
        self.step = self._last_step
        super()._after_train()

    def save_checkpoint(self, step: int) -> None:
        """Writes beside the checkpoint folder, then moves the finished file in: a kill or a full disk loses nothing.

        Names inside the folder are parsed as steps by nerfstudio, so the unfinished file must not lie there.
        """
        if step < 0 or not (self._processes > 1 or comms.is_main_process()):
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
        write_atomically(path, lambda p: torch.save(state, p), self.base_dir)
        if self.config.save_only_latest_checkpoint:
            first = step - step % self._window_steps if self._processes > 1 else 0
            own = range(first, first + self._window_steps) if self._processes > 1 else None  # others are others' work
            for old in checkpoints_in(self.checkpoint_dir, own).values():
                if old != path:
                    old.unlink()

    def _load_checkpoint(self) -> None:
        path, run = checkpoint_to_load(self.config), self._run
        if path is not None:
            state = read_checkpoint(path)
            check_same_plan(state["pipeline"], path, run.progress.windows, PLAN_FILE)
            torch.set_rng_state(state["rng"]["torch"])
            del state
        super()._load_checkpoint()
        if path is not None and self._processes == 1:
            progress = run.progress
            finished = dict(enumerate(progress.windows.plans[: progress.schedule.window_at(self._start_step)]))
            run.store.adopt(path.parent.parent / WINDOWS_FOLDER, finished, needed=True)


def _check_device(device_type: str) -> None:
    there = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}
    if device_type in there and not there[device_type]():
        raise ValueError(
            f"--machine.device-type {device_type} asks for a GPU and torch sees none: check the driver and torch's "
            "build, or train with --machine.device-type cpu."
        )
