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
    *("utils", "scene", "ops", "heads", "blending", "sampler"),
    *("placement", "data", "field", "rendering", "training", "model", "config"),
]
"""Each may import itself and what comes before it."""
COMPANIONS = {
    "mmpi_priors": {"utils", "scene", "ops", "placement", "data"},
    "mmpi_prepare": {"utils", "scene", "placement", "data", "scripts", "mmpi_priors"},
    "mmpi_show": {*METHOD, "functional", "scripts"},
    "mmpi_scene": {"utils", "scripts"},
}
"""Packages beside the method, which never imports them."""
COMMANDS = {
    "functional": set(METHOD),
    "": {"functional"},
    "bench": set(METHOD),
    "scripts": {*METHOD, "bench"},
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
        found = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"{name}: write imports in full"
        inside = [f"{node.module}.{alias.name}" for alias in node.names]
        found = [each if each in MODULES else str(node.module) for each in inside]
    else:
        found = []
    return [each for each in found if each.split(".")[0] in ("mmpi_ns", *COMPANIONS)]


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


@pytest.mark.parametrize("name", sorted(n for n in MODULES if wing(n) in COMPANIONS))
def test_companions_import_no_command_of_the_method(name):
    assert {each for each in imports(name) if wing(each) == "scripts"} <= {"mmpi_ns.scripts.command"}


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


@pytest.mark.parametrize("name", sorted(n for n in MODULES if wing(n) not in ("scripts", "") and "__main__" not in n))
def test_nothing_of_ours_is_imported_for_types_alone(name):
    """Commands may: they answer --help before anything large is read. So may the root, which names the functional entry
    to type checkers and imports it when it is first asked for."""
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    for_types = [node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)]
    assert [each for block in for_types for node in ast.walk(block) for each in imported(node, name)] == []


@pytest.mark.parametrize("name", sorted(n for n in MODULES if wing(n) in METHOD))
def test_only_triton_is_imported_within_a_function(name):
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    inner = [each for function in functions for node in ast.walk(function) for each in imported(node, name)]
    assert [each for each in inner if "triton" not in each] == []


def test_the_root_holds_the_method_and_the_functional_entry_alone():
    assert {path.name for path in ROOT.glob("*.py")} == {
        f"{name}.py" for name in ("__init__", "config", "model", "heads", "sampler", "blending", "functional")
    }


def test_importing_the_package_imports_nothing_large():
    """Torch takes seconds: it is imported when a function is first asked for."""
    code = "import sys, mmpi_ns; assert not {'torch', 'nerfstudio', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_methods_reads_no_library_that_only_priors_or_scores_need():
    """Every ns-* command imports them. OpenCV is among nerfstudio's own imports; of priors the settings are read."""
    code = (
        "import sys, mmpi_ns.config; assert not {'scipy.signal', 'pycolmap'} & set(sys.modules); "
        "assert {m for m in sys.modules if m.startswith('mmpi_priors')} == {'mmpi_priors', 'mmpi_priors.settings'}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


BESIDE = {path.stem: path for folder in ("benchmarks", "examples") for path in (ROOT.parent / folder).glob("*.py")}


@pytest.mark.parametrize("name", sorted(MODULES))
def test_the_package_imports_neither_benchmarks_nor_examples(name):
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    plain = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    plain |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert len(BESIDE) > 20 and not plain & (BESIDE.keys() | {"benchmarks", "examples"})


def test_modules_beside_the_package_have_names_of_their_own():
    """They are imported by their bare names, as scripts are."""
    paths = [p for folder in ("benchmarks", "examples", "tests") for p in (ROOT.parent / folder).glob("*.py")]
    names = [path.stem for path in paths]
    assert len(set(names)) == len(names) and not set(names) & (sys.stdlib_module_names | {"mmpi_ns"})
