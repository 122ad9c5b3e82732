"""Runs nerfstudio's and our commands as a user does, each in a fork of one process that has imported everything."""

from __future__ import annotations

import copy
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

COMMANDS = {
    "ns-train": "nerfstudio.scripts.train",
    "ns-eval": "nerfstudio.scripts.eval",
    "ns-render": "nerfstudio.scripts.render",
    "ns-viewer": "nerfstudio.scripts.viewer.run_viewer",
    "mmpi-plan": "mmpi_ns.scripts.plan",
    "mmpi-scene": "mmpi_scene.__main__",
    "mmpi-export": "mmpi_show.__main__",
}
CALM = {
    "machine.device_type": "cpu", "vis": "tensorboard", "max_num_iterations": 3, "experiment_name": "tiny",
    "timestamp": "run", "pipeline.datamanager.train_num_rays_per_batch": 64, "pipeline.datamanager.keypoint_rays": 16,
    "pipeline.datamanager.priors.dense_depth": False, "pipeline.model.colour.hidden_width": 8,
    "pipeline.model.lpips_net": "none",
}  # fmt: skip
"""A run of a second or so."""

os.environ.setdefault("OMP_NUM_THREADS", "1")
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload([*COMMANDS.values(), "mmpi_ns.config", "mmpi_ns.data.datamanager", "pycolmap"])


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int
    out: str
    error: str

    @property
    def sentence(self) -> str:
        """What was said at the end, which must be one sentence and all there is of an error."""
        assert self.status == 1, (self.status, self.out[-2000:], self.error[-4000:])
        lines = self.error.strip().splitlines()
        name, said = lines[-1].split(": ", 1)
        if name in COMMANDS:  # of ours
            assert "Traceback" not in self.error, self.error
        else:  # nerfstudio's show a traceback, which ends with the sentence
            assert name in ("mmpi_ns.utils.errors.InputError", "mmpi_ns.utils.errors.WriteError"), self.error[-4000:]
        assert said.endswith(".") and ". " not in said and len(said) < 500, said
        return said

    @property
    def printed(self) -> str:
        """What a run that did not end early printed, in one line."""
        assert self.status == 0, (self.status, self.out[-2000:], self.error[-4000:])
        assert "Traceback" not in self.error + self.out, self.error[-4000:]
        return " ".join(self.out.split())


class Running:
    """A command that has been started."""

    def __init__(self, name, options, arguments, memory, environment=None, printed_to=None):
        self.folder = Path(tempfile.mkdtemp(prefix="trust", dir=os.environ["XDG_CACHE_HOME"]))  # conftest removes it
        for stream in ("out", "error") if printed_to is not None else ():
            (self.folder / stream).symlink_to(printed_to)
        given = (self.folder, name, options, arguments, memory, environment or {})
        self.process = _context.Process(target=_child, args=given, daemon=True)
        self.process.start()

    def text(self, stream="out"):
        path = self.folder / stream
        return path.read_text(errors="replace") if path.is_file() else ""

    def wait_for(self, text, timeout=60):
        """Until the command has printed this."""
        end = time.monotonic() + timeout
        while text not in self.text() and time.monotonic() < end and self.process.is_alive():
            time.sleep(0.02)
        assert text in self.text(), (self.text()[-2000:], self.text("error")[-2000:])

    def send(self, number):
        os.kill(self.process.pid, number)

    def end(self, timeout=100):
        self.process.join(timeout)
        if self.process.is_alive():
            self.process.kill()
            raise AssertionError(f"still running after {timeout} s: {self.text()[-1000:]}")
        return Ended(self.process.exitcode, self.text(), self.text("error"))


def start(name, *arguments, environment=None):
    """Starts a command with arguments."""
    return Running(name, None, [str(a) for a in arguments], None, environment)


def run(name, *arguments):
    """Runs a command to its end."""
    return start(name, *arguments).end()


def train(data, output, method="mmpi_small", memory=None, **options):
    """ns-train from where the command line has been read: dots in names of options are written as two underscores."""
    return start_train(data, output, method, memory, **options).end()


def start_train(data, output, method="mmpi_small", memory=None, environment=None, printed_to=None, **options):
    dotted = {name.replace("__", "."): value for name, value in options.items()}
    given = CALM | {"data": Path(data), "output_dir": Path(output), "method": method} | dotted
    return Running("ns-train", given, [], memory, environment, printed_to)


def _child(folder, name, options, arguments, memory, environment):
    for number, stream in ((1, "out"), (2, "error")):
        os.dup2(os.open(folder / stream, os.O_CREAT | os.O_WRONLY | os.O_APPEND), number)
    sys.stdout = open(1, "w", buffering=1, closefd=False)
    sys.stderr = open(2, "w", buffering=1, closefd=False)
    sys.excepthook = sys.__excepthook__
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup, too
    os.environ.update(environment, COLUMNS="1000")  # sentences are not broken into lines
    if memory is not None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
    status = 0
    try:
        sys.argv = [f"/bin/{name}", *arguments]
        module = import_module(COMMANDS[name])
        module.entrypoint() if options is None else module.main(_config(options))
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        status = 130 if isinstance(error, KeyboardInterrupt) else 1
    sys.stdout.flush(), sys.stderr.flush()
    os._exit(status)


def _config(options):
    config = copy.deepcopy(getattr(import_module("mmpi_ns.config"), options.pop("method")).config)
    for name, value in options.items():
        *path, last = name.split(".")
        target = config
        for part in path:
            target = getattr(target, part)
        assert hasattr(target, last), name
        setattr(target, last, value)
    return config
