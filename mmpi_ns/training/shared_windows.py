"""Windows of a long capture shared among processes; docs/how_it_works.md, "Windows".

The processes exchange nothing: each trains every n-th window, and waits for the others at the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import torch.distributed as dist

from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.scene.windows import WindowedPlan
from mmpi_ns.training.checkpoints import checkpoints_in
from mmpi_ns.utils.errors import say

PATIENCE = timedelta(days=7)
"""nerfstudio's processes time out half an hour after the first of them has finished."""
WINDOWS_FOLDER = "windows"


class WindowShare:
    """The windows of one process of several.

    Args:
        rank: number of this process.
        processes: all of them.
        window_steps: steps of a window.
        folders: with checkpoints: of this run, and of the run that it resumes.
    """

    def __init__(self, rank: int, processes: int, window_steps: int, folders: list[Path]) -> None:
        self.rank, self.processes, self.window_steps, self.folders = rank, processes, window_steps, folders
        self._group: dist.ProcessGroup | None = None
        if dist.is_initialized() and dist.get_backend() != "gloo":  # under torchrun scripts.train waits
            group = dist.new_group(backend="gloo", timeout=PATIENCE)
            assert isinstance(group, dist.ProcessGroup)
            self._group = group

    def steps_of(self, window: int) -> range:
        return range(window * self.window_steps, (window + 1) * self.window_steps)

    def checkpoints_of(self, window: int) -> dict[int, Path]:
        """Checkpoints of a window by their steps, of this run and of the resumed one."""
        steps = self.steps_of(window)
        return {step: path for folder in self.folders for step, path in checkpoints_in(folder, steps).items()}

    def unfinished(self, windows: WindowedPlan, store: WindowStore) -> Iterator[int]:
        """Windows that this process still has to train; takes over the files that the resumed run finished."""
        last = len(windows) - 1
        for window in range(self.rank, len(windows), self.processes):
            for folder in self.folders[1:]:
                store.adopt(folder.parent / WINDOWS_FOLDER, {window: windows.plans[window]})
            # The last window needs its checkpoint too, because evaluation loads it.
            whole = window != last or self.steps_of(window)[-1] in self.checkpoints_of(window)
            if store.path(window).is_file() and whole:
                say(f"Window {window} is finished already.")
            else:
                yield window

    def wait_for_all(self) -> None:
        """Waits until all processes have called this."""
        if self._group is not None:
            dist.barrier(group=self._group)
