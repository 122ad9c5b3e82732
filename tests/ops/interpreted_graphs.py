"""Recorded steps beside steps one operation at a time, on the GPU's path: run like interpreted.py. What a CUDA graph
does, on a CPU: the operations of a function are recorded, and repeated on the same memory."""

from __future__ import annotations

import functools

import pytest
import torch
from compiled import interpreted  # noqa: F401
from nerfstudio.engine.callbacks import TrainingCallbackLocation as At
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only
from training_runs import ready, trainer_config

from mmpi_ns.data.rays import CameraRays
from mmpi_ns.training import step_graph
from mmpi_ns.training.step_graph import MEASURED, StepGraphs

WAITING = {
    "_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "unique_consecutive", "masked_select", "equal",
    "bincount", "lift_fresh",
}  # fmt: skip
"""Operations of torch that wait for a GPU whatever they are given; no graph may hold one."""


class Tape(TorchDispatchMode):
    """Records operations of torch, and launches of Triton's interpreter. Unlike a graph it also runs them."""

    def __init__(self) -> None:
        super().__init__()
        self.done = []
        self.paused = False
        self.waits = []
        """Operations that a GPU would be waited for."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        made = func(*args, **kwargs)
        if not (self.paused or func.is_view):
            name = func.overloadpacket.__name__
            by_mask = name.startswith("index") and any(
                isinstance(i, torch.Tensor) and i.dtype in (torch.bool, torch.uint8)
                for i in (args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else ())
            )
            if name in WAITING or by_mask:
                self.waits.append(name)
            self.done.append((func, *tree_map_only(torch.Tensor, lambda x: x.detach(), (args, kwargs, made))))
        return made

    @property
    def launches(self) -> list:
        """Names of the operations and kernels that a GPU is given, with the sizes of their tensors."""
        listed = []
        for func, args, kwargs, _ in self.done:
            if not ("empty" in func.__name__ or func.__name__.startswith("_record_function")):
                tensors = (x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor))
                listed.append((func.__name__, [tuple(x.shape) for x in tensors]))
        return listed

    @torch.no_grad()
    def replay(self) -> None:
        for func, args, kwargs, made in self.done:
            again = func(*args, **kwargs)
            if func.__class__.__name__ != "OpOverload":
                continue
            for old, new in zip(_tensors(made), _tensors(again), strict=True):
                assert old.shape == new.shape, (func, old.shape, new.shape)
                if old.data_ptr() != new.data_ptr() and "empty" not in func.name():
                    old.copy_(new)


def _tensors(made):
    return [x for x in (made if isinstance(made, tuple | list) else [made]) if isinstance(x, torch.Tensor)]


class TapeRecorder:
    """Takes the place of ``step_graph.Recorder``. A graph records without running; so what the function changes must
    be put back by ``undo``."""

    def __init__(self, state):
        self.state, self.tapes = state, []

    def record(self, run, generators):
        from triton.runtime.interpreter import GridExecutor

        tape, launch = Tape(), GridExecutor.__call__

        def noted(executor, *args, **kwargs):
            again = functools.wraps(executor.fn)(lambda *_: launch(executor, *args, **kwargs))
            tape.done.append((again, args, {}, None))
            tape.paused = True
            try:
                return launch(executor, *args, **kwargs)
            finally:
                tape.paused = False

        before = [x.clone() for x in self.state()]
        GridExecutor.__call__ = noted
        try:
            with tape:
                run()
        finally:
            GridExecutor.__call__ = launch
        with torch.no_grad():
            for x, old in zip(self.state(), before, strict=True):
                x.copy_(old)
        self.tapes.append(tape)
        return tape


STEPS = 16
MOST = {"joint": (118, 142), "individual": (268, 292), "blend": (221, 0), "finetune": (294, 0)}
"""Launches of a step in each phase, without and with total variation (0: none such here), of two MPIs and a cube: the
numbers of docs/gpu.md."""


def prepared(scene, plan_file, folder, training="joint", shading="ray", recorder=None):
    """A function that trains a step, and the graphs that it does it with."""
    config = trainer_config(scene, plan_file, folder, steps=STEPS, training=training, growth_shares=(), shading=shading)
    config.pipeline.datamanager.train_num_rays_per_batch, config.pipeline.datamanager.keypoint_rays = 8, 4
    trainer = ready(config)
    trainer.pipeline.train()
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    del manager.train_ray_generator
    manager.train_ray_generator = CameraRays.of(manager.train_dataset.cameras, "cpu")
    optimizers = trainer.optimizers.optimizers

    def state():
        yield from (p.data for p in model.field.parameters())
        yield from (model.field.peak, model.field.gain, model.field.crossings, model.field.touched)
        for optimizer in optimizers.values():
            for each in optimizer.state.values():
                yield each["moments"]

    recorder = recorder or TapeRecorder(state)
    graphs = StepGraphs(model, manager, optimizers, lambda: recorder)

    def run(step):
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
        total, losses, metrics = graphs.step(step)
        trainer.optimizers.scheduler_step_all(step)
        return [total, *losses.values(), *metrics.values()]

    return run, graphs, recorder


@pytest.mark.parametrize(("training", "shading"), [("joint", "ray"), ("two-phase", "sample")])
def test_recorded_steps_train_what_steps_one_operation_at_a_time_do(scene, plan_file, tmp_path, training, shading):
    run, graphs, recorder = prepared(scene, plan_file, tmp_path / "a", training, shading)
    plain, by_operations, _ = prepared(scene, plan_file, tmp_path / "b", training, shading)
    by_operations.is_off, by_operations.manager._is_replayed = True, False  # which draws as on a CPU
    for step in range(STEPS):
        said, expected = run(step), plain(step)
        assert len(said) == len(expected)
        for x, y in zip(said, expected, strict=True):
            torch.testing.assert_close(x, y, rtol=2e-4, atol=1e-6, msg=f"step {step}: {x} {y}")
    for a, b in zip(graphs.model.field.parameters(), by_operations.model.field.parameters(), strict=True):
        torch.testing.assert_close(a.data, b.data, rtol=1e-3, atol=1e-4)
    assert not graphs.is_off and not graphs.lost and by_operations.repeated == 0
    assert graphs.repeated >= STEPS - 5 * MEASURED
    assert not any(tape.waits for tape in recorder.tapes)


@pytest.mark.parametrize(("training", "shading"), [("joint", "ray"), ("two-phase", "sample")])
def test_a_step_has_few_launches_and_another_of_its_kind_the_same(scene, plan_file, tmp_path, training, shading):
    run, graphs, recorder = prepared(scene, plan_file, tmp_path, training, shading)
    first, most = {}, {phase: [0, 0] for phase in MOST}
    for step in range(STEPS):
        graphs._drop()  # so that this step is recorded
        known = len(recorder.tapes)
        run(step)
        if launches := [each for tape in recorder.tapes[known:] for each in tape.launches]:
            phase = graphs.model.progress.schedule.phase_at(step).name
            varies = graphs._kind(step)[0]
            most[phase][varies] = max(most[phase][varies], len(launches))
            assert launches == first.setdefault((phase, graphs._kind(step), graphs.capacity), launches)
    assert all(a <= b for phase in MOST for a, b in zip(most[phase], MOST[phase], strict=True)), most
    assert any(map(any, most.values())) and not any(tape.waits for tape in recorder.tapes)


def test_a_step_that_does_not_fit_changes_nothing_and_the_next_one_has_room(scene, plan_file, tmp_path):
    run, graphs, _ = prepared(scene, plan_file, tmp_path)
    for step in range(2 + MEASURED):  # the first steps are of their own kind
        run(step)
    room = graphs.capacity
    graphs.capacity = room._replace(samples=(room.samples - step_graph.MORE) // 2)
    before, repeated = [p.data.clone() for p in graphs.model.field.parameters()], graphs.repeated
    run(2 + MEASURED)
    assert graphs.repeated == repeated + 1
    assert all(torch.equal(a, p.data) for a, p in zip(before, graphs.model.field.parameters(), strict=True))
    run(3 + MEASURED)
    assert graphs.lost == 1 and graphs.capacity.samples >= room.samples
    assert not all(torch.equal(a, p.data) for a, p in zip(before, graphs.model.field.parameters(), strict=True))


def test_a_run_goes_on_where_steps_cannot_be_recorded(scene, plan_file, tmp_path, capsys):
    class Refuses:
        def record(self, *_):
            raise RuntimeError("operation not permitted when stream is capturing. More")

    run, graphs, _ = prepared(scene, plan_file, tmp_path, recorder=Refuses())
    for step in range(4 + MEASURED):
        run(step)
    assert graphs.is_off and graphs.repeated == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("operation not permitted when stream is capturing") == 1
