"""The folder of a run: one process group writes into it at a time, and never over another run."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout

from mmpi_ns.training.checkpoints import checkpoints_in
from mmpi_ns.utils.errors import InputError, quoted
from mmpi_ns.utils.files import write_errors

LOCK = ".lock"
_held: dict[Path, FileLock] = {}


def claim(folder: Path, checkpoints: Path, resumes_from: Path | None) -> None:
    """Locks a run's folder for this process until it ends, and removes files left half-written by killed runs.

    Args:
        folder: of the run.
        checkpoints: its folder of checkpoints.
        resumes_from: folder or file of the checkpoint that the run resumes from.

    Raises:
        InputError: another run is writing there, or its checkpoints are there and this run does not resume from them.
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
            f"{checkpoints} holds checkpoints of an earlier run: go on from them with --load-dir "
            f"{quoted(checkpoints)}, or give another --timestamp."
        )
    for unfinished in [*folder.glob(".*.tmp"), *folder.glob("windows/.*.tmp")]:
        unfinished.unlink(missing_ok=True)


def _lock(folder: Path) -> None:
    """The operating system releases the lock when the process ends, however that happens."""
    if folder not in _held:
        lock = FileLock(folder / LOCK)
        with write_errors(folder, "--output-dir"):
            lock.acquire(timeout=0)
        _held[folder] = lock
