"""How often a training step waits for the device: numbers that the host reads, arrays whose size depends on them."""

from __future__ import annotations

import traceback
import warnings
import weakref
from collections import Counter, defaultdict
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation as At
from torch.utils._python_dispatch import TorchDispatchMode
from training_runs import ready, trainer_config

import mmpi_ns
from mmpi_ns.data.rays import CameraRays
from mmpi_ns.training.memory import ALLOCATOR_SHARE, Work, reserved_bytes

WAITING = {
    "_local_scalar_dense",
    "nonzero",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "masked_select",
    "equal",
    "bincount",
    "lift_fresh",  # torch.tensor of Python's numbers: a copy to the device that is waited for
}
"""Operations of torch that wait whatever they are given."""
NO_LAUNCH = ("empty", "new_empty", "lift_fresh")
"""What the names of operations begin with that work on the host alone."""
PACKAGE = Path(mmpi_ns.__file__).parent
STEPS = 8
TRAININGS = pytest.mark.parametrize(
    ("training", "phases"), [("joint", ["joint"]), ("two-phase", ["individual", "blend", "finetune"])]
)


class Waits(TorchDispatchMode):
    """Within, what would wait for a GPU is counted on a CPU, by the line that it comes from."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()
        self.launches = 0
        """Kernels, torch's and ours: operations that are no views and allocate nothing alone."""
        self.live = self.peak = 0
        """Bytes of arrays that were made within and are there still, and the most that there were."""
        self.reserved = 0
        """Bytes that are kept free for a step (``step_bytes``)."""
        self._paused = False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        by_mask = name in ("index", "index_put", "index_put_") and any(
            i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]
        )
        by_counts = name == "repeat_interleave" and not (kwargs or {}).get("output_size")
        if name in WAITING or by_mask or by_counts:
            self.note(name)
        self.launches += not (self._paused or func.is_view or name.startswith(NO_LAUNCH))
        made = func(*args, **(kwargs or {}))
        if not (self._paused or func.is_view or name.endswith("_")):
            for x in made if isinstance(made, tuple | list) else [made]:
                if isinstance(x, torch.Tensor):
                    self._weigh(x.untyped_storage())
        return made

    def _weigh(self, storage) -> None:
        size = storage.nbytes()

        def gone() -> None:
            self.live -= size

        self.live += size
        self.peak = max(self.peak, self.live)
        weakref.finalize(storage, gone)

    def note(self, name: str) -> None:
        if self._paused:
            return
        stack = [f for f in traceback.extract_stack() if "nerfstudio" in f.filename or str(PACKAGE) in f.filename]
        place = f"{Path(stack[-1].filename).name}:{stack[-1].lineno} {stack[-1].name}" if stack else "elsewhere"
        self.found[f"{name} at {place}"] += 1

    @contextmanager
    def paused(self):
        """Within, nothing is counted: Triton's interpreter reads what a GPU's kernels would."""
        before, self._paused = self._paused, True
        try:
            yield
        finally:
            self._paused = before


@contextmanager
def counted_on_a_cpu(monkeypatch):
    """What runs within, by Triton's interpreter, would wait for a GPU as often as this counts."""
    from triton.runtime.interpreter import GridExecutor

    waits, launch = Waits(), GridExecutor.__call__

    def quietly(self, *args, **kwargs):
        waits.launches += 1
        with waits.paused():
            return launch(self, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(GridExecutor, "__call__", quietly)
        for name in ("tolist", "numpy", "cpu"):  # on a CPU they pass torch's operations by
            patch.setattr(torch.Tensor, name, _noted(waits, name))
        with waits:
            yield waits


@contextmanager
def variants_noted(monkeypatch):
    """What a GPU would compile for the launches within, by Triton's interpreter: {kernel: different sets of types,
    constants, and sizes and addresses that are specialised}."""
    from triton.runtime.interpreter import InterpretedFunction

    found, run = defaultdict(set), InterpretedFunction.run

    def noted(self, *args, grid, warmup, **kwargs):
        plain = self.kwargs.get("do_not_specialize") or ()
        given = dict(zip(self.arg_names, args, strict=False))
        key = tuple((name, _specialised(x, name in plain)) for name, x in given.items())
        found[self.fn.__name__].add((key, tuple(kwargs.items())))
        return run(self, *args, grid=grid, warmup=warmup, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(InterpretedFunction, "run", noted)
        yield found


def _specialised(x, plain):
    """What of an argument a compiled kernel depends on."""
    if isinstance(x, torch.Tensor):
        return x.dtype, not plain and x.data_ptr() % 16 == 0
    if type(x) is not int:
        return type(x)
    return abs(x) >= 2**31, not plain and (1 if x == 1 else x % 16 == 0)


def _noted(waits, name):
    work = getattr(torch.Tensor, name)

    def noted(self, *args, **kwargs):
        waits.note(name)
        with waits.paused():
            return work(self, *args, **kwargs)

    return noted


@contextmanager
def counted_on_a_gpu():
    """How often what runs within waits for the GPU, as torch says; launches are not counted."""
    waits = Waits()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            yield waits
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for w in said:
        if "synchronizing" in str(w.message):
            waits.found[f"{Path(w.filename).name}:{w.lineno}"] += 1


def step_bytes(plan, work):
    """What is reserved on a GPU for the arrays of a step alone."""
    both = (reserved_bytes(plan, each, "cuda") for each in (work, replace(work, pixel_rays=0)))
    return (next(both) - next(both)) / (1 + ALLOCATOR_SHARE)


def waits_of_phases(scene, plan_file, folder, training, device, counted):
    """What the last step of each phase waits for: {phase: Waits}."""
    config = trainer_config(scene, plan_file, folder, steps=STEPS, training=training, growth_shares=(), shading="ray")
    config.pipeline.datamanager.train_num_rays_per_batch, config.pipeline.datamanager.keypoint_rays = 16, 8
    config.machine.device_type = device
    trainer = ready(config)
    trainer.pipeline.train()
    model = trainer.pipeline.model
    work = Work(model.field.feature_channels, training == "two-phase", 16, model.config.sampling.threshold)
    reserved = step_bytes(model.progress.windows.plans[0], work)
    manager, found = trainer.pipeline.datamanager, {}
    del manager.train_ray_generator
    manager.train_ray_generator = CameraRays.of(manager.train_dataset.cameras, device)  # on a CPU as on a GPU
    schedule = trainer.pipeline.model.progress.schedule
    phases = [schedule.phase_at(step).name for step in range(STEPS)]
    for step, phase in enumerate(phases):
        if phase not in phases[step + 1 :]:
            with counted() as waits:
                _run(trainer, step)
            found[phase] = waits
            waits.reserved = reserved
        else:
            _run(trainer, step)  # packs the scene's constants
    return found


def _run(trainer, step):
    """One step as nerfstudio's loop makes it."""
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=At.AFTER_TRAIN_ITERATION)
