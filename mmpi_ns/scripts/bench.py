"""``mmpi-bench``: scores renderings of any program, and checks and times the kernels on a GPU."""

from __future__ import annotations

import sys
from importlib import import_module

from mmpi_ns.scripts.command import print_version, run

COMMANDS = {
    "score": ("mmpi_ns.bench.score", "PSNR, SSIM and LPIPS of test images that any program has rendered."),
    "gpu": (
        "mmpi_ns.bench.gpu",
        "Every kernel of this machine's GPU against plain torch, and the time of a step and a frame.",
    ),
}
"""Module of each command, with a class of its name, and description. Only the requested one is imported."""


def entrypoint() -> None:
    """The command ``mmpi-bench``; an error is one sentence and exit status 1."""
    print_version("mmpi-bench")
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name not in COMMANDS:
        print("usage: mmpi-bench COMMAND [OPTIONS] (mmpi-bench COMMAND --help)\n")
        print("\n".join(f"  {command:10} {purpose}" for command, (_, purpose) in COMMANDS.items()))
        sys.exit(0 if name in ("-h", "--help") else f"mmpi-bench: there is no command {name!r}.")
    command = getattr(import_module(COMMANDS[name][0]), name.capitalize())
    sys.exit(run("mmpi-bench", command, prog=f"mmpi-bench {name}", args=sys.argv[2:]))


if __name__ == "__main__":
    entrypoint()
