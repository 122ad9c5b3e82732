"""Learning rates that follow the phases."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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


class PhaseScheduler(Scheduler):
    """Rates of the schedule of ``progress``, also if a checkpoint replaces it; constant rates without ``progress`` (a
    config used outside this trainer)."""

    config: PhaseSchedulerConfig
    progress: Progress | None = None

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        kind, progress = self.config.kind, self.progress
        return LambdaLR(optimizer, lambda step: progress.schedule.rate_factor(kind, step) if progress else 1.0)

    @classmethod
    def following(cls, config: SchedulerConfig, progress: Progress) -> SchedulerConfig:
        """The config of a scheduler that follows a run; other schedulers are unchanged."""
        if not isinstance(config, PhaseSchedulerConfig):
            return config
        return replace(config, _target=type("Following", (cls,), {"progress": progress}))
