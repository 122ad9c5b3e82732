"""``python -m mmpi_ns.bench results|dense|regions``: the figures in docs/results."""

from __future__ import annotations

import tyro

from mmpi_ns.bench.dense import Dense
from mmpi_ns.bench.regions import Regions
from mmpi_ns.bench.results import Results


def main() -> None:
    """Runs one benchmark."""
    tyro.cli(Results | Dense | Regions).run()  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
