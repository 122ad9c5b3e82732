"""The windows of a long capture that are not being trained: on disk, and a few of them in memory to render."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mmpi_ns.checks import brief
from mmpi_ns.files import write_atomically
from mmpi_ns.mmpi_field import MMPIField


class WindowStore:
    """Finished windows, one file each; without a folder all stay in memory.

    Args:
        folder: where the files lie, or None.
        resident: windows held in memory at once to render.
    """

    def __init__(self, folder: Path | None, resident: int) -> None:
        self.folder, self.resident = folder, max(1, resident)
        self._fields: dict[int, MMPIField] = {}

    def path(self, window: int) -> Path:
        assert self.folder is not None
        return self.folder / f"window-{window:05d}.pt"

    def forget(self, window: int) -> None:
        """Leaves the file alone: the window is about to be trained, and will be written anew."""
        self._fields.pop(window, None)

    def save(self, window: int, field: MMPIField, empty: Callable[[], MMPIField]) -> None:
        """Keeps a finished window: written whole, or not at all.

        Raises:
            OSError: the disk is full or cannot be written.
        """
        if self.folder is None:
            kept = empty()
            kept.load_state_dict({name: value.clone() for name, value in field.state_dict().items()})
            self._fields[window] = kept.to(field.density.device).eval()
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        state = {"window": window, "field": field.state_dict()}
        write_atomically(self.path(window), lambda path: torch.save(state, path))

    def load(self, window: int, empty: Callable[[], MMPIField], device: torch.device) -> MMPIField:
        """A finished window, ready to render.

        Args:
            window: its number.
            empty: makes a field of the run's settings to load into.
            device: where to.

        Raises:
            ValueError: the file is missing or damaged (says which, and what to do).
        """
        if window in self._fields:
            self._fields[window] = self._fields.pop(window)  # newest last
            return self._fields[window]
        path = self.path(window) if self.folder is not None else None
        if path is None or not path.is_file():
            raise ValueError(
                f"Window {window} of this run is missing: {path} is not there. Put the run's folder 'windows' back, or "
                "name where it is in config.yml (pipeline.model.windows_folder)."
            )
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            field = empty()
            field.load_state_dict(state["field"])
        except (OSError, RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError) as error:
            raise ValueError(
                f"Window {window} of this run is damaged: {path} cannot be read ({brief(error)}). Copy it anew, or "
                "train it again: resume from a checkpoint of before its end with --load-step."
            ) from error
        while self.folder is not None and len(self._fields) >= self.resident:
            del self._fields[next(iter(self._fields))]
        self._fields[window] = field.to(device).eval()
        return self._fields[window]

    def adopt(self, other: Path, windows: int) -> None:
        """Takes over the first finished windows of the run that this one goes on from.

        Raises:
            ValueError: one is missing there.
        """
        if self.folder is None or other.resolve() == self.folder.resolve():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        for window in range(windows):
            source = other / self.path(window).name
            if not source.is_file():
                raise ValueError(
                    f"Window {window} of the run to go on from is missing: {source} is not there. Put it back, or "
                    "resume from a checkpoint of before its end with --load-step."
                )
            write_atomically(self.path(window), lambda path, source=source: shutil.copyfile(source, path))


def mix_windows(
    shares: Float[Tensor, "R W"], parts: dict[int, tuple[Int[Tensor, "P"], dict[str, Tensor]]]
) -> dict[str, Tensor]:
    """One rendering of several windows': colours by their shares, depth and winner of the window of most share.

    Args:
        shares: of each ray and window.
        parts: for each window that was asked, which rays, and what it shows of them.
    """
    mixed: dict[str, Tensor] = {}
    most = shares.argmax(-1)
    for w, (rays, outputs) in parts.items():
        own = (most[rays] == w)[:, None]
        for name, values in outputs.items():
            whole = mixed.setdefault(name, values.new_zeros(len(shares), *values.shape[1:]))
            chooses = name in ("depth", "winning_mpi")
            whole[rays] += values * (own if chooses else shares[rays, w][:, None])
    return mixed
