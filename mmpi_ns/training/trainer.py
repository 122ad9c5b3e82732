"""nerfstudio's trainer with phases, one window after the other, and checkpoints that resume exactly."""

from __future__ import annotations

import copy
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Literal, NoReturn, cast

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms, writer

from mmpi_ns.data.checks import LOAD_RUNS
from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.data.dataset import image_and_mask
from mmpi_ns.ops import dispatch
from mmpi_ns.placement.defaults import DEFAULTS, rays_times
from mmpi_ns.rendering.details import DETAILS_FOLDER, details_of, moved_cameras, write_details
from mmpi_ns.rendering.pipeline import MMPIPipeline
from mmpi_ns.rendering.rendered import BACKGROUNDS, bounded
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.agreement import RAYS as AGREEMENT_RAYS
from mmpi_ns.training.agreement import disagreement
from mmpi_ns.training.checkpoints import (
    PLAN_FILE,
    cameras_in_short,
    check_same_run,
    checkpoint_to_load,
    checkpoints_in,
    claim,
    read_checkpoint,
    states_of,
    write_plan,
)
from mmpi_ns.training.learning_rates import PhaseSchedulerConfig
from mmpi_ns.training.memory import Work, describe, training_bytes
from mmpi_ns.training.options import check_command, check_nothing_left, check_run
from mmpi_ns.training.report import TrainingLog, forecast, next_commands, quick_test
from mmpi_ns.training.run import WINDOWS_FOLDER, TrainingRun, WindowShare, cameras_of, views_of
from mmpi_ns.training.step_graph import StepGraphs
from mmpi_ns.utils.errors import InputError, duration, quoted, say
from mmpi_ns.utils.files import write_atomically
from mmpi_ns.utils.host import command, discard, enter_command, signals_go_to, values_of
from mmpi_ns.utils.machine import free_cores, unused_gpu
from mmpi_ns.utils.parallel import num_threads, one_thread_each, torch_apart
from mmpi_ns.utils.random_draws import generator


@dataclass
class MMPITrainerConfig(TrainerConfig):
    """nerfstudio's trainer settings."""

    _target: type = field(default_factory=lambda: MMPITrainer)
    max_num_iterations: int = 0
    """Steps of the whole run, resumed or not; if a long capture is split into windows, of each window. 0: as many as
    its pixels need (mmpi-small: 2,500 to 12,000; docs/captures.md)."""
    graphs: bool = True
    """On a GPU: repeat steps as CUDA graphs, several times faster than one operation at a time (docs/gpu.md)."""

    def set_timestamp(self) -> None:
        """The first code of this package that ns-train runs."""
        enter_command()
        super().set_timestamp()

    def get_checkpoint_dir(self) -> Path:
        """The first code of this package that ns-eval, ns-render and ns-viewer run.

        They take every file in this folder for a checkpoint, so the last one is given explicitly. Where a run was moved
        and the folder that its config.yml names is gone, checkpoints and windows are looked for beside that file.
        """
        enter_command()
        model, folder = cast(Any, self.pipeline.model), super().get_checkpoint_dir()
        check_nothing_left(model)
        check_command()
        if command() == "ns-render":
            manager: Any = self.pipeline.datamanager
            manager.backdrop = BACKGROUNDS[model.rendering.background]
        for config_file in values_of("--load-config") if command() in LOAD_RUNS and not folder.is_dir() else ():
            moved = Path(config_file).absolute().parent / self.relative_model_dir
            if moved.is_dir():
                folder, model.windows_folder = moved, moved.parent / model.windows_folder.name
        steps = checkpoints_in(folder)
        if steps and self.load_dir in (None, folder) and self.load_step is None and self.load_checkpoint is None:
            self.load_step = max(steps)
            read_checkpoint(steps[self.load_step])
        return folder

    def get_base_dir(self) -> Path:
        """The folder of the run. The last code of this package before ns-viewer opens its server.

        ns-viewer takes the address from its own options, whose default is every address of the machine.
        """
        if command() == "ns-viewer" and not values_of("--viewer.websocket-host"):
            self.viewer.websocket_host = "127.0.0.1"
        return super().get_base_dir()

    def print_to_terminal(self) -> None:
        """Prints where all settings are, which are more than a terminal has lines."""
        say(f"All settings of this run: {self.get_base_dir() / 'config.yml'}")

    def save_config(self) -> None:
        """Checks the options, locks the run's folder, and writes config.yml.

        It tells ns-eval and ns-render where the capture and the windows are, from whatever folder they are started, but
        not which checkpoint this run resumes from, which they must not load.
        """
        check_run(self)
        if comms.get_world_size() == 1:  # processes that share windows look for those of each
            checkpoint_to_load(self)
        folder = self.get_base_dir()
        claim(folder, self.get_checkpoint_dir(), self.load_checkpoint or self.load_dir)
        written = copy.deepcopy(self)
        written.load_dir = written.load_step = written.load_checkpoint = None
        manager: Any = written.pipeline.datamanager
        for part, name in ((written, "output_dir"), (written, "data"), (manager, "data"), (manager.dataparser, "data")):
            path = getattr(part, name)
            if path not in (None, Path()):
                setattr(part, name, path.absolute())
        written.pipeline.model.windows_folder = (folder / WINDOWS_FOLDER).absolute()  # type: ignore[attr-defined]
        TrainerConfig.save_config(written)


class MMPITrainer(Trainer):
    """Trainer with phases, exact resume and atomic checkpoints."""

    config: MMPITrainerConfig

    # Before the first step ----------------------------------------------------------------------------------------

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Prepares the run; a signal during this time ends it with a sentence (of several processes: torchrun's)."""
        # Images are shared among threads; those of the libraries would only spin between small operations.
        with signals_go_to(_end) if self.world_size == 1 else nullcontext(), one_thread_each():
            enter_command(training=True)
            if str(self.device).startswith("cuda"):  # kernels start on the current device, which is the first otherwise
                torch.cuda.set_device(self.local_rank)
            self._stopped_by: int | None = None
            self._compared = False
            self._log: TrainingLog | None = None
            self._began = monotonic()
            config = self.config
            model_config: Any = config.pipeline.model
            model_config.seed = config.pipeline.datamanager.seed = config.machine.seed  # type: ignore[attr-defined]
            model_config.total_steps = config.max_num_iterations
            model_config.method, self._follows_capture = config.method_name, config.max_num_iterations == 0
            model_config.windows_folder = self.base_dir / WINDOWS_FOLDER
            # More rays a step on a large GPU, in as many fewer steps, where neither was asked for.
            manager: Any = config.pipeline.datamanager
            method, rays = str(model_config.method), manager.train_num_rays_per_batch
            asked = values_of("--pipeline.datamanager.train-num-rays-per-batch")
            may_change = self._follows_capture and not asked and str(self.device).startswith("cuda")
            if may_change and rays == DEFAULTS[method].rays:
                processors = torch.cuda.get_device_properties(self.device).multi_processor_count
                model_config.rays_times = times = rays_times(method, processors)
                manager.train_num_rays_per_batch, manager.keypoint_rays = times * rays, times * manager.keypoint_rays
            self._share: WindowShare | None = None
            if self.world_size > 1:
                folders = [self.checkpoint_dir, *([config.load_dir] if config.load_dir else [])]
                self._share = WindowShare(comms.get_rank(), self.world_size, folders)
                # Processes share the windows; nerfstudio would make them average their gradients.
                self.world_size, config.load_dir = 1, None
            self._says_lines, config.logging.local_writer.enable = config.logging.local_writer.enable, False
            super().setup(test_mode)
            config.max_num_iterations = self._window_steps
            plan = self._run.progress.windows
            self.base_dir.mkdir(parents=True, exist_ok=True)
            write_plan(self.base_dir / PLAN_FILE, plan)
            self._run.shared = self._share is not None
            if len(self._run.field.density) <= BRICK:  # the empty brick alone
                raise InputError(
                    "No training image sees anything of the scene plan: its MPIs must stand among the cameras and face "
                    "as they do (mmpi-plan shows where)."
                )
            self._graphs: StepGraphs | None = None
            if self._repeats():
                model: Any = self.pipeline.model
                self._graphs = StepGraphs(model, self._manager, self.optimizers.optimizers)
            self._announce(plan)
            if self._share is not None and len(plan) < self._share.processes:
                raise InputError(
                    f"The capture has {len(plan)} window(s), too few to share out among {self._share.processes} "
                    "processes: start fewer, or make windows shorter with --pipeline.model.placement.window-length."
                )

    def _repeats(self) -> bool:
        """Whether steps can be graphs: on a GPU by its kernels, where nobody asks for more than the method does."""
        config, field = self.config, self._run.field
        return (
            config.graphs
            and field.density.is_cuda
            and dispatch.form_of("march", field.density) == "gpu"
            and not (self._run.poses or self.mixed_precision or self.use_grad_scaler or config.log_gradients)
            and all(each["optimizer"].max_norm is None for each in self.optimizers.config.values())
            and all(count == 1 for count in self.gradient_accumulation_steps.values())
        )

    def _announce(self, plan: WindowedPlan) -> None:
        """Prints capture, plan, memory and expected time together, before the first step."""
        run, manager, windows = self._run, self._manager, plan.windows
        work = Work(run.field.feature_channels, any(phase.name == "blend" for phase in run.progress.schedule.phases))
        tables = [training_bytes(w.plan, views_of(w, run.views), work, self.device) for w in windows]
        cameras = [None] if len(windows) == 1 else [cameras_of(w, manager.observations.centers) for w in windows]
        say(manager.describe())
        say(describe(plan, self._window_steps, tables, [manager.pixel_bytes(c) for c in cameras]))
        if self._follows_capture:
            rays, times = self._manager.config.train_num_rays_per_batch, self.config.pipeline.model.rays_times  # type: ignore[attr-defined]
            say(
                f"{self._window_steps:,} steps{' a window' if len(plan) > 1 else ''} for its training pixels; "
                "--max-num-iterations gives others."
                + (f" {rays:,} rays a step, {times} times the method's, suit this GPU." if times > 1 else "")
            )
        if not str(self.device).startswith("cuda"):
            rays = self._manager.get_train_rays_per_batch()
            say(forecast(self.config.method_name or "", self._total_steps, rays, num_threads(), free_cores()))
            if gpu := unused_gpu():
                say(f"No GPU is used: {gpu}.")

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with schedulers that follow the phases."""
        run, manager = getattr(self.pipeline.model, "run", None), self.pipeline.datamanager
        assert isinstance(run, TrainingRun) and isinstance(manager, MMPIDataManager), "MMPITrainer trains MMPIModel"
        self._run, self._manager, progress = run, manager, run.progress
        self._window_steps = progress.schedule.window_steps
        # Rays of a step by kind; those of new views follow the pixels'.
        self._rays = {"pixel": manager.config.train_num_rays_per_batch, "keypoint": manager.config.keypoint_rays}
        if self._follows_capture:
            self.config.steps_per_save = max(self.config.steps_per_save, self._window_steps // 4)
        self._total_steps = self.config.max_num_iterations = progress.schedule.total_steps  # nerfstudio shows these
        config: dict[str, Any] = {
            name: entry | {"scheduler": copy.copy(entry["scheduler"])} for name, entry in self.config.optimizers.items()
        }
        for entry in config.values():
            if isinstance(entry["scheduler"], PhaseSchedulerConfig):
                vars(entry["scheduler"])["progress"] = progress
        return Optimizers(config, self.pipeline.get_param_groups())

    # Steps --------------------------------------------------------------------------------------------------------

    def train(self) -> None:
        """Runs max-num-iterations in total (a window); nerfstudio 1.1.5 would run as many again after a resume."""
        if self._share is not None:
            for window in self._share.unfinished(self._run.progress, self._run.store):
                self.train_window(window)
            if self._share.rank == 0:
                self._write_details(self._total_steps - 1)
            return
        if self._start_step >= self._total_steps:
            # A finished run lacks its details where it was stopped meanwhile.
            self._last_step = self._start_step - 1
            shows_details = cast(Any, self.pipeline.model).config.rendering.nearest_images
            is_last = self._start_step == self._total_steps
            lacks = is_last and shows_details and self._last_step in checkpoints_in(self.checkpoint_dir)
            with suppress(InputError):  # damaged ones are made again
                lacks = lacks and details_of(self.base_dir / DETAILS_FOLDER, self._last_step) is None
            left = "details of its training images are made" if lacks else "nothing to do"
            say(f"The checkpoint already holds {self._start_step} of {self._total_steps} steps: {left}.")
            if lacks:
                self._complete()
            return

        def stop(number: int) -> None:  # nerfstudio's loop ends after the current step, even if training is paused
            self._stopped_by, self.stop_training = number, True

        with signals_go_to(stop):
            self._train_until(self._total_steps)
        if self._stopped_by is not None:
            self.config.logging.profiler = "none"  # nothing more is said
            path = checkpoints_in(self.checkpoint_dir).get(self._last_step)
            if path is None:  # training was paused
                _end(self._stopped_by)
            _end(
                self._stopped_by,
                f"Stopped after step {self._last_step + 1} of {self._total_steps}, which is in {path}: the same "
                f"command with --load-dir {quoted(self.checkpoint_dir)} continues from there.",
            )

    def train_window(self, window: int) -> None:
        """Trains one window of several, from where the resumed run left it."""
        steps = self._run.progress.schedule.steps_of(window)
        checkpoints = {} if self._share is None else self._share.checkpoints_of(steps)
        self._start_step = steps.start
        if checkpoints:
            self.config.load_checkpoint = checkpoints[max(checkpoints)]
            self._load_checkpoint()
            self.config.load_checkpoint = None
        self._train_until(steps.stop)
        if window != len(self._run.progress.windows) - 1:  # its file is all that is needed of it
            for path in checkpoints_in(self.checkpoint_dir, steps).values():
                path.unlink()

    def _train_until(self, end: int) -> None:
        """Trains from the first step to that before ``end``."""
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = max(0, end - self._start_step)
        rays = self._manager.get_train_rays_per_batch()
        schedule = self._run.progress.schedule
        self._log = TrainingLog(schedule, rays, self._start_step, end) if self._says_lines else None
        try:
            with torch_apart():
                super().train()
        finally:
            self.config.max_num_iterations = self._window_steps

    def kernels_differ(self) -> str:
        """What the compiled operations compute otherwise than plain torch on a small batch of rays, in words."""
        run, model, sources = self._run, cast(Any, self.pipeline.model), self._manager.sources
        assert sources is not None, "a step has drawn rays"
        progress, field = run.progress, run.field
        g = generator(model.config.seed, progress.step, "agreement", self.device)
        bundle, _ = sources.draw(AGREEMENT_RAYS, g)
        forming = not progress.schedule.sharpened(progress.step)
        options = model.config.sampling.options(field.plan, forming, model.blends(field))
        return disagreement(field, bounded(bundle, field.plan), options)

    def train_iteration(self, step: int) -> Any:
        """One step; records that it ran, and saves a window of several after its last step."""
        if not self._compared and str(self.device).startswith("cuda"):
            self._compared = True
            if differs := self.kernels_differ():
                say(
                    f"Plain torch is used, several times slower: this GPU's kernels differ from it ({differs}).",
                    "yellow",
                )
                dispatch.choose("torch")
        if self._graphs is None or self._graphs.is_off:
            loss, *others = super().train_iteration(step)
        else:
            loss, *others = self._graphs.step(step)
            self.optimizers.scheduler_step_all(step)
        self._last_step = step
        if self._log is not None:
            self._log.note(step, others[0]["rgb_loss"])
        if self._stopped_by is not None:  # nerfstudio forgets what was said before its loop
            self.stop_training = True
        run, progress = self._run, self._run.progress
        if len(progress.windows) > 1 and (step + 1) % progress.schedule.window_steps == 0:
            run.store.save(progress.window, run.field)
        for values in others:
            values.update({name: v.detach() for name, v in values.items() if isinstance(v, torch.Tensor)})
        return loss.detach(), *others

    def _after_train(self) -> None:
        """Saves with the number of the last step that ran; nerfstudio 1.1.5 would use the next one after a stop."""
        self.step = self._last_step
        self.training_state = "completed"
        self.save_checkpoint(self.step)
        writer.write_out_storage()
        if self._stopped_by is not None or self._share is not None:
            return
        self._complete()
        if not self.config.viewer.quit_on_train_completion:
            with signals_go_to(lambda _: sys.exit()):  # as nerfstudio says here
                self._train_complete_viewer()

    def _complete(self) -> None:
        """What follows the last step: details, a quick test and the next commands."""
        last, folder = checkpoints_in(self.checkpoint_dir).get(self._last_step), quoted(self.checkpoint_dir)
        end = (
            f"Stopped after the last step, which is in {last}: the same command with --load-dir {folder} makes details."
        )
        with signals_go_to(lambda number: _end(number, end)):
            self._write_details(self._last_step)
            if steps := self._last_step + 1 - self._start_step:
                say(f"Training finished: {steps:,} steps in {duration(monotonic() - self._began)}.")
            if self._says_lines:
                say(quick_test(cast(MMPIPipeline, self.pipeline), self._manager.eval_dataset))
        say(next_commands(self.base_dir))

    def _write_details(self, step: int) -> None:
        """Keeps what the trained field lacks in its training images, if it is to be shown, as it is from now on."""
        model: Any = self.pipeline.model
        if not model.config.rendering.nearest_images:
            return
        model.eval()
        images, folder = self._manager.train_dataset, self.base_dir / DETAILS_FOLDER
        cameras = moved_cameras(images.cameras.to(model.device), model.camera_optimizer)
        render = model.get_outputs_for_camera_ray_bundle
        say(write_details(folder, step, cameras, model.exposures.factors, partial(image_and_mask, images), render))
        model.details = details_of(folder, step)

    # Checkpoints --------------------------------------------------------------------------------------------------

    def save_checkpoint(self, step: int) -> None:
        """Writes beside the checkpoint folder, then moves the file in, so a kill or a full disk loses nothing.

        Names inside the folder are parsed as steps by nerfstudio, so the unfinished file must not lie there.
        """
        if step < 0:
            return  # stopped before the first step: there is nothing to save
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        parts = {
            "schedulers": {k: v.state_dict() for k, v in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "rng": {"torch": torch.get_rng_state()},
            "rays": self._rays,
            "capture": {
                "data": str(self._manager.get_datapath()),
                "cameras": cameras_in_short(self._manager.observations),
            },
        }
        models = self.pipeline, self.optimizers.optimizers
        state = {"step": step, **parts, **states_of(*models, goes_on=step + 1 < self._total_steps)}
        write_atomically(path, lambda p: torch.save(state, p), self.base_dir)
        if self.config.save_only_latest_checkpoint:
            progress = self._run.progress  # checkpoints of other windows are other processes' work
            steps = None if self._share is None else progress.schedule.steps_of(progress.window)
            for old in checkpoints_in(self.checkpoint_dir, steps).values():
                if old != path:
                    old.unlink()

    def _load_checkpoint(self) -> None:
        path, run = checkpoint_to_load(self.config), self._run
        if path is not None:
            state, capture, model = read_checkpoint(path), self._manager, cast(Any, self.pipeline.model)
            here = (capture.get_datapath(), capture.observations, run.progress.windows)
            rays = self._rays if self._follows_capture else None
            check_same_run(state, path, *here, model.camera_optimizer.config.mode, rays)
            torch.set_rng_state(state["rng"]["torch"])
            del state
        # nerfstudio takes every file in load_dir for a checkpoint.
        asked, self.config.load_dir = self.config.load_dir, None
        asked_for, self.config.load_checkpoint = self.config.load_checkpoint, path
        super()._load_checkpoint()
        self.config.load_dir, self.config.load_checkpoint = asked, asked_for
        if path is not None and self._share is None:
            progress = run.progress
            finished = dict(enumerate(progress.windows.plans[: progress.schedule.window_at(self._start_step)]))
            run.store.adopt(path.parent.parent / WINDOWS_FOLDER, finished, needed=True)


def _end(number: int, sentence: str = "Stopped before the first step: there is nothing to go on from.") -> NoReturn:
    """Ends the process with the exit status of the signal (130 after Ctrl-C) and a sentence."""
    sys.stdout.flush()
    try:
        print(sentence, file=sys.stderr, flush=True)
    except BrokenPipeError:
        discard(2)
    raise SystemExit(128 + number)
