"""Threads of torch and of this package's kernels (utils/parallel.py)."""

from __future__ import annotations

from threading import Thread

import torch

from mmpi_ns.ops import build
from mmpi_ns.utils import parallel


def test_torch_takes_one_thread_and_kernels_all(three_threads):
    with parallel.torch_apart():
        assert (torch.get_num_threads(), parallel.num_threads()) == (1, 3)
        assert len(build.even_bounds(10_000)) == 4
        with parallel.torch_apart():
            assert parallel.num_threads() == 3
        assert torch.get_num_threads() == 1
    assert (torch.get_num_threads(), parallel.num_threads()) == (3, 3)


def test_a_thread_that_began_within_the_block_has_all_kernel_threads_too(three_threads):
    seen = []

    def view():
        torch.ones(2).sum()
        with parallel.torch_apart():
            seen.append(parallel.num_threads())

    with parallel.torch_apart():
        beside = Thread(target=view)
        beside.start()
        beside.join()
    assert seen == [3]
