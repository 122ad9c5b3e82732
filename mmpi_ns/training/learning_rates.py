"""Learning rates that follow the phases."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from mmpi_ns.training.run import Progress


@dataclass
class PhaseSchedulerConfig(SchedulerConfig):
    """Learning rate of one parameter kind: 0 where it is frozen, decaying over each phase in which it trains."""

    _target: type = field(default_factory=lambda: PhaseScheduler)
    kind: str = "density"
    """Parameter kind of the group."""
    progress: ClassVar[Progress | None] = None
    """Not an option: the trainer gives it to its copy of the config. Rates are those of its schedule, also if a
    checkpoint replaces that, and constant without it (a config used outside this trainer)."""


class PhaseScheduler(Scheduler):
    """Rates of the schedule that a run follows."""

    config: PhaseSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        kind, progress = self.config.kind, self.config.progress
        return LambdaLR(optimizer, lambda step: progress.schedule.rate_factor(kind, step) if progress else 1.0)
