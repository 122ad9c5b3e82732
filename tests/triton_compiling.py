"""Compiles the Triton kernels for GPUs that are not there: every launch becomes a compilation for its arguments.

With another release of Triton, on the path before the installed one (two minutes an architecture; ``--largest`` halves
that by compiling each kernel once, with the most in it):

    pip install --no-deps --target triton-3.1 triton==3.1.0
    PYTHONPATH=triton-3.1:.:tests python tests/triton_compiling.py 75 80 86 89 90

Registers, shared memory, occupancy and traffic of every kernel (docs/results/kernels.md):

    PYTHONPATH=.:tests python tests/triton_compiling.py 80 86 89 90 --write docs/results/kernels.json
"""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import accumulate
from operator import mul
from pathlib import Path

import kernel_cases
import torch
import triton
from kernel_cases import SMALL, Shapes
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mmpi_ns.ops import dispatch

ARCHITECTURES = (75, 80, 86, 89, 90)
"""Turing, Ampere (A100), Ampere (RTX 30), Ada, Hopper."""
NAMES = {
    torch.float32: "*fp32",
    torch.bfloat16: "*bf16",
    torch.int16: "*i16",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.uint8: "*u8",
    torch.bool: "*i1",
}
TAKES_CONSTEXPRS = tuple(int(n) for n in triton.__version__.split(".")[:2]) >= (3, 3)
"""Whether a signature lists the constants too."""


@dataclass(frozen=True)
class Launch:
    """A kernel with the types of its arguments and its constants."""

    kernel: triton.runtime.JITFunction
    signature: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, object], ...]
    num_warps: int
    bytes_per_item: float = field(default=0.0, compare=False)
    """Of the arrays with an entry for each ray, sample or row that the kernel works on."""

    @property
    def name(self):
        return self.kernel.fn.__name__

    def compiled(self, architecture):
        signature, constants = dict(self.signature), dict(self.constants)
        if TAKES_CONSTEXPRS:
            signature |= dict.fromkeys(constants, "constexpr")
            source = ASTSource(self.kernel, signature=signature, constexprs=constants)
        else:
            source = ASTSource(self.kernel, signature=signature, constants=constants)
        target = GPUTarget("cuda", architecture, 32)
        return triton.compile(source, target=target, options={"num_warps": self.num_warps})


def _type(value):
    if isinstance(value, torch.Tensor):
        return NAMES[value.dtype]
    return "fp32" if isinstance(value, float) else "i64" if abs(value) >= 2**31 else "i32"


def _bytes_per_item(given):
    """Of a launch, by its arguments: each entry of the arrays that have some for every item, and those alone."""
    count = next((given[name] for name in ("size", "count", "num_rays") if name in given), 0)

    def is_for_items(x):
        return count in accumulate(x.shape, mul) or x.shape == (2 * count,)

    arrays = {x.data_ptr(): x for x in given.values() if isinstance(x, torch.Tensor) and is_for_items(x)}
    return sum(x.numel() * x.element_size() for x in arrays.values()) / max(1, count)


@contextmanager
def launches_noted(noted):
    """Within, a launch is added to ``noted`` (a dict, for its order) and runs nothing.

    What it would have read or written is zeroed, so that callers who size arrays by it go on.
    """
    run = triton.runtime.JITFunction.run

    def note(self, *args, grid, warmup, num_warps=4, **constants):
        del grid, warmup
        given = dict(zip(self.arg_names, args, strict=False))
        # As a launch does: an integer of 1 becomes a constant.
        ones = {n: 1 for n, v in given.items() if type(v) is int and v == 1 and n not in self.do_not_specialize}
        moved = _bytes_per_item(given)
        given = {name: _type(value) for name, value in given.items() if name not in ones}
        constants |= ones
        noted[Launch(self, tuple(given.items()), tuple(constants.items()), num_warps, moved)] = None
        for value in args:
            if isinstance(value, torch.Tensor):
                value.detach().zero_()

    triton.runtime.JITFunction.run = note
    try:
        yield noted
    finally:
        triton.runtime.JITFunction.run = run


def all_launches(setattr, shapes=SMALL):
    """Every kernel launched as on a GPU, with toy arguments.

    Args:
        shapes: of the toy scenes.
        setattr: sets an attribute of an object, for as long as the launches are used.
    """
    setattr(dispatch, "interpreting", True)
    setattr(dispatch, "fault", lambda *_: None)
    with launches_noted({}) as noted:
        for name, cases in kernel_cases.CASES.items():
            module = importlib.import_module(f"{dispatch.OPERATIONS[name].kernels}.gpu")
            if hasattr(module, "block_size"):  # arrays on a CPU, but blocks of a GPU's size
                setattr(module, "block_size", lambda wanted, device: wanted)
            for given in cases("cpu", shapes):
                kernel_cases._outcome(name, "gpu", given)
    return list(noted)


def largest_launches(launches):
    """Of each kernel the launch with the most in it."""
    largest = {}
    for launch in launches:
        constants = dict(launch.constants)
        # What keeps all samples passes over no empty tiles.
        size = sum(int(value) for value in constants.values()) - 2 * constants.get("KEEP_ALL", False)
        if launch.name not in largest or size > largest[launch.name][0]:
            largest[launch.name] = size, launch
    return {name: launch for name, (_, launch) in largest.items()}


def resources(kernel):
    """What the disassembler says that a compiled kernel needs; registers that do not fit go to its stack."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        return subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout


def spills(kernel):
    """Whether registers of a compiled kernel go to memory. A stack alone, of a few bytes, says nothing where the kernel
    does not take all registers that there are."""
    found = resources(kernel)
    return "STACK:0" not in found and "REG:255" in found


WARPS = {80: 64, 86: 48, 89: 48, 90: 64}
"""That a multiprocessor holds at most,"""
PROGRAMS = {80: 32, 86: 16, 89: 24, 90: 32}
"""programs,"""
SHARED = {80: 164, 86: 100, 89: 100, 90: 228}
"""and KiB of shared memory, of which each program takes one more than it asks for."""
REGISTERS = 65536
BANDWIDTH = {80: 2039e9, 86: 936e9, 89: 1008e9, 90: 3350e9}
"""Bytes a second of an A100 80 GB, RTX 3090, RTX 4090 and H100 SXM (their makers' figures)."""
PLANS = {n: Shapes((n,), cube=False, blends=False) for n in (4, 9, 64)}
"""Not blended, eight channels: by the number of MPIs."""


def launches_of_plans(setattr):
    """The launches in the table, by number of MPIs and name: of larger plans those that smaller ones do not have."""
    seen, plans = set(), {}
    for number, shapes in PLANS.items():
        launches = largest_launches(all_launches(setattr, shapes))
        plans[number] = {name: launch for name, launch in launches.items() if launch not in seen}
        seen |= set(launches.values())
    return plans


def occupancy(registers, shared, warps, architecture):
    """Warps of a kernel that a multiprocessor has at a time, and the share of those that it could have."""
    per_warp = -(-registers * 32 // 256) * 256
    programs = min(PROGRAMS[architecture], WARPS[architecture] // warps, REGISTERS // per_warp // warps,
                   int(SHARED[architecture] * 1024 // (shared + 1024)))  # fmt: skip
    return programs * warps, programs * warps / WARPS[architecture]


def measured(launch, architecture):
    """A row of the table."""
    kernel = launch.compiled(architecture)
    said = resources(kernel)
    registers, stack = (int(re.search(rf"{name}:(\d+)", said)[1]) for name in ("REG", "STACK"))
    warps, share = occupancy(registers, kernel.metadata.shared, launch.num_warps, architecture)
    row = {"registers": registers, "shared": kernel.metadata.shared, "stack": stack, "warps": warps}
    row |= {"spills": spills(kernel), "occupancy": round(share, 2)}
    bytes_per_item = round(launch.bytes_per_item, 1)
    roof = round(BANDWIDTH[architecture] / bytes_per_item / 1e6) if bytes_per_item else None
    return row | {"bytes_per_item": bytes_per_item, "million_items_per_s": roof}


def write_table(path, architectures):
    """Writes what every kernel takes on every architecture, as JSON and, beside it, as a page."""
    plans, commit = {}, ["git", "rev-parse", "--short", "HEAD"]
    made = {"command": " ".join(["python", *sys.argv]), "triton": triton.__version__}
    made["shapes"] = PLANS[4]._asdict() | {"mpis": list(PLANS)}
    made["commit"] = subprocess.run(commit, capture_output=True, text=True, check=True).stdout.strip()
    made["date"] = time.strftime("%Y-%m-%d")
    for number, launches in launches_of_plans(setattr).items():
        rows = plans[str(number)] = {}
        for name, launch in launches.items():
            rows[name] = {f"sm_{a}": measured(launch, a) for a in architectures}
            print(number, name, rows[name], flush=True)
    spilling = sum(cell["spills"] for rows in plans.values() for row in rows.values() for cell in row.values())
    headline = {"kernels": len(plans["4"]), "spilling": spilling}
    content = {"headline": headline, "made": made, "plans": plans}
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")
    path.with_suffix(".md").write_text(page(content), encoding="utf-8")


def page(content):
    """The tables as a page."""
    names = list(next(iter(content["plans"]["4"].values())))
    lines = [
        "# What the GPU's kernels take", "",
        "From their compiled form, without a device: `PYTHONPATH=.:tests python tests/triton_compiling.py "
        f"{' '.join(n.removeprefix('sm_') for n in names)} --write docs/results/kernels.json` (Triton "
        f"{content['made']['triton']}, the launch of each kernel with the most in it, not blended, eight channels; the "
        "march and pictures of 6 planes an MPI).", "",
        "Each cell: registers of a thread / bytes of shared memory of a program / occupancy, the share of a "
        "multiprocessor's warps that fit. Bytes are those of the arrays with an entry for each ray, sample or row, "
        "read or written once; what kernels look up in tables comes on top. The roof is the memory's bandwidth over "
        "these bytes. The march takes fewer rays a program where there are many heads.",
    ]  # fmt: skip
    for number, rows in content["plans"].items():
        title = f"## {number} MPIs" if number == "4" else f"## {number} MPIs, where that changes a kernel"
        lines += ["", title, "", *_table(rows, names)]
    return "\n".join(lines) + "\n"


def _table(rows, names):
    lines = [
        "| kernel | " + " | ".join(names) + " | spills | bytes an item | roof, A100 / H100, million items/s |",
        "|---|" + "---|" * (len(names) + 3),
    ]
    for name, row in rows.items():
        cells = [f"{row[n]['registers']} / {row[n]['shared']} / {100 * row[n]['occupancy']:.0f} %" for n in names]
        spilling = [n for n in names if row[n]["spills"]]
        roofs = " / ".join(f"{row[n]['million_items_per_s'] or '-'}" for n in ("sm_80", "sm_90") if n in row)
        cells += [", ".join(spilling) or "none", str(row[names[0]]["bytes_per_item"]), roofs]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return lines


def main(architectures, largest):
    """Compiles all, or the largest of each kernel, and says what does not compile."""
    launches, failed = all_launches(setattr), 0
    launches = list(largest_launches(launches).values()) if largest else launches
    print(f"Triton {triton.__version__}: {len(launches)} kernels", flush=True)
    for architecture in architectures:
        start, spilling = time.monotonic(), []
        for launch in launches:
            try:
                if spills(launch.compiled(architecture)):
                    spilling.append(launch.name)
            except Exception as error:
                failed += 1
                print(f"sm_{architecture} {launch.name} {dict(launch.constants)}: {type(error).__name__}: {error}")
        seconds = time.monotonic() - start
        said = f"registers spill in {', '.join(spilling)}" if spilling else "no register spills"
        print(f"sm_{architecture}: {failed} failed so far, {said}, {seconds:.0f} s", flush=True)
    return failed > 0


if __name__ == "__main__":
    if "--write" in sys.argv:
        place = Path(sys.argv[sys.argv.index("--write") + 1])
        sys.exit(write_table(place, [int(word) for word in sys.argv[1:] if word.isdigit()] or list(WARPS)))
    sys.exit(main([int(word) for word in sys.argv[1:] if word.isdigit()] or ARCHITECTURES, "--largest" in sys.argv))
