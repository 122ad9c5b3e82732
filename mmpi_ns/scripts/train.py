"""``ns-train`` in several processes that share the windows of a long capture; no GPU is needed.

    torchrun --nproc-per-node 2 -m mmpi_ns.scripts.train mmpi-small --data road/

nerfstudio itself starts several processes only on GPUs (``--machine.num-devices``). Windows are independent, so the
processes exchange nothing but a barrier at the beginning and at the end. Every finished window is a file; the same
command with ``--load-dir``, and with any number of processes, continues from those.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import NoReturn

import torch.distributed as dist
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.train import train_loop
from nerfstudio.utils import profiler

from mmpi_ns.training.run import PATIENCE
from mmpi_ns.utils.errors import quoted


def main() -> None:
    """Trains this process's share of the windows."""
    if "RANK" not in os.environ:
        sys.exit("Start it as: torchrun --nproc-per-node N -m mmpi_ns.scripts.train mmpi-small --data ...")
    config: TrainerConfig = tyro.cli(AnnotatedBaseConfigUnion)
    dist.init_process_group("gloo", timeout=PATIENCE)
    rank, processes = dist.get_rank(), dist.get_world_size()
    try:
        # All processes get the same folder, with one config.yml.
        if config.data:
            config.pipeline.datamanager.data = config.data
        config.set_timestamp()
        timestamps = [config.timestamp]
        dist.broadcast_object_list(timestamps, src=0)
        config.timestamp = timestamps[0]
        if rank == 0:
            config.print_to_terminal()
            config.save_config()
        dist.barrier()
        signal.signal(signal.SIGTERM, lambda *_: _end_early(config.get_base_dir()))
        train_loop(rank, processes, config)
        try:
            dist.barrier()
        except RuntimeError:  # gloo's own words name a socket
            _end_early(config.get_base_dir())
        if rank == 0:
            print(f"All windows are trained: ns-eval --load-config {quoted(config.get_base_dir() / 'config.yml')}")
    finally:
        profiler.flush_profiler(config.logging)
        dist.destroy_process_group()


def _end_early(folder: Path) -> NoReturn:
    """Ends this process with a message; torchrun ends all when one dies, and leaves little time for it."""
    message = (
        "Ended early: another process died (see above) or the run was stopped. Finished windows lie in "
        f"{folder / 'windows'}; the same command with --load-dir {quoted(folder / 'nerfstudio_models')} goes on from "
        "them, with any number of processes."
    )
    print(message, file=sys.stderr, flush=True)
    sys.exit(1)


if __name__ == "__main__":
    main()
