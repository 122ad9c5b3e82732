"""``mmpi-bench``: the figures in docs/results, each made again by one command."""

from __future__ import annotations

import sys

import tyro

from mmpi_ns.bench.gpu.command import Gpu
from mmpi_ns.bench.quality.ablate import Ablate
from mmpi_ns.bench.quality.accuracy import Accuracy
from mmpi_ns.bench.quality.regions import Regions
from mmpi_ns.bench.quality.results import Results
from mmpi_ns.bench.quality.train import Train
from mmpi_ns.bench.speed.against_peers import Speed
from mmpi_ns.bench.speed.dense import Dense
from mmpi_ns.bench.speed.ops import Ops
from mmpi_ns.bench.speed.processes import Processes
from mmpi_ns.bench.speed.render import Render
from mmpi_ns.bench.speed.roads import Roads
from mmpi_ns.bench.speed.scaling import Scaling
from mmpi_ns.bench.stability.command import Stability


def entrypoint() -> None:
    """The command ``mmpi-bench``; a mistake is one sentence and exit status 1."""
    measures = Train | Render | Speed | Ops | Scaling | Roads | Processes | Ablate | Gpu
    command = tyro.cli(measures | Stability | Accuracy | Results | Dense | Regions, prog="mmpi-bench")  # type: ignore[arg-type]
    try:
        command.run()
    except (ValueError, OSError) as error:
        sys.exit(f"mmpi-bench: {error}")


if __name__ == "__main__":
    entrypoint()
