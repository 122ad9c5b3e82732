"""Windows of a long capture shared among processes; docs/how_it_works.md, "Windows".

The processes exchange nothing: each trains every n-th window, and waits for the others at the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import torch.distributed as dist

from mmpi_ns.rendering.window_store import WindowStore
from mmpi_ns.training.checkpoints import checkpoints_in
from mmpi_ns.training.run import Progress
from mmpi_ns.utils.errors import say

PATIENCE = timedelta(days=7)
"""How long processes with less work wait for the others; nerfstudio's time out after half an hour. If one dies,
torchrun ends the run at once."""
WINDOWS_FOLDER = "windows"


class WindowShare:
    """The windows of one process of several.

    Args:
        rank: number of this process.
        processes: all of them.
        folders: with checkpoints: of this run, and of the run that it resumes.
    """

    def __init__(self, rank: int, processes: int, folders: list[Path]) -> None:
        self.rank, self.processes, self.folders = rank, processes, folders
        self._group: dist.ProcessGroup | None = None
        if dist.is_initialized() and dist.get_backend() != "gloo":  # under torchrun scripts.train waits
            group = dist.new_group(backend="gloo", timeout=PATIENCE)
            assert isinstance(group, dist.ProcessGroup)
            self._group = group

    def checkpoints_of(self, steps: range) -> dict[int, Path]:
        """Checkpoints of a window's steps, of this run and of the resumed one."""
        return {step: path for folder in self.folders for step, path in checkpoints_in(folder, steps).items()}

    def unfinished(self, progress: Progress, store: WindowStore) -> Iterator[int]:
        """Windows that this process still has to train; takes over the files that the resumed run finished. Ends when
        all processes have trained theirs."""
        windows = progress.windows
        for window in range(self.rank, len(windows), self.processes):
            for folder in self.folders[1:]:
                store.adopt(folder.parent / WINDOWS_FOLDER, {window: windows.plans[window]})
            # The last window needs its checkpoint too, because evaluation loads it.
            steps = progress.schedule.steps_of(window)
            whole = window != len(windows) - 1 or steps[-1] in self.checkpoints_of(steps)
            if store.path(window).is_file() and whole:
                say(f"Window {window} is finished already.")
            else:
                yield window
        if self._group is not None:
            dist.barrier(group=self._group)
