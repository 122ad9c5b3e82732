"""Work shared among torch's number of threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

import cv2
import torch
from threadpoolctl import threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")


_outer: list[int] = []
"""Threads of torch before each ``torch_apart`` that is entered; a viewer's thread renders beside the training's."""
_entering = Lock()


def num_threads() -> int:
    """Number of threads of this package: that of torch, before ``torch_apart``."""
    return _outer[0] if _outer else torch.get_num_threads()


@contextmanager
def torch_apart() -> Iterator[None]:
    """Within the block torch's operations use one thread, and ``num_threads`` does not change.

    OpenMP's threads wait for torch's next operation spinning, for milliseconds, on the cores that the compiled kernels
    of this package would use. The arrays of a training step and of a picture are too small for torch's threads to pay.
    """
    with _entering:
        _outer.append(num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _entering:
            threads = _outer.pop()
            if not _outer:
                torch.set_num_threads(threads)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Within the block torch, OpenCV and the BLAS of NumPy work in the calling thread, for work shared out by images.

    Results are then reproducible, and no library's threads spin on the cores of the others.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with torch_apart(), threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(threads)


def in_order(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Results of a function that releases Python's lock for most of its time, in the order of its arguments.

    The function is called from several threads at once. At most one result more than there are threads is in memory.
    """
    threads = num_threads()
    if threads == 1:
        yield from map(function, items)
        return
    with one_thread_each(), ThreadPoolExecutor(threads) as pool:
        yield from (result for _, result in in_turn(((item, pool.submit(function, item)) for item in items), threads))


def in_turn(tasks: Iterable[tuple[Item, Future[Result]]], ahead: int) -> Iterator[tuple[Item, Result]]:
    """Results of tasks, each with its key, of which ``ahead`` are started before the first result is waited for."""
    started: deque[tuple[Item, Future[Result]]] = deque()
    for task in tasks:
        started.append(task)
        if len(started) > ahead:
            key, future = started.popleft()
            yield key, future.result()
    for key, future in started:
        yield key, future.result()
