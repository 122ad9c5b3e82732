"""Tables of README.md and docs/results are those that ``make results`` made."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from report import read_json
from results import finished, readme_table, results_page

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


@pytest.mark.parametrize(("page", "make"), [("README.md", readme_table), ("docs/results/README.md", results_page)])
def test_tables_are_those_that_were_measured(page, make):
    content, scored = read_json(RESULTS / "results.json"), read_json(RESULTS / "score.json")
    assert {row["commit"] for row in finished(content).values()} == {content["made"]["commit"]}
    text = (ROOT / page).read_text(encoding="utf-8")
    (table,) = re.findall(r"<!-- results -->\n\n(.*?)\n\n<!-- /results -->", text, re.DOTALL)
    assert table == make(content, scored)
