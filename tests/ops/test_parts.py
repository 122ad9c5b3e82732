"""Compiled operations in parts, each by a thread (ops/cpp/parts.h)."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from mmpi_ns.ops import build
from mmpi_ns.ops.dispatch import fault

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


def test_every_part_has_a_number_of_its_own():
    words, counts = torch.full((6,), 3), torch.full((3,), -1)
    for _ in range(200):
        build.call_in_parts("mmpi_count_rows", [0, 1, 3, 6], words, counts.fill_(-1))
        assert counts.tolist() == [2, 4, 6]


def test_several_callers_at_once_each_get_their_own():
    """A viewer renders while a run trains."""
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(lambda seed: taken(1 + seed % 4, seed), range(400)))


def test_a_process_that_is_forked_has_no_threads_and_works_alone():
    assert taken(3)
    torch.set_num_threads(1)  # those of OpenMP are not there after a fork either, and torch would wait for them
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        os._exit(0 if taken(3) else 1)
    assert os.waitpid(child, 0)[1] == 0
