"""Command ``mmpi-prepare INPUT SCENE``: a folder of images or a video becomes a scene for ns-train."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from mmpi_ns.scripts.command import print_version

INTERRUPTED = "mmpi-prepare: interrupted; the same command continues from here."
KILLED = "mmpi-prepare: ended by {}, perhaps as memory or the disk is full; the same command continues from here."
PR_SET_PDEATHSIG = 1
"""Option of prctl: the signal that a process receives when its parent ends."""


def end_at_once_on_signals() -> None:
    """SIGINT and SIGTERM end the command with one sentence, also in the middle of COLMAP's work.

    The work runs in a child process, which is killed. A handler or a thread would wait until COLMAP returns: its
    adjustments keep the interpreter's lock for up to a minute. COLMAP's own handler prints a stack trace.
    """
    ends = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends | {signal.SIGCHLD})
    child = os.fork()
    if not child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # it does not outlive its parent
        return
    while (number := signal.sigwait(ends | {signal.SIGCHLD})) == signal.SIGCHLD:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            if code < 0:  # the shell says this of its own children alone
                os.write(2, f"\x1b[?25h\n{KILLED.format(signal.Signals(-code).name)}\n".encode())
            os._exit(code if code >= 0 else 128 - code)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.write(2, f"\x1b[?25h\n{INTERRUPTED}\n".encode())  # the cursor that the bar hid
    os._exit(128 + number)


def entrypoint() -> None:
    """The command ``mmpi-prepare``; exit status 1 without a scene, 3 with a doubtful one."""
    print_version("mmpi-prepare")
    end_at_once_on_signals()
    # Before pycolmap is loaded: it has threads of its own, and each of them would start as many again for its matrices.
    for library in ("OMP", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    import tyro

    from mmpi_ns.utils.errors import InputError, log
    from mmpi_prepare.settings import Settings

    settings = tyro.cli(Settings, description=Settings.__doc__)
    from mmpi_prepare.pipeline import prepare

    try:
        verdict = prepare(settings)
    except InputError as error:
        log(f"mmpi-prepare: {error}", "bold red")
        sys.exit(1)
    sys.exit(0 if verdict.grade == "right" else 3)


if __name__ == "__main__":
    entrypoint()
