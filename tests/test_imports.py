"""Imports run one way: who may import whom, no circle, and nothing hidden."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import mmpi_ns

ROOT = Path(mmpi_ns.__file__).parent
METHOD = [
    *("utils", "settings", "scene", "ops", "heads", "blending", "sampler"),
    *("placement", "data", "field", "rendering", "training", "viewer", "model", "config"),
]
"""Each may import itself and what comes before it."""
COMPANIONS = {
    "mmpi_priors": {"utils", "settings", "scene", "ops", "placement", "data"},
    "mmpi_prepare": {"utils", "scene", "placement", "data", "scripts", "mmpi_priors"},
    "mmpi_show": {*METHOD, "functional", "scripts"},
    "mmpi_scene": {"utils", "scripts"},
}
"""Packages beside the method, which never imports them."""
COMMANDS = {
    "functional": set(METHOD),
    "": {"functional"},
    "scripts": set(METHOD),
}
MAY_IMPORT = {wing: set(METHOD[: i + 1]) for i, wing in enumerate(METHOD)}
MAY_IMPORT |= {wing: others | {wing} for wing, others in (COMMANDS | COMPANIONS).items()}
ASSEMBLY = {"mmpi_ns.config": {"mmpi_priors"}}
"""What puts the parts together, and companions that it names."""

MODULES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in (ROOT, *(ROOT.parent / name for name in COMPANIONS))
    for path in folder.rglob("*.py")
}


def imported(node: ast.AST, name: str) -> list[str]:
    """Modules of our packages that an import statement reads."""
    if isinstance(node, ast.Import):
        actual = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"{name}: write imports in full"
        inside = [f"{node.module}.{alias.name}" for alias in node.names]
        actual = [each if each in MODULES else str(node.module) for each in inside]
    else:
        actual = []
    return [each for each in actual if each.split(".")[0] in ("mmpi_ns", *COMPANIONS)]


def imports(name: str) -> set[str]:
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    return {each for node in ast.walk(tree) for each in imported(node, name)}


def wing(name: str) -> str:
    package, *rest = name.split(".")
    return package if package in COMPANIONS else rest[0] if rest else ""


@pytest.mark.parametrize("name", sorted(MODULES))
def test_a_module_imports_only_wings_before_its_own(name):
    allowed = MAY_IMPORT.get(wing(name), set()) | ASSEMBLY.get(name, set())
    assert {wing(each) for each in imports(name)} - {""} <= allowed


def test_no_import_goes_in_a_circle():
    graph, finished = {name: imports(name) & MODULES.keys() for name in MODULES}, set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in finished:
            for each in sorted(graph[name] - {name}):
                visit(each, (*path, name))
            finished.add(name)

    for name in graph:
        visit(name, ())


def test_importing_the_package_imports_nothing_large():
    """Torch takes seconds: it is imported when a function is first asked for."""
    code = "import sys, mmpi_ns; assert not {'torch', 'nerfstudio', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_settings_of_the_method_are_light():
    """Every ns-* command reads them, also those that run another method."""
    code = "import sys, mmpi_ns.config; print(*(m for m in sys.modules if m.startswith('mmpi_') or m in {heavy}))"
    heavy = {"scipy.signal", "pycolmap"}
    out = subprocess.run([sys.executable, "-c", code.format(heavy=heavy)], check=True, capture_output=True, text=True)
    loaded = out.stdout.split()
    assert not heavy & {*loaded} and len(loaded) <= 30, loaded


def test_modules_beside_the_package_have_names_of_their_own():
    """They are imported by their bare names, as scripts are."""
    paths = [p for folder in ("benchmarks", "examples", "tests") for p in (ROOT.parent / folder).glob("*.py")]
    names = [path.stem for path in paths]
    assert len(set(names)) == len(names) and not set(names) & (sys.stdlib_module_names | {"mmpi_ns"})
