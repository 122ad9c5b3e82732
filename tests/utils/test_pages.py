"""Pages of large arrays: what is not written or not needed any more takes no memory, and nothing else is lost."""

import platform
import subprocess
import sys
from textwrap import dedent

import pytest
import torch

from mmpi_ns.scene.bricks import AT_ONCE, move_bricks
from mmpi_ns.scene.texels import BRICK
from mmpi_ns.utils.pages import PART, all_zero

CPU = torch.device("cpu")
RESIDENT = """
import torch
from pathlib import Path
from mmpi_ns.scene.bricks import move_bricks
from mmpi_ns.utils.host import keep_freed_memory
from mmpi_ns.utils.pages import FORGET, advise, empty_table, lazy_zeros
CPU = torch.device("cpu")
def mib(name):
    status = Path("/proc/self/status").read_text()
    return int(status.split(name + ":")[1].split()[0]) >> 10
"""


def numbers_of(work: str) -> list[int]:
    """What a program prints, in a process of its own."""
    program = [sys.executable, "-c", RESIDENT + dedent(work)]
    return list(map(int, subprocess.run(program, capture_output=True, check=True).stdout.split()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.uint8])
@pytest.mark.parametrize("channels", [(), (1,), (2, 8)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_bricks_move_unchanged(dtype, channels, share):
    count = 3 * AT_ONCE // BRICK // 16 if channels == (2, 8) else 40  # of several parts
    table = (100 * torch.rand(count * BRICK, *channels)).to(dtype)
    keep = torch.rand(count) < share
    keep[0] = share > 0
    rows = keep.repeat_interleave(BRICK)
    expected = table[rows]
    moved = move_bricks(table, keep.nonzero()[:, 0])
    assert moved.dtype == dtype and torch.equal(moved, expected)


@pytest.mark.skipif(platform.system() != "Linux", reason="other systems have no madvise, and keep the memory")
class TestOnLinux:
    def test_zeros_take_no_memory_where_malloc_has_some(self):
        """Of a size that malloc serves from what was freed, which it fills with zeros."""
        work = """
        keep_freed_memory().__enter__()
        parts = [torch.ones(1 << 20) for _ in range(50)]
        last = torch.ones(1)
        del parts
        before = mib("VmRSS")
        zeros = [lazy_zeros((1 << 22,), torch.float32, CPU) for _ in range(10)]
        print(mib("VmRSS") - before)
        """
        assert numbers_of(work)[0] < 5

    def test_what_is_forgotten_is_given_back(self):
        work = """
        table = empty_table((50 << 20,), torch.float32, CPU).fill_(1)
        before = mib("VmRSS")
        advise(table[: 40 << 20], FORGET)
        print(before - mib("VmRSS"))
        """
        assert 155 <= numbers_of(work)[0] <= 165

    def test_two_tables_never_stand_in_memory_at_once(self):
        work = """
        table, kept = empty_table((1 << 20, 64), torch.float32, CPU).fill_(1), torch.arange(1 << 14)[::2]
        before = mib("VmHWM")
        moved = move_bricks(table, kept)
        print(mib("VmHWM") - before, mib("VmRSS") - before)
        """
        most, now = numbers_of(work)
        assert most < 30 and now < -90


@pytest.mark.parametrize("shape", [(0,), (), (3 * PART, 2), (PART + 1,)])
def test_all_zero_sees_every_number(shape):
    array = torch.zeros(shape)
    assert all_zero(array)
    if array.numel():
        array.view(-1)[-1] = -1e-30
        assert not all_zero(array)
