"""nerfstudio's trainer with phases, one window after the other, and checkpoints that resume exactly."""

from __future__ import annotations

import hashlib
import sys
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms, writer
from nerfstudio.utils.rich_utils import CONSOLE

from mmpi_ns.capture.datamanager import MMPIDataManager
from mmpi_ns.rendering.rendered import BACKGROUNDS
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.checkpoints import (
    cameras_in_short,
    check_same_capture,
    check_same_plan,
    check_same_refinement,
    checkpoint_to_load,
    checkpoints_in,
    read_checkpoint,
)
from mmpi_ns.training.config_files import check_nothing_left
from mmpi_ns.training.learning_rates import following
from mmpi_ns.training.memory import describe, training_bytes
from mmpi_ns.training.options import check_ffmpeg, check_run
from mmpi_ns.training.ranks import patient_group, wait_for_all
from mmpi_ns.training.report import TrainingLog, forecast, next_commands, quick_test
from mmpi_ns.training.run import TrainingRun
from mmpi_ns.training.run_folder import claim
from mmpi_ns.training.stopping import end, end_before_training, signals_go_to
from mmpi_ns.utils.console import duration, keep_quiet, say
from mmpi_ns.utils.errors import InputError, speak_plainly
from mmpi_ns.utils.files import write_atomically
from mmpi_ns.utils.machine import keep_freed_memory

PLAN_FILE = "plan.json"
WINDOWS_FOLDER = "windows"


@dataclass
class MMPITrainerConfig(TrainerConfig):
    """nerfstudio's trainer settings; max-num-iterations is the length of the whole run, resumed or not.

    If a long capture is split into windows, each window gets this many steps.
    """

    _target: type = field(default_factory=lambda: MMPITrainer)

    def set_timestamp(self) -> None:
        """The first code of this package that ns-train runs."""
        speak_plainly()
        keep_quiet()
        super().set_timestamp()

    def get_checkpoint_dir(self) -> Path:
        """The first code of this package that ns-eval, ns-render and ns-viewer run.

        They take every file in this folder for a checkpoint, so the last one is given explicitly.
        """
        speak_plainly()
        keep_quiet()
        check_ffmpeg(sys.argv)
        check_nothing_left(self.pipeline.model)
        folder = super().get_checkpoint_dir()
        steps = checkpoints_in(folder)
        if steps and self.load_dir in (None, folder) and self.load_step is None and self.load_checkpoint is None:
            self.load_step = max(steps)
            read_checkpoint(steps[self.load_step])
        return folder

    def get_base_dir(self) -> Path:
        """The folder of the run. The last code of this package before ns-viewer opens its server.

        ns-viewer takes the address from its own options, whose default is every address of the machine.
        """
        options = [word.replace("_", "-") for word in sys.argv]
        asked = any(word.startswith("--viewer.websocket-host") for word in options)
        if Path(options[0]).stem == "ns-viewer" and not asked:
            self.viewer.websocket_host = "127.0.0.1"
        return super().get_base_dir()

    def print_to_terminal(self) -> None:
        """Prints where all settings are, which are more than a terminal has lines."""
        say(f"All settings of this run: {self.get_base_dir() / 'config.yml'}")

    def save_config(self) -> None:
        """Checks the options, locks the run's folder, and writes config.yml.

        It tells ns-eval and ns-render where the windows of a long capture are, but not which checkpoint this run
        resumes from, which they must not load.
        """
        check_run(self)
        folder = self.get_base_dir()
        claim(folder, self.get_checkpoint_dir(), self.load_checkpoint or self.load_dir)
        self.pipeline.model.windows_folder = folder / WINDOWS_FOLDER  # type: ignore[attr-defined]
        resumes = {name: getattr(self, name) for name in ("load_dir", "load_step", "load_checkpoint")}
        try:
            vars(self).update(dict.fromkeys(resumes))
            super().save_config()
        finally:
            vars(self).update(resumes)


class MMPITrainer(Trainer):
    """Trainer with phases, exact resume and atomic checkpoints."""

    config: MMPITrainerConfig

    @property
    def _run(self) -> TrainingRun:
        run = getattr(self.pipeline.model, "run", None)
        assert isinstance(run, TrainingRun), "MMPITrainer trains MMPIModel only"
        return run

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Prepares the run; a signal during this time ends it with a sentence (of several processes: torchrun's)."""
        with signals_go_to(end_before_training) if self.world_size == 1 else nullcontext():
            self._prepare(test_mode)

    def _prepare(self, test_mode: Literal["test", "val", "inference"]) -> None:
        _check_device(self.config.machine.device_type)
        keep_freed_memory()
        self._stopped_by: int | None = None
        self._log: TrainingLog | None = None
        self._began = monotonic()
        model_config: Any = self.config.pipeline.model
        model_config.seed = self.config.pipeline.datamanager.seed = self.config.machine.seed  # type: ignore[attr-defined]
        self._window_steps = model_config.total_steps = self.config.max_num_iterations
        model_config.windows_folder = self.base_dir / WINDOWS_FOLDER
        # Processes share the windows; nerfstudio would make them average their gradients.
        self._processes, self._process, self.world_size = self.world_size, comms.get_rank(), 1
        self._resumes_from = self.config.load_dir
        self._everyone = patient_group() if self._processes > 1 else None
        if self._processes > 1:
            self.config.load_dir = None
        self._says_lines, self.config.logging.local_writer.enable = self.config.logging.local_writer.enable, False
        super().setup(test_mode)
        self.config.max_num_iterations = self._window_steps
        plan = self._run.progress.windows
        self.base_dir.mkdir(parents=True, exist_ok=True)
        _write_plan(self.base_dir / PLAN_FILE, plan)
        self._run.shared = self._processes > 1
        if len(self._run.field.density) <= BRICK:  # the one that nothing lies in
            raise InputError(
                "No training image sees anything of the scene plan: its MPIs must stand among the cameras and face as "
                "they do (mmpi-plan shows where)."
            )
        self._say_what_comes(plan)
        if 1 < self._processes and len(plan) < self._processes:
            raise InputError(
                f"The capture has {len(plan)} window(s), too few to share out among {self._processes} processes: start "
                "fewer, or make windows shorter with --pipeline.model.placement.window-length."
            )

    def _say_what_comes(self, plan: WindowedPlan) -> None:
        """Prints capture, plan and memory together, before the first step."""
        manager, steps = self._manager, self._total_steps
        say(manager.describe())
        say(describe(plan, self._window_steps, *self._expected_memory()))
        if not str(self.device).startswith("cuda"):
            say(forecast(self.config.method_name or "", steps, manager.get_train_rays_per_batch()))

    @property
    def _manager(self) -> MMPIDataManager:
        manager = self.pipeline.datamanager
        assert isinstance(manager, MMPIDataManager), "MMPITrainer trains from MMPIDataManager"
        return manager

    def _expected_memory(self) -> tuple[list[int], list[int]]:
        """Bytes needed for training each window: tables with their moments, and pixels."""
        run, manager = self._run, self._manager
        blends = any(phase.name == "blend" for phase in run.progress.schedule.phases)
        tables = [
            training_bytes(plan, run.views_of(w), run.field.feature_channels, blends)
            for w, plan in enumerate(run.progress.windows.plans)
        ]
        if len(tables) == 1:
            return tables, [manager.pixel_bytes()]
        centers = manager.observations.centers
        return tables, [manager.pixel_bytes(run.cameras_of(centers, w)) for w in range(len(tables))]

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with schedulers that follow the phases."""
        progress = self._run.progress
        # nerfstudio shows what is left
        self._total_steps = self.config.max_num_iterations = progress.schedule.total_steps
        config: dict[str, Any] = {
            name: {"optimizer": entry["optimizer"], "scheduler": following(entry["scheduler"], progress)}
            for name, entry in self.config.optimizers.items()
        }
        return Optimizers(config, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Runs max-num-iterations in total (a window); nerfstudio 1.1.5 would run as many again after a resume."""
        if self._processes > 1:
            own = range(self._process, len(self._run.progress.windows), self._processes)
            for window in [w for w in own if not self._is_finished(w)]:
                self._train_window(window)
            wait_for_all(self._everyone)
            return
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = max(0, self._total_steps - self._start_step)
        if self.config.max_num_iterations == 0:
            CONSOLE.print(
                f"The checkpoint already holds {self._start_step} of {self._total_steps} steps: nothing to do."
            )
            return
        self._began = monotonic()
        self._log = self._new_log(self._total_steps)
        try:
            with signals_go_to(self._stop):
                super().train()
        finally:
            self.config.max_num_iterations = self._window_steps
        if self._stopped_by is not None:
            self.config.logging.profiler = "none"  # nothing more is said
            path = checkpoints_in(self.checkpoint_dir).get(self._last_step)
            if path is None:  # training was paused
                end_before_training(self._stopped_by)
            end(
                self._stopped_by,
                f"Stopped after step {self._last_step + 1} of {self._total_steps}, which is in {path}: the same "
                f"command with --load-dir {self.checkpoint_dir} continues from there.",
            )

    def _new_log(self, end: int) -> TrainingLog | None:
        """Of the steps up to ``end``; None where none is wanted."""
        rays = self._manager.get_train_rays_per_batch()
        return TrainingLog(self._run.progress.schedule, rays, self._start_step, end) if self._says_lines else None

    def _stop(self, number: int) -> None:
        """Makes nerfstudio's loop end after the current step, even if training is paused."""
        self._stopped_by, self.stop_training = number, True

    def _checkpoints_of(self, window: int) -> dict[int, Path]:
        """Folders with the checkpoints of one window of several, here and in the run that this one resumes."""
        steps = range(window * self._window_steps, (window + 1) * self._window_steps)
        folders = [self.checkpoint_dir, *([self._resumes_from] if self._resumes_from else [])]
        return {step: path for folder in folders for step, path in checkpoints_in(folder, steps).items()}

    def _is_finished(self, window: int) -> bool:
        """Whether a window of several is finished; takes over its file if the resumed run finished it."""
        store, windows = self._run.store, self._run.progress.windows
        if self._resumes_from:
            store.adopt(self._resumes_from.parent / WINDOWS_FOLDER, {window: windows.plans[window]})
        # The last window needs its checkpoint too, because evaluation loads it.
        is_last = window == len(windows) - 1
        finished = store.path(window).is_file() and (
            not is_last or (window + 1) * self._window_steps - 1 in self._checkpoints_of(window)
        )
        if finished:
            CONSOLE.print(f"Window {window} is finished already.")
        return finished

    def _train_window(self, window: int) -> None:
        """Trains one window of several, from where the resumed run left it."""
        first, known = window * self._window_steps, self._checkpoints_of(window)
        self._start_step = first
        if known:
            self.config.load_checkpoint = known[max(known)]
            self._load_checkpoint()
            self.config.load_checkpoint = None
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = first + self._window_steps - self._start_step
        self._log = self._new_log(first + self._window_steps)
        try:
            super().train()
        finally:
            self.config.max_num_iterations = self._window_steps
        if window != len(self._run.progress.windows) - 1:  # its file is all that is needed of it
            for path in checkpoints_in(self.checkpoint_dir, range(first, first + self._window_steps)).values():
                path.unlink()

    def train_iteration(self, step: int) -> Any:
        """One step; records that it ran, and saves a window of several after its last step."""
        loss, *others = super().train_iteration(step)
        self._last_step = step
        if self._log is not None:
            self._log.note(step, others[0]["rgb_loss"])
        if self._stopped_by is not None:  # nerfstudio forgets what was said before its loop
            self.stop_training = True
        run, progress = self._run, self._run.progress
        if len(progress.windows) > 1 and (step + 1) % progress.schedule.window_steps == 0:
            run.store.save(progress.window, run.field)
        return loss.detach(), *({k: _detached(v) for k, v in values.items()} for values in others)

    def _after_train(self) -> None:
        """Saves with the number of the last step that ran; nerfstudio 1.1.5 would use the next one after a stop."""
        self.step = self._last_step
        self.training_state = "completed"
        self.save_checkpoint(self.step)
        writer.write_out_storage()
        if self._stopped_by is not None or self._processes > 1:
            return
        seconds = monotonic() - self._began
        say(f"Training finished: {self._last_step + 1 - self._start_step:,} steps in {duration(seconds)}.")
        model: Any = self.pipeline.model
        images = self._manager.eval_dataset
        if self._says_lines and images is not None:
            say(quick_test(model, images, BACKGROUNDS[model.config.rendering.background]))
        say(next_commands(self.base_dir))
        if not self.config.viewer.quit_on_train_completion:
            self._train_complete_viewer()

    def save_checkpoint(self, step: int) -> None:
        """Writes beside the checkpoint folder, then moves the file in, so a kill or a full disk loses nothing.

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
            "capture": {
                "data": str(self._manager.get_datapath()),
                "cameras": cameras_in_short(self._manager.observations),
            },
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
            check_same_capture(state, path, self._manager.get_datapath(), self._manager.observations)
            check_same_plan(state["pipeline"], path, run.progress.windows, PLAN_FILE)
            model: Any = self.pipeline.model
            check_same_refinement(state["pipeline"], path, model.camera_optimizer.config.mode)
            torch.set_rng_state(state["rng"]["torch"])
            del state
        # nerfstudio takes every file in load_dir for a checkpoint.
        asked, self.config.load_dir = self.config.load_dir, None
        asked_for, self.config.load_checkpoint = self.config.load_checkpoint, path
        super()._load_checkpoint()
        self.config.load_dir, self.config.load_checkpoint = asked, asked_for
        if path is not None and self._processes == 1:
            progress = run.progress
            finished = dict(enumerate(progress.windows.plans[: progress.schedule.window_at(self._start_step)]))
            run.store.adopt(path.parent.parent / WINDOWS_FOLDER, finished, needed=True)


def _write_plan(path: Path, plan: WindowedPlan) -> None:
    """Writes a run's plan for the user to read; one that was edited is kept."""
    text, told = plan.to_json(), path.with_name(f".{path.name}.sha256")
    there = path.read_bytes() if path.is_file() else text.encode()
    written = told.read_text(encoding="ascii") if told.is_file() else ""
    if there != text.encode() and hashlib.sha256(there).hexdigest() != written:
        raise InputError(
            f"{path} is not the plan of this run and was edited, it seems: give it with --pipeline.model.plan-file in "
            "another --timestamp, or remove it."
        )
    write_atomically(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))
    told.write_text(hashlib.sha256(text.encode()).hexdigest(), encoding="ascii")


def _detached(value: Any) -> Any:
    return value.detach() if isinstance(value, torch.Tensor) else value


def _check_device(device_type: str) -> None:
    there = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}
    if device_type in there and not there[device_type]():
        raise InputError(
            f"--machine.device-type {device_type} asks for a GPU and torch sees none: check the driver and torch's "
            "build, or train with --machine.device-type cpu."
        )
