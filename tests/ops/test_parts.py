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
    """Whether samples in all slots are numbered right, in so many parts."""
    slots = torch.randperm(COUNT, generator=torch.Generator().manual_seed(seed))
    numbers, chosen = torch.full((COUNT,), -1, dtype=torch.int32), torch.ones(COUNT, dtype=torch.bool)
    bounds = [COUNT * i // parts for i in range(parts + 1)]
    build.call_in_parts("mmpi_number_samples", bounds, slots, chosen, 1, numbers)
    return torch.equal(numbers.long(), slots.argsort())


@pytest.mark.parametrize("parts", [1, 2, 3, 8])
def test_every_part_is_done_once_and_before_the_call_ends(parts):
    assert all(taken(parts, seed) for seed in range(200))


ROWS = 20_000
LONG = 1_000_000
"""Rows that take some 20 ms."""


def adam_step(seed, count=ROWS):
    """Arguments of a step of Adam on the rows after the empty brick: rows, channels, gradient, table, moments, ..."""
    g = torch.Generator().manual_seed(seed)
    table, gradient = torch.randn(2, count, 8, generator=g)
    rows, moments = torch.arange(64, count), torch.zeros(count, 2, 8, dtype=torch.bfloat16)
    return rows, 8, gradient[64:], table, moments, 0.9, 0.99, 1.0, 1e-8, 0.1


def leave(step, size=100):
    return build.leave_in_parts("mmpi_adam_rows", len(step[0]), size, *step)


def stepped(seed, count=ROWS):
    """Table and moments after the step, worked on at once."""
    step = adam_step(seed, count)
    build.call_in_parts("mmpi_adam_rows", [0, count - 64], *step)
    return step[3:5]


def same(results, references):
    return all(torch.equal(a, b) for a, b in zip(results, references, strict=True))


@pytest.mark.parametrize("size", [1, 100, 8000])
def test_what_is_left_to_other_threads_is_done_once_and_before_finish_returns(three_threads, size):
    """More jobs than there is room for, operations that are waited for between them, finished in any order."""
    for first in range(0, 60, 6):
        steps = [adam_step(first + i) for i in range(6)]
        pending = []
        for step in steps:
            pending.append(leave(step, size))
            assert taken(3)
        order = torch.randperm(6, generator=torch.Generator().manual_seed(first)).tolist()
        for i in order:
            pending[i].finish()
            assert same(steps[i][3:5], stepped(first + i))


def test_a_process_that_is_forked_waits_for_no_thread(monkeypatch):
    """Nor leaves it anything to do."""
    monkeypatch.setattr(build, "num_threads", lambda: 3)
    pending = leave(adam_step(0, LONG), 20)
    torch.set_num_threads(1)
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        pending.finish()
        step = adam_step(1)
        leave(step).finish()
        os._exit(0 if same(step[3:5], stepped(1)) else 1)
    assert os.waitpid(child, 0)[1] == 0
    pending.finish()


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
