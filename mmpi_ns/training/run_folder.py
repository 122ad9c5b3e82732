"""The folder of a run: one process group writes into it at a time, and never over another run."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout

from mmpi_ns.training.checkpoints import checkpoints_in
from mmpi_ns.utils.errors import InputError
from mmpi_ns.utils.files import write_errors

LOCK = ".lock"
_held: dict[Path, FileLock] = {}


def claim(folder: Path, checkpoints: Path, resumes_from: Path | None) -> None:
    """Makes a run's folder this process's own until it ends, and clears away what killed runs left half written.

    Args:
        folder: of the run.
        checkpoints: its folder of checkpoints.
        resumes_from: the folder, or the file, of the checkpoint that the run goes on from.

    Raises:
        InputError: another run is writing there, or has written checkpoints that this one does not go on from.
        WriteError: the folder cannot be written.
    """
    with write_errors(folder, "--output-dir"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        _lock(folder.resolve())
    except Timeout as error:
        raise InputError(
            f"Another run is writing into {folder}: wait for its end, or give another --timestamp."
        ) from error
    own = {checkpoints.resolve()}
    goes_on = resumes_from is not None and bool(own & {resumes_from.resolve(), resumes_from.resolve().parent})
    if checkpoints_in(checkpoints) and not goes_on:
        raise InputError(
            f"{checkpoints} holds checkpoints of an earlier run: go on from them with --load-dir {checkpoints}, or "
            "give another --timestamp."
        )
    for unfinished in [*folder.glob(".*.tmp"), *folder.glob("windows/.*.tmp")]:
        unfinished.unlink(missing_ok=True)


def _lock(folder: Path) -> None:
    """The system lets go of it when the process ends, however that happens."""
    if folder not in _held:
        lock = FileLock(folder / LOCK)
        with write_errors(folder, "--output-dir"):
            lock.acquire(timeout=0)
        _held[folder] = lock
