# SPDX-License-Identifier: Apache-2.0
"""The check of the documents' language finds what it is for, and only in what people read."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LANGUAGE = runpy.run_path(str(ROOT / "docs" / "language.py"))
PLAIN = "# Title\n\nA short sentence. `told` is code, and $told$ a symbol.\n\n```sh\nuntold\n```\n"


@pytest.fixture
def check(tmp_path):
    def faults_of(text, name="page.md"):
        (tmp_path / name).write_text(text)
        return list(LANGUAGE["faults"](tmp_path / name))

    return faults_of


def test_plain_text_has_no_fault(check):
    assert check(PLAIN) == []
    assert check("| " + "cell " * 40 + "|\n") == []  # a row is no sentence, and cannot be broken


@pytest.mark.parametrize("words", ["untold noise", "Must: 5 ms", "last answer", "map of before"])
def test_refused_words_are_found_where_they_stand(check, words):
    ((line, fault),) = check(f"{PLAIN}\nSo {words}.\n")
    assert line == 9 and fault.startswith("'")


def test_long_sentences_and_lines_are_found(check):
    half = "word " * 20 + "\n"
    ((line, fault),) = check(f"{PLAIN}\n{half}{half}")
    assert line == 9 and "40 words" in fault
    assert check(f"- {half}- {half}") == []
    assert check("Word. " * 25 + "\n") == [(1, "a line of 150 characters")]


def test_a_table_that_runs_into_another_is_found(check):
    ((line, fault),) = check("| a | b |\n| --- | --- |\n| `x|y` | 1 \\| 2 |\n| c |\n")
    assert line == 4 and "1 cells under one of 2" in fault


def test_seeds_belong_to_the_results(check):
    assert check("Seeds 101–120 chose.\n") and check("Seeds from 7 on.\n")
    assert not check("Seeds 101–120 chose.\n", "RESULTS.md")
