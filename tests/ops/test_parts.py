"""Compiled operations in parts, each by a thread (ops/cpp/parts.h)."""

from __future__ import annotations

import os
import signal
from threading import Thread

import pytest
import torch

from mmpi_ns.ops import build
from mmpi_ns.ops.dispatch import fault
from mmpi_ns.utils import parallel

pytestmark = pytest.mark.skipif(fault("C++") is not None, reason="needs a C++ compiler")
COUNT = 1000


def taken(parts, seed=0):
    """Whether all rows are read right, in so many parts."""
    rows = torch.randperm(COUNT, generator=torch.Generator().manual_seed(seed), dtype=torch.int32)
    table, values = torch.arange(COUNT).float(), torch.full((COUNT,), -1.0)
    bounds = [COUNT * i // parts for i in range(parts + 1)]
    build.call_in_parts("mmpi_weighted_rows", bounds, table, rows, torch.ones(COUNT), COUNT, 1, COUNT, 1, values)
    return torch.equal(values, rows.float())


@pytest.mark.parametrize("parts", [1, 2, 3, 8])
def test_every_part_is_done_once_and_before_the_call_ends(parts):
    assert all(taken(parts, seed) for seed in range(200))


def test_a_process_that_is_forked_waits_for_no_thread():
    assert taken(3)
    torch.set_num_threads(1)
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        os._exit(0 if taken(3) else 1)
    assert os.waitpid(child, 0)[1] == 0


# Threads of torch and of kernels --------------------------------------------------------------------------------------


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
