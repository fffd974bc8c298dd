# SPDX-License-Identifier: Apache-2.0
"""The lock file holds all of constraints.txt with hashes, and that is all that is needed."""

import re
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PYTHONS = ("3.10", "3.11", "3.12", "3.13")


def pinned(python):
    """Version by name for a Python, as constraints.txt has it."""
    lines = (line.partition("#")[0].strip() for line in text("constraints.txt").splitlines())
    return versions(map(Requirement, filter(None, lines)), python)


def locked(python):
    """The same of requirements.lock, of which each entry must have hashes."""
    entries = re.split(r"\n(?=\S)", text(".ci/requirements.lock").partition("\n")[2])
    requirements = []
    for entry in entries:
        requirement, *hashes = entry.replace("\\\n", "").split("--hash=")
        assert hashes and all(re.fullmatch(r"sha256:[0-9a-f]{64}\s*", h) for h in hashes), entry
        requirements.append(Requirement(requirement.strip()))
    return versions(requirements, python)


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def versions(requirements, python):
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    return {
        canonicalize_name(item.name): str(item.specifier)
        for item in requirements
        if item.marker is None or item.marker.evaluate(environment)
    }


@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_is_up_to_date(python):
    found = locked(python)
    assert len(found) > 100 and set(found.values()) and found == pinned(python), "run `make lock`"
    assert all(re.fullmatch(r"==[\w.]+", version) for version in found.values())


def test_nothing_that_is_needed_is_missing():
    """What the package asks for, and what that asks for, as far as it is installed here."""
    wanted = ["quadtree_lss[desk,wheels,exchange,autopilot,campaign,docs,test]"]
    seen, names = set(), set(pinned("3.10")) | set(pinned("3.13"))
    while wanted:
        requirement = Requirement(wanted.pop())
        name = canonicalize_name(requirement.name)
        if (name, *sorted(requirement.extras)) in seen:
            continue
        seen.add((name, *sorted(requirement.extras)))
        try:
            asked = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # for another Python, or ROS itself is used instead of its wheels
        assert name == "quadtree-lss" or name in names, f"{name} is not in constraints.txt"
        for text_ in asked:
            item = Requirement(text_)
            extras = ["", *requirement.extras]
            if item.marker is None or any(item.marker.evaluate({"extra": e}) for e in extras):
                wanted.append(text_)
    assert len(seen) > 20


@pytest.mark.xdist_group("together")
def test_tests_of_a_group_stay_together(request):
    """With pytest 9.2.0 xdist 3.8.0 deals them out singly, without a word: nodes then start side by
    side, and what a module shares is made twice."""
    if not request.config.getoption("loadgroup", False):
        pytest.skip("not with --dist loadgroup")
    assert request.node.nodeid.endswith("@together")
