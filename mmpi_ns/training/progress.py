"""Progress of a run: its windows and schedule, the step, and the window being trained.

Windows, schedule and the number of the window are stored in checkpoints.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.phases import Phase, Schedule
from mmpi_ns.utils.files import to_bytes, to_text


class Progress(nn.Module):
    """The state of a run apart from its field.

    Args:
        windows: of the capture.
        schedule: of the whole run.
    """

    def __init__(self, windows: WindowedPlan, schedule: Schedule) -> None:
        super().__init__()
        self.windows, self.schedule = windows, schedule
        self.step = 0
        self.window = 0
        """The window being trained; earlier ones are finished, later ones do not exist yet."""
        self.windows_bytes: Tensor
        self.schedule_bytes: Tensor
        self.window_number: Tensor
        self.register_buffer("windows_bytes", to_bytes(windows.to_json()))
        self.register_buffer("schedule_bytes", to_bytes(schedule.to_json()))
        self.register_buffer("window_number", torch.tensor(0))

    @property
    def phase(self) -> Phase:
        return self.schedule.phase_at(self.step)

    def begin(self, window: int) -> None:
        """Starts training another window."""
        self.window_number.fill_(window)
        self.window = window

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Plan and schedule of a run come from its checkpoint, whatever config and capture say now."""
        for name in ("windows_bytes", "schedule_bytes"):
            stored = state_dict.get(prefix + name)
            if stored is not None:  # nerfstudio loads the pipeline's own, empty state in a second pass
                setattr(self, name, torch.empty_like(stored, device=self.window_number.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self.windows = WindowedPlan.from_json(to_text(self.windows_bytes))
        self.schedule = Schedule.from_json(to_text(self.schedule_bytes))
        self.window = int(self.window_number)
