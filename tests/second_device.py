"""A device that is not the CPU, on a machine without a GPU: what mixes devices fails on it as it does on a GPU.

It is torch's slot for devices of others (``second``), with the CPU's memory and operations (``second_device.cpp``).
Once a process has registered it, it stays: tests that use it run in a process of their own.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn
from torch.utils import cpp_extension

SOURCE = Path(__file__).with_suffix(".cpp")


def register(build: Path) -> None:
    """Makes ``second`` a device of torch in this process, compiled in a folder (half a minute)."""
    device: Any = cpp_extension.load(
        "second_device", [str(SOURCE)], extra_cflags=["-O1", "-DNDEBUG", "-std=c++17"], build_directory=str(build)
    )
    device.register_hooks()
    torch.utils.rename_privateuse1_backend("second")
    torch._register_device_module("second", _module())
    torch.utils.generate_methods_for_privateuse1_backend(for_storage=True)
    nn.Module._apply = _apply  # type: ignore[method-assign]


def _module() -> ModuleType:
    """``torch.second``, as ``torch.cuda``."""
    module: Any = ModuleType("torch.second")
    module.is_available = module.is_initialized = lambda: True
    module.device_count, module.current_device = lambda: 1, lambda: 0
    module._is_in_bad_fork = lambda: False
    module.manual_seed_all = module._lazy_init = lambda *_: None
    module.get_amp_supported_dtype = lambda: [torch.float16, torch.bfloat16]
    return module


_moved = nn.Module._apply


def _apply(self: nn.Module, fn: Any, recurse: bool = True) -> nn.Module:
    """torch keeps the objects of parameters that move to a GPU, but not of those that move to a device of others."""
    before = dict(self._parameters)
    _moved(self, fn, recurse)
    for name, old in before.items():
        new = self._parameters[name]
        if new is not None and type(new) is not type(old):
            new.__class__ = type(old)
            new.__dict__.update(vars(old))
    return self
