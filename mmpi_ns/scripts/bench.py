"""``mmpi-bench``: the figures in docs/results, each made again by one command."""

from __future__ import annotations

import sys

import tyro

from mmpi_ns.bench.ablate import Ablate
from mmpi_ns.bench.accuracy import Accuracy
from mmpi_ns.bench.dense import Dense
from mmpi_ns.bench.gpu import Gpu
from mmpi_ns.bench.ops import Ops
from mmpi_ns.bench.processes import Processes
from mmpi_ns.bench.regions import Regions
from mmpi_ns.bench.render import Render
from mmpi_ns.bench.results import Results
from mmpi_ns.bench.roads import Roads
from mmpi_ns.bench.scaling import Scaling
from mmpi_ns.bench.speed import Speed
from mmpi_ns.bench.stability import Stability
from mmpi_ns.bench.train import Train


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
