"""The version is one, of the package, of every command, of the changelog and of the citation; and tables of README.md
and docs/results are those that ``make results`` made."""

from __future__ import annotations

import json
import re
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import lab
import pytest
from report import read_json
from results import TABLES, finished, read_tables, readme_table, results_page

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
VERSION = re.findall(r'^version = "(.*)"', PYPROJECT, re.MULTILINE)[0]
COMMANDS = re.findall(r'^(mmpi-\w+) = "mmpi_\w+\.(?:__main__|scripts)', PYPROJECT, re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_the_version_of_pyproject(name, monkeypatch, capsys):
    (command,) = entry_points(group="console_scripts", name=name)
    monkeypatch.setattr(sys, "argv", [name, "--version"])
    with pytest.raises(SystemExit) as end:
        command.load()()
    assert (capsys.readouterr().out, end.value.code) == (f"{name} {VERSION}\n", None)


def test_changelog_and_citation_are_of_this_version():
    assert len(COMMANDS) == 4 and version("mmpi-ns") == VERSION
    newest = re.findall(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[0]
    cited = re.findall(r"^version: (\S+)", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert [newest, *cited] == [VERSION, VERSION]


def test_tables_are_those_that_were_measured():
    made, scored = read_tables(RESULTS), read_json(RESULTS / "score.json")
    assert [*made] == [*TABLES]
    for content in made.values():
        assert {row["commit"] for row in finished(content).values()} == {content["made"]["commit"]}
        command = content["made"]["command"].replace("python", "$(BIN)/python").replace("captures", "$(DATA)")
        assert f"\t{command} $(ARGS)\n" in (ROOT / "Makefile").read_text(encoding="utf-8")
    for page, expected in (("README.md", readme_table(made, scored)), ("docs/results/README.md", results_page(made))):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert re.findall(r"<!-- results -->\n\n(.*?)\n\n<!-- /results -->", text, re.DOTALL) == [expected]


@pytest.mark.parametrize("resumes", [True, False])
def test_an_interrupted_training_of_a_table_resumes_or_starts_anew(resumes, monkeypatch, tmp_path):
    checkpoint = tmp_path / "run" / "mmpi" / "1" / "nerfstudio_models" / "step-000000009.ckpt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    asked = []

    def as_if_run(words, log, threads, **variables):
        asked.append([words, checkpoint.exists()])
        (tmp_path / "eval.json").write_text(json.dumps({"results": {"psnr": 20.0}}))
        return lab.Used(3.0, 2.0, 1.0)

    monkeypatch.setattr(lab, "run_command", as_if_run)
    scene = lab.Scene(tmp_path, 1)
    run, results, row = lab.train_and_evaluate(scene, tmp_path, "mmpi", [], [], 1, resumes)
    (train, kept), (evaluate, _) = asked
    assert kept == resumes and ("--load-dir" in train) == resumes
    if resumes:
        assert train[train.index("--load-dir") + 1] == str(checkpoint.parent)
    assert str(run / "config.yml") in evaluate and results == {"psnr": 20.0}
    # What both parts took together is not known.
    assert row.get("processor_seconds") == (None if resumes else 2.0)
