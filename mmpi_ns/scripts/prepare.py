"""``mmpi-prepare INPUT SCENE``: a folder of images or a video becomes a scene that ns-train reads as it is."""

from __future__ import annotations

import os
import signal
import sys
import threading

from mmpi_ns.scripts.command import say_version

INTERRUPTED = "mmpi-prepare: interrupted; the same command goes on from here."


def main() -> int:
    """Runs mmpi-prepare; returns the exit status: 1 without a scene, 3 with one that cannot be believed."""
    # Before pycolmap is loaded: it has threads of its own, and each of them would start as many again for its matrices.
    for library in ("OMP", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    import tyro

    from mmpi_ns.prepare.settings import Settings
    from mmpi_ns.prepare.stages import PrepareError, say

    settings = tyro.cli(Settings, description=Settings.__doc__)
    from mmpi_ns.prepare.pipeline import prepare

    try:
        verdict = prepare(settings)
    except PrepareError as error:
        say(f"mmpi-prepare: {error}", "bold red")
        return 1
    return 0 if verdict.grade == "right" else 3


def end_at_once_on_signals() -> None:
    """SIGINT and SIGTERM end the command with one sentence, also in the middle of COLMAP's work.

    A thread waits for them: a handler would wait until COLMAP returns, and COLMAP's own prints a stack trace.
    """
    ends = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # inherited by every thread that starts from now on

    def wait() -> None:
        number = signal.sigwait(ends)
        os.write(2, f"\x1b[?25h\n{INTERRUPTED}\n".encode())  # the cursor that the bar hid; no lock is taken
        os._exit(128 + number)

    threading.Thread(target=wait, daemon=True).start()


def entrypoint() -> None:
    """The command ``mmpi-prepare``."""
    say_version("mmpi-prepare")
    end_at_once_on_signals()
    sys.exit(main())


if __name__ == "__main__":
    entrypoint()
