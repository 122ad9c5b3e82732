"""``mmpi-prepare INPUT SCENE``: a folder of images or a video becomes a scene that ns-train reads as it is."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Runs mmpi-prepare; returns the exit status."""
    # Before pycolmap is loaded: it has threads of its own, and each of them would start as many again for its matrices.
    for library in ("OMP", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    import tyro

    from mmpi_ns.prepare.pipeline import prepare
    from mmpi_ns.prepare.settings import Settings
    from mmpi_ns.prepare.stages import CONSOLE, PrepareError

    settings = tyro.cli(Settings, description=Settings.__doc__)
    try:
        prepare(settings)
    except PrepareError as error:
        CONSOLE.print(f"[bold red]mmpi-prepare:[/bold red] {error}", soft_wrap=True)
        return 1
    except KeyboardInterrupt:
        CONSOLE.print("Interrupted: the same command goes on from here.")
        return 130
    return 0


def entrypoint() -> None:
    """The command ``mmpi-prepare``."""
    sys.exit(main())


if __name__ == "__main__":
    entrypoint()
