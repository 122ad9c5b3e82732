"""Our trainer: phases in the optimisers' schedulers, plan files, atomic checkpoints that resume exactly."""

from __future__ import annotations

import pickle
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from mmpi_ns.capture.checks import brief
from mmpi_ns.capture.datamanager import MMPIDataManager
from mmpi_ns.model import MMPIModel
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.forecast import Forecast, describe, training_bytes
from mmpi_ns.training.phases import Schedule
from mmpi_ns.utils.files import write_atomically

PLAN_FILE = "plan.json"
WINDOWS_FOLDER = "windows"


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
    _forecast: Forecast | None = None
    _last_step_ended: float | None = None

    @property
    def _model(self) -> MMPIModel:
        model = self.pipeline.model
        assert isinstance(model, MMPIModel), "MMPITrainer trains MMPIModel only"
        return model

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
        plan = self._model.windows
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
        model, manager = self._model, self.pipeline.datamanager
        blends = any(phase.name == "blend" for phase in model.schedule.phases)
        tables = [
            training_bytes(plan, model.views_of(w), model.config.feature_channels, blends)
            for w, plan in enumerate(model.windows.plans)
        ]
        assert isinstance(manager, MMPIDataManager), "MMPITrainer trains from MMPIDataManager"
        if len(tables) == 1:
            return tables, [manager.pixel_bytes()]
        centers = manager.observations.centers
        return tables, [manager.pixel_bytes(model.cameras_of(centers, w)) for w in range(len(tables))]

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with schedulers that know the phases."""
        model = self._model
        self._total_steps = self.config.max_num_iterations = model.schedule.total_steps  # nerfstudio shows what is left

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
        """Runs up to max-num-iterations in all (a window); 1.1.5 would run as many again after a resume."""
        self._last_step_ended = None
        if self._processes > 1:
            own = range(self._process, len(self._model.windows), self._processes)
            left, length = [w for w in own if not self._is_finished(w)], self._window_steps
            self._forecast = Forecast(self._model.schedule, [range(w * length, (w + 1) * length) for w in left])
            for window in left:
                self._train_window(window)
            return
        self._forecast = Forecast(self._model.schedule, [range(self._start_step, self._total_steps)])
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
        store = self._model.store
        if self._resumes_from:
            store.adopt(self._resumes_from.parent / WINDOWS_FOLDER, {window: self._model.windows.plans[window]})
        # Of the last window the checkpoint is needed too: evaluation begins there.
        is_last = window == len(self._model.windows) - 1
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
        if window != len(self._model.windows) - 1:  # its file is all that is needed of it
            for path in checkpoints_in(self.checkpoint_dir, range(first, first + self._window_steps)).values():
                path.unlink()

    def train_iteration(self, step: int) -> Any:
        """One step; remembers that it ran, and puts a window of several away when it was its last."""
        result = super().train_iteration(step)
        self._last_step = step
        now = time.perf_counter()
        if self._forecast is not None and self._last_step_ended is not None:
            said = self._forecast.note(step, now - self._last_step_ended)
            if said is not None:
                CONSOLE.print(said)
        self._last_step_ended = now
        model = self._model
        if len(model.windows) > 1 and (step + 1) % model.schedule.window_steps == 0:
            model.store.save(model.window, model.field)
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
        path = self._checkpoint_path()
        if path is not None:
            state = _read_checkpoint(path)
            self._check_same_plan(state["pipeline"], path)
            if "rng" in state:
                torch.set_rng_state(state["rng"]["torch"])
            del state
        super()._load_checkpoint()
        if path is not None and self._processes == 1:
            finished = dict(enumerate(self._model.windows.plans[: self._model.schedule.window_at(self._start_step)]))
            self._model.store.adopt(path.parent.parent / WINDOWS_FOLDER, finished, needed=True)

    def _checkpoint_path(self) -> Path | None:
        path = self.config.load_checkpoint
        if path is not None:
            if not path.is_file():
                raise ValueError(f"There is no checkpoint at {path}: check --load-checkpoint.")
            return path
        if self.config.load_dir is None:
            return None
        steps = checkpoints_in(self.config.load_dir)
        if not steps:
            raise ValueError(f"There is no checkpoint in {self.config.load_dir}: give the nerfstudio_models folder.")
        step = self.config.load_step if self.config.load_step is not None else max(steps)
        if step not in steps:
            raise ValueError(f"There is no step {step} in {self.config.load_dir}: it holds {sorted(steps)}.")
        return steps[step]

    def _check_same_plan(self, pipeline_state: dict[str, Any], path: Path) -> None:
        stored = pipeline_state.get("_model.windows_bytes", pipeline_state.get("_model.field.plan_bytes"))
        if stored is None:
            raise ValueError(f"{path} holds no scene plan: it was not written by this method.")
        if "_model.field.tiles" not in pipeline_state:
            raise ValueError(
                f"{path} is from before tables were stored in bricks: it can be rendered and evaluated, not resumed: "
                "train anew."
            )
        exposed = "_model.exposure.settings" in pipeline_state
        if exposed != (self._model.exposure is not None):
            raise ValueError(
                f"{path} was trained with{'' if exposed else 'out'} exposure: resume with --pipeline.model.exposure "
                f"{exposed}."
            )
        theirs, ours = WindowedPlan.from_json(bytes(stored.numpy().tolist()).decode()), self._model.windows
        if theirs != ours:
            raise ValueError(
                f"{path} was trained with another scene plan ({_in_short(theirs)} there, {_in_short(ours)} here): "
                f"resume with the settings in its config.yml, or give its {PLAN_FILE} with --pipeline.model.plan-file."
            )


def _in_short(windows: WindowedPlan) -> str:
    mpis = f"{sum(len(plan.mpis) for plan in windows.plans)} MPIs"
    return mpis if len(windows) == 1 else f"{len(windows)} windows with {mpis}"


def checkpoints_in(folder: Path, steps: range | None = None) -> dict[int, Path]:
    """The checkpoints in a folder by their steps, all or those of some steps."""
    found = {int(p.stem.split("-")[1]): p for p in folder.glob("step-*.ckpt")}
    return {step: path for step, path in found.items() if steps is None or step in steps}


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
