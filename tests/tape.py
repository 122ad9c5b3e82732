"""What a CUDA graph does, on a CPU: the operations of a function are recorded, and repeated on the same memory."""

from __future__ import annotations

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

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
            tape.done.append((lambda *_: launch(executor, *args, **kwargs), (), {}, None))
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
