"""docs/errors.md has the sentences of the code, its errors, and a test for each; pages of the top level are links."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ERRORS = ("InputError", "WriteError", "Damaged")


def template(node):
    """A string of the code with {} for what is put into it; None where it is no string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return None


def parsed(but=""):
    """The modules of both packages, but for those of one folder."""
    paths = [
        path
        for name in ("mmpi_ns", "mmpi_priors", "mmpi_prepare", "mmpi_show", "mmpi_scene")
        for path in (ROOT / name).rglob("*.py")
    ]
    return [ast.parse(path.read_text(encoding="utf-8")) for path in paths if path.parent.name != but]


def raised(trees):
    """The sentences of all errors of ours."""
    found = set()
    for tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                name = getattr(node.exc.func, "id", None)
                if name in ERRORS and node.exc.args and (text := template(node.exc.args[0])):
                    found.add(text)
    return found


def rows():
    """(sentence with {} for names, name of the test) of every row."""
    for line in (ROOT / "docs/errors.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| ") and len(cells) == 4 and not cells[0].startswith(("what", "---")):
            yield re.sub(r"\{[^}]*\}", "{}", cells[1]), cells[3].strip("`")


def test_every_sentence_of_the_table_is_in_the_code():
    texts = [t for tree in parsed() for node in ast.walk(tree) if (t := template(node))]
    missing = [sentence for sentence, _ in rows() if not any(sentence in text for text in texts)]
    assert not missing, missing


def test_every_error_of_the_code_is_in_the_table():
    """But those of mmpi-prepare, which ends with them before anything is made (docs/prepare.md)."""
    told = {sentence for sentence, _ in rows()}
    missing = sorted(text for text in raised(parsed("prepare")) if text not in told and text.strip("{}: "))
    assert not missing, "\n".join(missing)


def test_every_row_names_a_test_that_exists():
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    missing = [name for _, name in rows() if not re.search(rf"^def {name}\(", text, re.MULTILINE)]
    assert len(list(rows())) > 60 and not missing, missing


@pytest.mark.parametrize("name", ["CHANGELOG.md", "CONTRIBUTING.md"])
def test_pages_of_the_top_level_are_links(name):
    """A copy in docs/ falls behind; editors that replace a file make one of a link."""
    assert (ROOT / "docs" / name).readlink() == Path("..") / name
