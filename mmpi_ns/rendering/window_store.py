"""The finished windows of a long capture: on disk, with a few in memory for rendering."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from weakref import WeakValueDictionary

import torch

from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.utils.errors import InputError, brief
from mmpi_ns.utils.files import write_atomically

_DAMAGED = (OSError, RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError)
"""Exceptions of reading a damaged file."""


@dataclass(eq=False)
class WindowStore:
    """Finished windows, one file each. Several threads may render from one store."""

    folder: Path | None
    """Folder of the files; None if there is only one window."""
    empty: Callable[[], MMPIField]
    """Factory of fields with the run's settings, to load into."""
    budget: float = 0.0
    """Bytes of the windows kept for rendering. The window being rendered is kept in any case."""
    _thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "mmpi-windows"))
    """Thread that reads and evicts windows, one at a time. The viewer interrupts a rendering by an exception in its
    thread, at any line, so work that must be finished is done here."""
    _held: dict[int, MMPIField] = field(default_factory=dict)
    """Windows in memory, the most recently used last."""
    _referenced: WeakValueDictionary[int, MMPIField] = field(default_factory=WeakValueDictionary)
    """These, and evicted windows that a thread is still rendering."""

    def path(self, window: int) -> Path:
        assert self.folder is not None, "several windows need a folder"
        return self.folder / f"window-{window:05d}.pt"

    @property
    def in_memory(self) -> tuple[int, ...]:
        """Windows that can be rendered without reading a file, the most recently used last."""
        return tuple(self._held)

    def forget(self, window: int) -> None:
        """Ignores the file from now on: the window is about to be trained and will be written again."""
        self._held.pop(window, None)
        self._referenced.pop(window, None)

    def save(self, window: int, field: MMPIField) -> None:
        """Writes a finished window atomically. Raises WriteError if the disk is full or cannot be written."""
        path = self.path(window)
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {"window": window, "field": field.state_dict()}
        write_atomically(path, lambda unfinished: torch.save(state, unfinished))

    def load(self, window: int, device: torch.device) -> MMPIField:
        """A finished window, ready to render. It stays valid for the caller even if the store evicts it.

        Args:
            window: its number.
            device: to load it to.

        Raises:
            InputError: the file is missing or damaged; the message names it and the remedy.
        """
        return self._thread.submit(self._load, window, device).result()

    def _load(self, window: int, device: torch.device) -> MMPIField:
        field, path = self._referenced.get(window), self.path(window)
        if field is None:
            if not path.is_file():
                raise InputError(
                    f"Window {window} of this run is missing: {path} is not there. Put the run's folder 'windows' "
                    "back, or name where it is in config.yml (pipeline.model.windows_folder)."
                )
            try:
                state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)["field"]
                needed = sum(x.nbytes for x in state.values())
                while self._held and needed + sum(held.nbytes for held in self._held.values()) > self.budget:
                    del self._held[next(iter(self._held))]  # the least recently used
                field = self.empty()
                field.load_state_dict(state)
            except (*_DAMAGED, AttributeError) as error:
                raise InputError(
                    f"Window {window} of this run is damaged: {path} cannot be read ({brief(error)}). Copy it "
                    "anew, or train it again: resume from a checkpoint of before its end with --load-step."
                ) from error
            field = field.to(device).eval()
        self._held.pop(window, None)
        self._held[window] = self._referenced[window] = field
        return field

    def adopt(self, other: Path, count: int) -> None:
        """Copies the first ``count`` windows of the run that this one resumes, from its folder of windows. Raises
        InputError if one is missing."""
        if not count or other.resolve() == self.path(0).parent.resolve():
            return
        for window in range(count):
            path, source = self.path(window), other / self.path(window).name
            if not source.is_file():
                raise InputError(
                    f"Window {window} of the run to go on from is missing: {source} is not there. Put it back, or "
                    "resume from a checkpoint of before its end with --load-step."
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda unfinished, source=source: shutil.copyfile(source, unfinished))
