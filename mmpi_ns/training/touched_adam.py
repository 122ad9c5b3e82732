"""Adam that visits only what a batch touched (DVGO's masked Adam, for sparse row gradients).

Equal to dense Adam in which entries with no gradient are skipped: their values and moments stay as they are.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.optimizers import OptimizerConfig
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.ops import native
from mmpi_ns.ops.interpolate import add_rows, index_rows


class TouchedAdam(torch.optim.Optimizer):
    """Adam over touched rows (sparse gradients) or touched entries (dense gradients).

    Args:
        params: parameters; tables with sparse gradients are [rows, channels].
        lr: learning rate.
        betas: decay of the two moments (paper settings: 0.9, 0.99).
        eps: added to the root of the second moment.
    """

    def __init__(self, params: Any, lr: float, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-8, **_: Any):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        assert closure is None, "TouchedAdam takes no closure"
        for group in self.param_groups:
            for param in group["params"]:
                if param.grad is None:
                    continue
                state = self.state[param]
                if not state:
                    state["step"] = 0
                    state["exp_avg"], state["exp_avg_sq"] = _zeros_like(param), _zeros_like(param)
                state["step"] += 1
                update = _sparse_update if param.grad.is_sparse else _dense_update
                update(param, param.grad, state, group)

    def reset_moments(self, param: Parameter) -> None:
        """Forgets the moments of a parameter whose data was resized or redefined."""
        self.state.pop(param, None)

    def keep_blocks(self, param: Parameter, kept: Tensor, size: int) -> None:
        """Moments of a table of which only the blocks ``kept`` [K], of ``size`` rows each, are left, in that order."""
        state = self.state.get(param, {})
        for name in ("exp_avg", "exp_avg_sq"):
            if name in state:
                state[name] = state[name].view(-1, size, *param.shape[1:])[kept].flatten(0, 1)


def _zeros_like(param: Tensor) -> Tensor:
    """Zeros that take no memory on a CPU until they are written to: most rows of a table may never be."""
    if param.device.type != "cpu" or param.dtype not in (torch.float32, torch.float64):
        return torch.zeros_like(param)
    return torch.from_numpy(np.zeros(param.shape, dtype=str(param.dtype).removeprefix("torch.")))


def _adam(
    grad: Tensor, mean: Tensor, square: Tensor, state: dict[str, Any], group: dict[str, Any]
) -> tuple[Tensor, Tensor, Tensor]:
    """New moments and the step to subtract; all three unchanged (0) where the gradient is exactly 0."""
    beta1, beta2 = group["betas"]
    touched = grad != 0
    mean = torch.where(touched, mean.lerp(grad, 1 - beta1), mean)
    square = torch.where(touched, (square * beta2).addcmul_(grad, grad, value=1 - beta2), square)
    correction = (1 - beta2 ** state["step"]) ** 0.5
    delta = mean / square.sqrt().div_(correction).add_(group["eps"])
    delta = torch.where(touched, delta, torch.zeros_like(delta))
    return mean, square, delta.mul_(group["lr"] / (1 - beta1 ** state["step"]))


def _sparse_update(param: Parameter, grad: Tensor, state: dict[str, Any], group: dict[str, Any]) -> None:
    rows, values = grad._indices()[0], grad._values().to(param.dtype)
    if not grad.is_coalesced():
        index = index_rows(rows)
        rows, values = index.unique, add_rows(index, values, None)
    if native.takes_triton(param.data) and param.data.is_contiguous() and param.ndim == 2:
        from mmpi_ns.ops.triton_tables import adam_rows

        moments = state["exp_avg"], state["exp_avg_sq"]
        return adam_rows(param.data, *moments, rows, values, _constants(state, group))
    lib = native.library(param.data)
    if lib is not None and param.data.is_contiguous() and param.ndim == 2:
        return _compiled_update(lib, param, rows, values, state, group)
    old_mean, old_square = state["exp_avg"].index_select(0, rows), state["exp_avg_sq"].index_select(0, rows)
    mean, square, delta = _adam(values, old_mean, old_square, state, group)
    fresh = param.data.index_select(0, rows).sub_(delta)
    state["exp_avg"].index_copy_(0, rows, mean)
    state["exp_avg_sq"].index_copy_(0, rows, square)
    param.data.index_copy_(0, rows, fresh)


def _constants(state: dict[str, Any], group: dict[str, Any]) -> tuple[float, float, float, float, float]:
    """beta1, beta2, root of the second moment's correction, eps, and rate with the first one's correction."""
    beta1, beta2 = group["betas"]
    correction = (1 - beta2 ** state["step"]) ** 0.5
    return beta1, beta2, correction, group["eps"], group["lr"] / (1 - beta1 ** state["step"])


def _compiled_update(
    lib: ctypes.CDLL, param: Parameter, rows: Tensor, values: Tensor, state: dict[str, Any], group: dict[str, Any]
) -> None:
    constants = _constants(state, group)

    def update(begin: int, end: int) -> None:
        lib.mmpi_adam_rows(
            native.address(rows, torch.int64),
            *map(ctypes.c_int64, (begin, end, param.shape[1])),
            *map(native.address, (values, param.data, state["exp_avg"], state["exp_avg_sq"])),
            *map(ctypes.c_float, constants),
        )

    native.in_parts(update, len(rows), least=4096)


def _dense_update(param: Parameter, grad: Tensor, state: dict[str, Any], group: dict[str, Any]) -> None:
    mean, square, delta = _adam(grad, state["exp_avg"], state["exp_avg_sq"], state, group)
    param.data.sub_(delta)
    state["exp_avg"].copy_(mean)
    state["exp_avg_sq"].copy_(square)


@dataclass
class TouchedAdamConfig(OptimizerConfig):
    """Settings of TouchedAdam."""

    _target: type = TouchedAdam
    lr: float = 0.1
    """Learning rate at the start of the group's phase."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of the first and second moment."""
    eps: float = 1e-8
    """Keeps the update finite where the second moment is zero."""
