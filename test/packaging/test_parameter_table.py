# SPDX-License-Identifier: Apache-2.0
"""docs/parameters.md equals the table."""

import runpy
from pathlib import Path

from quadtree_lss.onboard.config.settings import parameters

DOCS = Path(__file__).parents[2] / "docs"
parameter_table = runpy.run_path(str(DOCS / "parameters.py"))["parameter_table"]


def test_the_document_is_up_to_date():
    written = (DOCS / "parameters.md").read_text(encoding="utf-8")
    remedy = "python docs/parameters.py > docs/parameters.md"
    assert written == parameter_table(), f"docs/parameters.md is stale: {remedy}"


def test_every_parameter_has_one_row_of_four_cells():
    rows = [line for line in parameter_table().splitlines() if line.startswith("| `")]
    assert [line.split("`")[1] for line in rows] == [row.name for row in parameters()]
    assert {line.count("|") for line in rows} == {5}
