"""nerfstudio's trainer with phases, one window after the other, and checkpoints that resume exactly."""

from __future__ import annotations

import sys
from functools import partial
from time import monotonic
from typing import Any, Literal, NoReturn, cast

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from nerfstudio.viewer.viewer import Viewer
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.data.dataset import image_and_mask
from mmpi_ns.ops import dispatch
from mmpi_ns.placement.defaults import RAYS, rays_times
from mmpi_ns.rendering.details import DETAILS_FOLDER, details_of, moved_cameras, write_details
from mmpi_ns.rendering.pipeline import MMPIPipeline
from mmpi_ns.rendering.rendered import RenderedRays, bounded
from mmpi_ns.sampler import march_options
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.settings import MMPITrainerConfig
from mmpi_ns.training.agreement import RAYS as AGREEMENT_RAYS
from mmpi_ns.training.agreement import disagreement
from mmpi_ns.training.checkpoints import (
    PLAN_FILE,
    WINDOWS_FOLDER,
    cameras_in_short,
    check_same_run,
    checkpoint_to_load,
    checkpoints_in,
    read_checkpoint,
    states_of,
)
from mmpi_ns.training.frames import FrameTurns
from mmpi_ns.training.losses import batch_losses
from mmpi_ns.training.memory import describe, texel_bytes, training_bytes
from mmpi_ns.training.report import TrainingLog, next_commands, quick_test
from mmpi_ns.training.run import TrainingRun, views_of
from mmpi_ns.training.step_graph import StepGraphs
from mmpi_ns.utils.errors import InputError, duration, log, quoted
from mmpi_ns.utils.files import write_atomically, write_plan
from mmpi_ns.utils.host import discard, keep_freed_memory, signals_go_to
from mmpi_ns.utils.machine import unused_gpu
from mmpi_ns.utils.parallel import one_thread_each, torch_apart
from mmpi_ns.utils.random_draws import generator


class MMPITrainer(Trainer):
    """Trainer with phases, exact resume and atomic checkpoints."""

    config: MMPITrainerConfig

    # Before the first step ----------------------------------------------------------------------------------------

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Prepares the run; a signal during this time ends it with a sentence."""
        # Images are distributed among threads; those of the libraries would only spin between small operations.
        with signals_go_to(_end), one_thread_each():
            if str(self.device).startswith("cuda"):  # kernels start on the current device, which is the first otherwise
                torch.cuda.set_device(self.local_rank)
            self.turns = FrameTurns(lambda: self.training_state == "training")
            self._stopped_by: int | None = None
            self._log: TrainingLog | None = None
            self._began = monotonic()
            config = self.config
            model_config: Any = config.pipeline.model
            self._compared = model_config.ops == "torch"
            model_config.seed = config.pipeline.datamanager.seed = config.machine.seed  # type: ignore[attr-defined]
            model_config.total_steps = config.max_num_iterations
            self._follows_capture = config.max_num_iterations == 0
            model_config.windows_folder = self.base_dir / WINDOWS_FOLDER
            # More rays per step on a large GPU, in as many fewer steps, unless either is set.
            manager: Any = config.pipeline.datamanager
            on_gpu = str(self.device).startswith("cuda")
            if self._follows_capture and on_gpu and manager.train_num_rays_per_batch == RAYS:
                processors = torch.cuda.get_device_properties(self.device).multi_processor_count
                model_config.rays_times = times = rays_times(processors)
                manager.train_num_rays_per_batch, manager.keypoint_rays = times * RAYS, times * manager.keypoint_rays
            self._logs_lines, config.logging.local_writer.enable = config.logging.local_writer.enable, False
            super().setup(test_mode)
            config.max_num_iterations = self._window_steps
            plan = self._run.progress.windows
            self.base_dir.mkdir(parents=True, exist_ok=True)
            write_plan(self.base_dir / PLAN_FILE, plan.to_json())
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

    def _repeats(self) -> bool:
        """Whether steps can be CUDA graphs: on a GPU with its kernels, without options that need ordinary steps."""
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
        per_texel = texel_bytes(run.field.feature_channels, not run.progress.schedule.is_joint)
        held = max(training_bytes(w.plan, views_of(w, run.views), per_texel, self.device) for w in windows)
        log(manager.describe())
        log(describe(plan, self._window_steps, held))
        if self._follows_capture:
            rays, times = self._manager.config.train_num_rays_per_batch, self.config.pipeline.model.rays_times  # type: ignore[attr-defined]
            log(
                f"{self._window_steps:,} steps{' a window' if len(plan) > 1 else ''} for its training pixels; "
                "--max-num-iterations gives others."
                + (f" {rays:,} rays a step, {times} times the method's, suit this GPU." if times > 1 else "")
            )
        if not str(self.device).startswith("cuda") and (gpu := unused_gpu()):
            log(f"No GPU is used: {gpu}.")

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's optimisers, with rates of the schedule where no other scheduler is configured."""
        run, manager = getattr(self.pipeline.model, "run", None), self.pipeline.datamanager
        assert isinstance(run, TrainingRun) and isinstance(manager, MMPIDataManager), "MMPITrainer trains MMPIModel"
        self._run, self._manager, progress = run, manager, run.progress
        self._window_steps = progress.schedule.window_steps
        # Rays of a step by kind; those of new views follow the pixels'.
        self._rays = {"pixel": manager.config.train_num_rays_per_batch, "keypoint": manager.config.keypoint_rays}
        self.config.steps_per_save = self.config.steps_per_save or max(500, self._window_steps // 4)
        self._total_steps = self.config.max_num_iterations = progress.schedule.total_steps  # nerfstudio shows these
        optimizers = Optimizers(self.config.optimizers, self.pipeline.get_param_groups())
        for kind, optimizer in optimizers.optimizers.items():
            if kind not in optimizers.schedulers:  # of the run's schedule, also if a checkpoint replaces it
                factor = lambda step, kind=kind: progress.schedule.rate_factor(kind, step)  # noqa: E731
                optimizers.schedulers[kind] = LambdaLR(optimizer, factor)
        return optimizers

    # Steps --------------------------------------------------------------------------------------------------------

    def train(self) -> None:
        """Runs max-num-iterations in total (a window); nerfstudio 1.1.5 would run as many again after a resume."""
        if self._start_step >= self._total_steps:
            log(f"The checkpoint already holds {self._start_step} of {self._total_steps} steps.")
            self._last_step = self._start_step - 1
            self.save_checkpoint(self._last_step)
            self._complete()  # an interrupted run lacks its details
            return

        def stop(number: int) -> None:  # nerfstudio's loop ends after the current step, even if training is paused
            self._stopped_by, self.stop_training = number, True

        with signals_go_to(stop):
            self._train()
        if self._stopped_by is not None:
            self.config.logging.profiler = "none"  # no further output
            path = checkpoints_in(self.checkpoint_dir).get(self._last_step)
            if path is None:  # training was paused
                _end(self._stopped_by)
            _end(
                self._stopped_by,
                f"Stopped after step {self._last_step + 1} of {self._total_steps}, which is in {path}: the same "
                f"command with --load-dir {quoted(self.checkpoint_dir)} continues from there.",
            )

    def _train(self) -> None:
        self._last_step = self._start_step - 1
        self.config.max_num_iterations = self._total_steps - self._start_step
        if self._logs_lines:
            rays, schedule = self._manager.get_train_rays_per_batch(), self._run.progress.schedule
            self._log = TrainingLog(schedule, rays, self._start_step)
        try:
            with torch_apart(), keep_freed_memory():
                super().train()
        finally:
            self.config.max_num_iterations = self._window_steps

    def kernels_differ(self) -> str:
        """Description of the differences between compiled operations and plain torch on a small batch of rays."""
        run, model, sources = self._run, cast(Any, self.pipeline.model), self._manager.sources
        assert sources is not None, "a step has drawn rays"
        progress, field = run.progress, run.field
        g = generator(model.config.seed, progress.step, "agreement", self.device)
        bundle, batch = sources.draw(AGREEMENT_RAYS, g)
        forming = not progress.schedule.sharpened(progress.step)
        options = march_options(model.config.sampling, field.plan, forming, field.blends)

        def losses(rays: RenderedRays) -> dict[str, Tensor]:
            background = generator(model.config.seed, 0, "agreement", self.device)
            return batch_losses(rays, field, batch["image"][0], model.config.loss, background, 0)[0]

        return disagreement(field, bounded(bundle[0], field.plan), options, losses)

    def train_iteration(self, step: int) -> Any:
        """One step; records that it ran, and saves a window of several after its last step."""
        if not self._compared and str(self.device).startswith("cuda"):
            self._compared = True
            if differs := self.kernels_differ():
                log(
                    f"Plain torch is used, several times slower: this GPU's kernels differ from it ({differs}).",
                    "yellow",
                )
                dispatch.choose("torch")
                self._graphs = None
        if self._graphs is None or self._graphs.is_off:
            loss, *others = super().train_iteration(step)
        else:
            loss, *others = self._graphs.step(step)
            self.optimizers.scheduler_step_all(step)
        self._last_step = step
        if self._log is not None:
            self._log.note(step, others[0]["rgb_loss"])
        if self._stopped_by is not None:  # nerfstudio ignores requests made before its loop
            self.stop_training = True
        run, progress = self._run, self._run.progress
        if len(progress.windows) > 1 and (step + 1) % progress.schedule.window_steps == 0:
            run.store.save(progress.window, run.field)
        for values in others:
            values.update({name: v.detach() for name, v in values.items() if isinstance(v, torch.Tensor)})
        return loss.detach(), *others

    def _update_viewer_state(self, step: int) -> None:
        if isinstance(self.viewer_state, Viewer):
            self.turns.after_step(self.viewer_state, step)
        else:
            super()._update_viewer_state(step)

    def _after_train(self) -> None:
        """Saves with the number of the last step that ran; nerfstudio 1.1.5 would use the next one after a stop."""
        self.step = self._last_step
        self.training_state = "completed"
        self.save_checkpoint(self.step)
        writer.write_out_storage()
        if self._stopped_by is not None:
            return
        self._complete()
        if not self.config.viewer.quit_on_train_completion:
            with signals_go_to(lambda _: sys.exit()):  # as nerfstudio says here
                self._train_complete_viewer()

    def _complete(self) -> None:
        """Work after the last step: details, a quick test and the next commands."""
        last, folder = checkpoints_in(self.checkpoint_dir).get(self._last_step), quoted(self.checkpoint_dir)
        end = (
            f"Stopped after the last step, which is in {last}: the same command with --load-dir {folder} makes details."
        )
        with signals_go_to(lambda number: _end(number, end)):
            self._write_details(self._last_step)
            if steps := self._last_step + 1 - self._start_step:
                log(f"Training finished: {steps:,} steps in {duration(monotonic() - self._began)}.")
            if self._logs_lines:
                log(quick_test(cast(MMPIPipeline, self.pipeline), self._manager.eval_dataset))
        log(next_commands(self.base_dir))

    def _write_details(self, step: int) -> None:
        """Writes the details of the training images, if they are in use, and adds them to images from now on."""
        model: Any = self.pipeline.model
        if not model.config.rendering.nearest_images:
            return
        model.eval()
        images, folder = self._manager.train_dataset, self.base_dir / DETAILS_FOLDER
        cameras = moved_cameras(images.cameras.to(model.device), model.camera_optimizer)
        render = model.get_outputs_for_camera_ray_bundle
        log(write_details(folder, step, cameras, model.exposures.factors, partial(image_and_mask, images), render))
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
            for old in checkpoints_in(self.checkpoint_dir).values():
                if old != path:
                    old.unlink()

    def _load_checkpoint(self) -> None:
        path, run = checkpoint_to_load(self.config), self._run
        if path is not None:
            state, capture, model = read_checkpoint(path), self._manager, cast(Any, self.pipeline.model)
            here = (capture.get_datapath(), capture.observations, run.progress.windows, self._window_steps)
            rays = self._rays if self._follows_capture else None
            check_same_run(state, path, *here, model.camera_optimizer.config.mode, rays)
            torch.set_rng_state(state["rng"]["torch"])
            del state
        # nerfstudio takes every file in load_dir for a checkpoint.
        asked, self.config.load_dir = self.config.load_dir, None
        asked_for, self.config.load_checkpoint = self.config.load_checkpoint, path
        super()._load_checkpoint()
        self.config.load_dir, self.config.load_checkpoint = asked, asked_for
        if path is not None:
            progress = run.progress
            for kind, scheduler in self.optimizers.schedulers.items():
                if not self.config.optimizers[kind]["scheduler"]:  # at this step also with --load-scheduler False
                    scheduler.last_epoch = self._start_step
            run.field.views = views_of(progress.windows.windows[progress.window], run.views)
            finished = progress.schedule.window_at(self._start_step)
            run.store.adopt(path.parent.parent / WINDOWS_FOLDER, finished)


def _end(number: int, sentence: str = "Stopped before the first step: there is nothing to go on from.") -> NoReturn:
    """Ends the process with the exit status of the signal (130 after Ctrl-C) and a sentence."""
    sys.stdout.flush()
    try:
        print(sentence, file=sys.stderr, flush=True)
    except BrokenPipeError:
        discard(2)
    raise SystemExit(128 + number)
