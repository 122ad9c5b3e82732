"""A training step on a GPU as two CUDA graphs: rendering and gradients in one, the optimiser in the other.

A step launches some hundreds of small kernels, and the host needs longer to launch them than the GPU to run them. A
graph launches them at once. It replays a step on the same memory, so all sizes are fixed (``Capacity``), there is no
synchronisation, random streams are seeded from outside (``Generators``), and values that change are in tensors.

Steps of a kind are recorded after a few ordinary ones, which measure the number of samples. A step whose samples exceed
the capacity changes nothing. The host reads this some steps later and records again with a larger capacity.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.data.datamanager import MMPIDataManager
from mmpi_ns.ops.march import Capacity
from mmpi_ns.training.agreement import CLOSE, differences, gradients_of
from mmpi_ns.training.losses import TV_EVERY
from mmpi_ns.training.touched_adam import TouchedAdam
from mmpi_ns.utils.errors import brief, log
from mmpi_ns.utils.random_draws import Generators

MEASURED = 3
"""Steps after a change of the tables that are measured before one is recorded."""
MARGIN = 1.125
"""Capacity relative to the most samples so far: of a hundred steps none had more than 1.044 times those of the sixteen
before."""
MORE = 1024
"""Additional capacity in samples, and in rows."""
FULL = 0.97
"""Share of the capacity above which it is increased from the next step on."""
LATE = 4
"""Maximum number of steps that the host runs ahead."""
SMALL = 1e-4
"""Minimum magnitude in relative comparisons."""


class Recorder:
    """Recorder of a function's operations on a GPU, without running them."""

    def __init__(self) -> None:
        self.pool = torch.cuda.graph_pool_handle()

    def record(self, run: Callable[[], None], generators: list[torch.Generator]) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        for g in generators:
            graph.register_generator_state(g)
        # Threads that render images meanwhile may allocate memory, and a kernel may be compiled or loaded.
        with torch.cuda.graph(graph, pool=self.pool, capture_error_mode="relaxed"):
            run()
        return graph


@dataclass
class Results:
    """Results of a step for the host: tensors that the next step of the kind overwrites."""

    names: list[tuple[str, str]] = field(default_factory=list)
    """("loss" or "metric", name) of the values."""
    values: Tensor | None = None
    """[V], the sum of all losses first."""
    used: Int[Tensor, "2+H"] | None = None
    """Samples, those of each head, and distinct rows."""

    def as_returned(self) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """As ``Trainer.train_iteration`` returns it."""
        assert self.values is not None
        total, *values = self.values.detach().clone().unbind()
        kinds: dict[str, dict[str, Tensor]] = {"loss": {}, "metric": {}}
        for (kind, name), value in zip(self.names, values, strict=True):
            kinds[kind][name] = value
        return total, kinds["loss"], kinds["metric"]


@dataclass
class Recorded:
    """Steps of a kind."""

    gradients: torch.cuda.CUDAGraph
    update: torch.cuda.CUDAGraph
    results: Results
    learning: list[tuple[TouchedAdam, list[Parameter]]]
    """Parameters whose step the host counts."""


class StepGraphs:
    """Training of ``MMPIModel`` on a GPU, with graphs once the capacity that steps need is measured; ``optimizers`` are
    by kind of parameter."""

    def __init__(self, model: Any, manager: MMPIDataManager, optimizers: dict[str, Any], recorder: Any = None) -> None:
        self.model, self.manager, self.optimizers = model, manager, optimizers
        self.new_recorder = recorder or Recorder
        self.draws: Generators = model.draws
        manager.keep_memory()
        self.is_off = False
        """Recording has failed: steps run one operation at a time."""
        self.repeated = self.lost = 0
        """Steps that were replayed, and steps whose samples did not fit."""
        self._compared: set[Any] = set()
        self._state: tuple[Any, ...] = ()
        self._forget()

    def _forget(self) -> None:
        """Invalidates all recordings after a change of the tables."""
        self._drop()
        self._pending: deque[tuple[Any, Tensor, Capacity]] = deque()
        self._measured, self._most, self.capacity = 0, Counter[int](), None

    def _drop(self) -> None:
        """Frees the recordings and their memory."""
        self._recorded: dict[Any, Recorded] = {}
        self._rooms: dict[Capacity, Tensor] = {}  # which recordings read
        self._recorder = None  # torch does not share memory of freed graphs

    # A step ------------------------------------------------------------------------------------------------------

    def step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Trains one step; losses and metrics as ``Trainer.train_iteration`` returns them."""
        kind = self._kind(step)
        self.manager.draw_rays(step)
        self._hear(wait=False)
        if self.is_off or self._measured < MEASURED:
            return self._measured_step(step)
        recorded = self._recorded.get(kind)
        if recorded is None:
            try:
                recorded = self._record(step, kind)
            except Exception as error:
                self._give_up(f"they cannot be recorded ({type(error).__name__}: {brief(error)})")
                return self._measured_step(step)
            if recorded is None:
                return self._measured_step(step)
            self._recorded[kind] = recorded
        else:
            self._start(step)
            recorded.gradients.replay()
        for optimizer, params in recorded.learning:
            optimizer.advance(params)
        recorded.update.replay()
        self.repeated += 1
        self._send(recorded.results)
        return recorded.results.as_returned()

    def _kind(self, step: int) -> Any:
        """Key of the steps that run the same operations on the same memory. Invalidates recordings made before a change
        of the tables."""
        model, manager = self.model, self.manager
        run, fields = model.run, model.field
        schedule = model.progress.schedule
        state = (fields._packed, fields.peak, fields.gain, fields.crossings, fields.touched, manager.sources)
        state += (schedule.phase_at(step).name, schedule.sharpened(step), manager.share_of_rays, run.progress.window)
        if len(state) != len(self._state) or any(
            a is not b and not (isinstance(a, str | float | int) and a == b)
            for a, b in zip(state, self._state, strict=True)
        ):
            self._forget()
            self._state = state
        return step % TV_EVERY == 0, schedule.watches(step)

    def _start(self, step: int) -> None:
        """Sets the inputs of recorded steps."""
        self.model.decay.fill_(self.model.progress.schedule.decay(step))
        self.draws.start(step)

    def _zero_grad(self) -> None:
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)

    def _find_gradients(self, step: int, capacity: Capacity | None) -> Results:
        """Renders the rays of a step and computes gradients of the losses; changes only the records of use."""
        model, results = self.model, Results()
        model.capacity = capacity
        try:
            bundle, batch = self.manager.next_train(step)
            outputs = model(bundle)
            metrics = model.get_metrics_dict(outputs, batch)
            losses = model.get_loss_dict(outputs, batch, metrics)
        finally:
            model.capacity = None
        total = torch.stack([*losses.values()]).sum()
        rays = outputs["training"]
        if capacity is not None:
            numbers, distinct = rays.samples.numbers, rays.lookup.distinct
            results.used = torch.cat([numbers, distinct[None].to(numbers.dtype)])
            (total * (results.used <= self._room).all()).backward()
        else:
            total.backward()
            self._measure(rays)
        named = [("loss", n, x) for n, x in losses.items()] + [("metric", n, x) for n, x in metrics.items()]
        results.names = [(what, name) for what, name, _ in named]
        results.values = torch.stack([x.detach().float().reshape(()) for x in (total, *(x for _, _, x in named))])
        return results

    def _measured_step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """An ordinary step, with as much capacity as there are samples."""
        self._zero_grad()
        results = self._find_gradients(step, None)
        for optimizer in self.optimizers.values():
            optimizer.step()
        return results.as_returned()

    # Room --------------------------------------------------------------------------------------------------------

    def _measure(self, rays: Any) -> None:
        samples, lookup = rays.samples, rays.lookup
        self._measured += 1
        self._note([len(samples.heads), *(samples.head_counts or ()), len(lookup.rows)])

    def _note(self, used: list[int]) -> None:
        """Includes the samples of a step in the capacity of the next ones."""
        for place, number in enumerate(used):
            self._most[place] = max(self._most[place], number)
        samples, *heads, rows = (int(MARGIN * self._most[place]) + MORE for place in range(len(used)))
        self.capacity = Capacity(samples, tuple(heads), rows)

    def _send(self, results: Results) -> None:
        """Copies the counts of a step to the host."""
        assert results.used is not None and self.capacity is not None
        if results.used.is_cuda:
            here = torch.empty(results.used.shape, dtype=results.used.dtype, pin_memory=True)
            here.copy_(results.used, non_blocking=True)
            event = torch.cuda.Event()
            event.record()
        else:
            here, event = results.used.clone(), None
        self._pending.append((event, here, self.capacity))
        self._hear(wait=len(self._pending) > LATE)

    def _hear(self, wait: bool) -> None:
        """Reads the counts of finished steps; ``wait``: of one at least."""
        while self._pending:
            event, here, capacity = self._pending[0]
            if event is not None and not event.query():
                if not wait:
                    return
                event.synchronize()
            wait = False
            self._pending.popleft()
            used, room = here.tolist(), (capacity.samples, *capacity.heads, capacity.rows)
            self.lost += any(n > most for n, most in zip(used, room, strict=True))
            full = [n > FULL * most for n, most in zip(used, room, strict=True)]
            if any(full) and capacity is self.capacity:  # samples beyond the capacity may not be counted in full
                counts = zip(used, room, full, strict=True)
                self._note([max(n, int(MARGIN * n), most) if is_full else n for n, most, is_full in counts])
                self._drop()

    # Recording ---------------------------------------------------------------------------------------------------

    @contextmanager
    def _recording(self):
        self.draws.recording = True
        try:
            yield
        finally:
            self.draws.recording = False

    def _record(self, step: int, kind: Any) -> Recorded | None:
        """Records a kind of step and runs its first half; None if the replay differs."""
        capacity, fields = self.capacity, self.model.field
        assert capacity is not None
        room = torch.tensor([capacity.samples, *capacity.heads, capacity.rows], device=fields.density.device)
        self._room = self._rooms.setdefault(capacity, room)
        of_kind = (*kind, *self._state[6:])
        expected = None
        if of_kind not in self._compared:
            kept = fields.gain.clone(), fields.crossings.clone()
            self._zero_grad()
            results = self._find_gradients(step, capacity)
            expected = results.values, gradients_of(fields)
            fields.gain.copy_(kept[0])
            fields.crossings.copy_(kept[1])
        self._zero_grad()
        if self._recorder is None:
            self._recorder = self.new_recorder()
        streams = [*self.draws.held.values()]
        held: list[Results] = []
        with self._recording():
            gradients = self._recorder.record(lambda: held.append(self._find_gradients(step, capacity)), streams)
        optimizers = [o for o in self.optimizers.values() if isinstance(o, TouchedAdam)]
        learning = [(o, params) for o in optimizers if (params := o.learning())]
        self._start(step)
        gradients.replay()
        if expected is not None:
            if differs := self._difference(expected, (held[0].values, gradients_of(fields))):
                self._give_up(f"replayed, they compute something else ({differs})")
                return None
            self._compared.add(of_kind)

        def update() -> None:
            for optimizer, _ in learning:
                optimizer.apply()

        with self._recording():
            updates = self._recorder.record(update, [])
        self._zero_grad()
        return Recorded(gradients, updates, held[0], learning)

    @staticmethod
    def _difference(expected: Any, repeated: Any) -> str:
        """Description of the difference; empty if they agree up to the order of atomic sums."""
        (values, gradients), (others, their) = expected, repeated
        error = float(((others - values).abs() / values.abs().clamp(min=SMALL)).max())
        losses = [] if error <= CLOSE else [f"losses by {error:.1%}"]
        return ", ".join(losses + differences(gradients, their))

    def _give_up(self, reason: str) -> None:
        self.is_off = True
        self._forget()
        self._zero_grad()
        self.draws.held.clear()
        log(f"Steps run one operation at a time, several times slower: {reason}.", "yellow")
