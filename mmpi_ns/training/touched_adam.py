"""Adam that updates only the rows of tables that a batch read (DVGO's masked Adam).

Equal to dense Adam in which entries without a gradient are skipped, with values and moments unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from mmpi_ns.ops.adam import AdamConstants, adam_rows
from mmpi_ns.ops.dispatch import on_gpu
from mmpi_ns.ops.interpolate import Table
from mmpi_ns.scene.bricks import move_bricks
from mmpi_ns.utils.pages import lazy_zeros


class TouchedAdam(torch.optim.Optimizer):
    """Adam over the rows of a ``Table`` that were read, but for its empty brick, or over entries of other parameters
    whose gradient is not 0.

    Args:
        params: parameters.
        lr: learning rate.
        betas: decay of the two moments (paper settings: 0.9, 0.99).
        eps: added to the root of the second moment.
    """

    def __init__(self, params: Any, lr: float, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-8, **_: Any):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        self._constants: dict[Parameter, AdamConstants] = {}
        self._numbers: dict[Parameter, Tensor] = {}

    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        assert closure is None, "TouchedAdam takes no closure"
        self.advance(self.learning())
        self.apply()

    def learning(self) -> list[Parameter]:
        """Parameters with a gradient."""
        return [p for group in self.param_groups for p in group["params"] if p.grad is not None]

    @torch.no_grad()
    def advance(self, params: list[Parameter]) -> None:
        """Begins a step of some parameters: counts it, and sets its numbers."""
        for group in self.param_groups:
            for param in group["params"]:
                if not any(param is each for each in params):
                    continue
                state = self.state[param]
                if not state:
                    # Mean and uncentred variance. Those of a table are in bfloat16 (docs/ablations.md has what
                    # that costs), and take no memory on a CPU until they are written to: most rows may never be.
                    table = isinstance(param, Table) and param.dtype == torch.float32
                    dtype, shape = torch.bfloat16 if table else param.dtype, (len(param), 2, *param.shape[1:])
                    state["step"], state["moments"] = 0, lazy_zeros(shape, dtype, param.device)
                state["step"] += 1
                (beta1, beta2), steps = group["betas"], state["step"]
                numbers = ((1 - beta2**steps) ** 0.5, group["lr"] / (1 - beta1**steps))
                if on_gpu(param):  # the same tensors in each step
                    held = self._numbers.setdefault(param, torch.empty(2, device=param.device)).unbind()
                    for tensor, number in zip(held, numbers, strict=True):
                        tensor.fill_(number)
                    numbers = held
                self._constants[param] = AdamConstants(beta1, beta2, numbers[0], group["eps"], numbers[1])

    @torch.no_grad()
    def apply(self) -> None:
        """Changes the parameters with a gradient, whose step has begun."""
        for group in self.param_groups:
            for param in group["params"]:
                if param.grad is None:
                    continue
                rows = param.grad_rows if isinstance(param, Table) else None
                adam_rows(param.data, self.state[param]["moments"], rows, param.grad, self._constants[param])

    def keep_bricks(self, param: Parameter, kept: Tensor) -> None:
        """Keeps the moments of the bricks ``kept`` [K] of a table, in ascending order."""
        state = self.state.get(param, {})
        if "moments" in state:
            state["moments"] = move_bricks(state["moments"], kept)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads the state without torch's conversion of moments to the precision of their parameters."""
        super().load_state_dict(state_dict)
        params = [param for group in self.param_groups for param in group["params"]]
        for number, state in state_dict["state"].items():
            self.state[params[number]]["moments"] = state["moments"].to(params[number].device)
