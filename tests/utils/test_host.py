"""What the package changes in its host, and that it does so nowhere else, in commands alone, and until it is undone."""

from __future__ import annotations

import ast
import errno
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers import nerfstudio_dataparser
from nerfstudio.utils.rich_utils import CONSOLE
from training_runs import ready, trainer_config

import mmpi_ns
from mmpi_ns.utils import host
from mmpi_ns.utils.errors import InputError

ROOT = Path(mmpi_ns.__file__).parent
COMPANIONS = ("mmpi_priors", "mmpi_prepare", "mmpi_show", "mmpi_scene")
FOLDERS = (ROOT, *(ROOT.parent / name for name in COMPANIONS))
FILES = [path for folder in FOLDERS for path in folder.rglob("*.py")]
HOST_CALLS = {"signal.signal", "sys.settrace", "warnings.filterwarnings", "warnings.simplefilter", "setattr"}
LISTED = {
    ("mmpi_priors/sfm.py", "signal.signal"),  # puts back what pycolmap replaces at its import
    ("mmpi_prepare/features.py", "warnings.simplefilter"),  # in a block that puts the filters back
    ("mmpi_ns/bench/gpu.py", "warnings.simplefilter"),  # likewise
}


def state():
    """What PATCHES change, but for malloc, which cannot be asked."""
    handlers = tuple(signal.getsignal(number) for number in host.SIGNALS)
    console = {name: vars(CONSOLE).get(name) for name in ("print", "log", "on_broken_pipe", "_check_buffer")}
    return (
        sys.excepthook,
        tuple(warnings.filters),
        console,
        handlers,
        sys.gettrace(),
        nerfstudio_dataparser.load_from_json,
    )


@pytest.fixture
def mallocs(monkeypatch):
    """What malloc is asked to keep, instead of asking it."""
    host.undo()  # what another test of this process has left
    asked = []
    library = SimpleNamespace(mallopt=lambda *setting: asked.append(setting))
    monkeypatch.setattr(host, "ctypes", SimpleNamespace(CDLL=lambda name: library))
    yield asked
    host.undo()


@pytest.mark.parametrize("training", [False, True])
def test_every_patch_is_undone(monkeypatch, mallocs, training):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/ns-train", "mmpi-small"])
    before = state()
    host.enter_command(training)
    patched = state()
    assert all(a != b for a, b in zip(before[:3], patched[:3], strict=True)), "each of them is made"
    kept = [(host.TRIM_THRESHOLD, host.KEPT), (host.MMAP_THRESHOLD, host.OWN_MAPPING)]
    assert mallocs == (kept if training else [])
    host.enter_command(training)
    assert state() == patched, "once"
    host.undo()
    assert state() == before
    given_back = [(number, host.MALLOC_DEFAULT) for number, _ in kept]
    assert mallocs[2:] == (given_back if training else [])


def test_patches_say_what_they_change_and_why():
    for patch in (*host.PATCHES, *host.TRAINING_PATCHES):
        target, _, reason = patch.__doc__.partition(": ")
        assert target and reason.endswith(".")


@pytest.mark.parametrize(
    ("program", "name"),
    [
        ("/venv/bin/ns-train", "ns-train"),
        ("mmpi-plan", "mmpi-plan"),
        ("/site-packages/nerfstudio/scripts/train.py", "ns-train"),
        ("/src/mmpi_ns/scripts/train.py", "ns-train"),
        ("/home/me/train.py", None),
        ("/venv/bin/jupyter", None),
        ("", None),
    ],
)
def test_a_command_is_known_by_its_program(monkeypatch, program, name):
    monkeypatch.setattr(sys, "argv", [program, "--viewer.websocket_host=0.0.0.0", "--output_path", "my_path"])
    assert host.command() == name
    assert host.arguments() == (["--viewer.websocket-host=0.0.0.0", "--output-path", "my_path"] if name else [])


def test_a_program_that_trains_with_this_package_keeps_its_own_hooks(scene, plan_file, tmp_path, mallocs):
    before = state()
    config = trainer_config(scene, plan_file, tmp_path, 2)
    config.set_timestamp()
    config.save_config()
    ready(config).train()
    config.get_checkpoint_dir()
    assert state() == before and mallocs == []


def test_a_closed_terminal_ends_nothing_under_nohup():
    called, before = [], signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with host.signals_go_to(called.append):
        signal.raise_signal(signal.SIGHUP)
    assert signal.signal(signal.SIGHUP, before) == signal.SIG_IGN and not called


def test_nothing_happens_at_import():
    work = """if True:
        import importlib, pkgutil, signal, sys, warnings
        import nerfstudio.scripts.train, nerfstudio.scripts.eval, torch, cv2, PIL.Image
        from nerfstudio.data.dataparsers import nerfstudio_dataparser
        from nerfstudio.utils.rich_utils import CONSOLE
        sys.argv = ["/venv/bin/ns-train"]
        def state():
            handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
            hooks = sys.excepthook, sys.gettrace(), nerfstudio_dataparser.load_from_json, dict(vars(CONSOLE))
            ours = [f for f in warnings.filters if f[1] is not None and "mmpi" in str(f)]
            return *hooks, *handlers, ours
        before = state()
        import mmpi_ns.config, mmpi_ns.utils.host
        for wing in ("capture", "rendering", "training", "export"):
            package = importlib.import_module(f"mmpi_ns.{wing}")
            for module in pkgutil.walk_packages(package.__path__, f"mmpi_ns.{wing}."):
                importlib.import_module(module.name)
        assert state() == before and not mmpi_ns.utils.host._entered
    """
    done = subprocess.run([sys.executable, "-c", work], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def name_of(node):
    return f"{name_of(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


@pytest.mark.parametrize("path", [p for p in FILES if p.name != "host.py"], ids=lambda p: f"{p.parent.name}/{p.name}")
def test_no_other_module_changes_what_it_imports(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {(alias.asname or alias.name).split(".")[0] for node in imports for alias in node.names}
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            if isinstance(target, ast.Attribute):
                assert name_of(target).split(".")[0] not in names, f"line {target.lineno} assigns to {name_of(target)}"
        if isinstance(node, ast.Call) and name_of(node.func) in HOST_CALLS:
            patches = name_of(node.func) != "setattr" or name_of(node.args[0]).split(".")[0] in names
            place = (path.relative_to(ROOT.parent).as_posix(), name_of(node.func))
            assert not patches or place in LISTED, f"line {node.lineno} calls {name_of(node.func)}"
        assert name_of(node) != "sys.argv" or path.parts[-2:] == ("baked", "reader.py"), f"line {node.lineno}"


def test_an_input_error_is_one_sentence_and_others_keep_their_traceback(monkeypatch, mallocs, capsys):
    monkeypatch.setattr(sys, "argv", ["ns-train"])
    shown = []
    monkeypatch.setattr(sys, "excepthook", lambda *error: shown.append(error))
    host.enter_command()
    sys.excepthook(InputError, InputError("The scene is empty."), None)
    assert capsys.readouterr().err == "ns-train: The scene is empty.\n" and not shown
    sys.excepthook(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not shown and capsys.readouterr().err.endswith(": Interrupted.\n")
    sys.excepthook(OSError, OSError(errno.ENOSPC, "No space left on device", "/out/config.yml"), None)
    assert not shown and "/out/config.yml could not be written (No space left" in capsys.readouterr().err
    sys.excepthook(RuntimeError, RuntimeError("Error writing 'fly.mp4': [mp4] No space left on device"), None)
    assert not shown and "could not be written (No space left" in capsys.readouterr().err
    sys.excepthook(KeyError, KeyError("x"), None)
    sys.excepthook(OSError, OSError(errno.ENOENT, "No such file or directory"), None)
    assert len(shown) == 2


def test_a_closed_terminal_ends_no_work(monkeypatch, mallocs):
    """Its signal comes a moment later."""
    monkeypatch.setattr(sys, "argv", ["ns-train"])
    reader, terminal = os.openpty()
    discarded = []
    host.enter_command()
    with open(terminal, "w") as output:
        monkeypatch.setattr(CONSOLE, "file", output)
        monkeypatch.setattr(host, "discard", lambda number: discarded.append(number) or os.dup2(null, terminal))
        CONSOLE.print("step 10")
        os.close(reader)
        with open(os.devnull, "w") as nothing:
            null = nothing.fileno()
            CONSOLE.print("step 20")
    assert discarded == [1]


def fail(error):
    raise error


TOO_MUCH = {
    "torch": lambda: torch.empty(2**58),
    "NumPy": lambda: np.empty(2**58),
    "a GPU": lambda: fail(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")),
    "threads": lambda: fail(RuntimeError("can't start new thread")),
}


@pytest.mark.parametrize("what", TOO_MUCH)
def test_memory_that_is_used_up_is_one_sentence(monkeypatch, mallocs, capsys, what):
    monkeypatch.setattr(sys, "argv", ["ns-train"])
    host.enter_command()
    with pytest.raises((MemoryError, RuntimeError)) as raised:
        TOO_MUCH[what]()
    sys.excepthook(type(raised.value), raised.value, None)
    said = capsys.readouterr().err
    assert said.startswith("ns-train: Memory is used up (") and said.count("\n") == 1 and ". " not in said.strip()


def test_scores_of_one_test_image_come_without_a_warning(monkeypatch, mallocs):
    monkeypatch.setattr(sys, "argv", ["ns-eval"])
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        host.enter_command()
        assert torch.std_mean(torch.ones(1))[0].isnan() and not shown
        host.undo()
        torch.std_mean(torch.ones(1))
    assert len(shown) == 1, "torch still warns"


def test_a_transforms_file_is_changed_within_the_block_alone(tmp_path):
    (tmp_path / "t.json").write_text('{"a": 1}')
    read = nerfstudio_dataparser.load_from_json
    with (
        pytest.raises(KeyError),
        host.transforms_changed(nerfstudio_dataparser, lambda meta, path: meta | {"b": path.name}),
    ):
        assert nerfstudio_dataparser.load_from_json(tmp_path / "t.json") == {"a": 1, "b": "t.json"}
        raise KeyError
    assert nerfstudio_dataparser.load_from_json is read
