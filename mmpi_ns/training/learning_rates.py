"""Learning rates that follow the phases."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from mmpi_ns.training.phases import Schedule
from mmpi_ns.training.run import Progress


@dataclass
class PhaseSchedulerConfig(SchedulerConfig):
    """Learning rate of one parameter kind: 0 where it is frozen, decaying over each phase in which it trains."""

    _target: type = field(default_factory=lambda: PhaseScheduler)
    kind: str = "density"
    """Parameter kind of the group."""


class PhaseScheduler(Scheduler):
    """Follows a ``Schedule``; without one (a config used outside this trainer) the rate is constant."""

    config: PhaseSchedulerConfig
    schedule: Schedule | None = None

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        kind = self.config.kind
        return LambdaLR(optimizer, lambda step: self.schedule.rate_factor(kind, step) if self.schedule else 1.0)


def following(config: SchedulerConfig, progress: Progress) -> SchedulerConfig:
    """The config of a scheduler that follows a run's schedule, even if a checkpoint loaded later has its own; other
    schedulers are unchanged."""
    if not isinstance(config, PhaseSchedulerConfig):
        return config

    class Following(PhaseScheduler):
        @property
        def schedule(self) -> Schedule:  # type: ignore[override]
            return progress.schedule

    return PhaseSchedulerConfig(_target=Following, kind=config.kind)
