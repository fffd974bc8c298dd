# SPDX-License-Identifier: Apache-2.0
"""What the command line says: what was likely meant, all errors at once."""

import json

from replay.test_cli import FAST, run


def test_words_that_are_not_known_are_named(capsys):
    for arguments, words in (
        (["relay", "bag"], ("'relay'", "replay")),
        (["replay", "bag", "--recrod=x"], ("--recrod=x",)),
        (["replay", "bag", "--config", "morfeus"], ("'morfeus'", "morpheus")),
        (["replay", "bag", "--set", "lss.margn=1"], ("'lss.margin'",)),
        (["replay", "bag", "--set", "vehicle.clearance=30"], ("vehicle.diameter = 3.7 m",)),
        (["export", "results", "--origin=470,8"], ("'470,8'", "LAT,LON in deg")),
    ):
        code, out, err = run(capsys, *arguments)
        assert code in (1, 2) and not out and err.count("\n") == 1
        assert all(word in err for word in words)


def test_every_error_of_a_configuration_is_told_at_once(tmp_path, capsys):
    bad = tmp_path / "bad.yaml"
    bad.write_text(
        "/**:\n  ros__parameters:\n    lss.margn: 1.0\n    domain.size: -3.0\n"
        "    domain.min_level: 9\n    lidar: {min_range: 20.0, max_range: 10.0}\n"
        "maping_node:\n  ros__parameters:\n    lss.margin: 1.0\n"
    )
    code, out, _ = run(capsys, "config", "check", bad, "morpheus")
    lines = [line.removeprefix(f"{bad}: ") for line in out.splitlines()]
    assert code == 1 and lines[-1] == "morpheus: good"
    words = ("mapping_node", "lss.margin", "domain.size", "domain.min_level", "mapping.max_cells")
    for word in (*words, "lidar.min_range"):
        assert sum(word in line for line in lines) == 1 + (word == "domain.min_level"), word
    assert len(lines) == 7
    shown = json.loads(run(capsys, "config", "check", bad, "morpheus", "--json")[1])
    assert shown == {str(bad): lines[:-1], "morpheus": []}


def test_quiet_json_is_json_alone(bag, tmp_path, capsys):
    noisy = ["--set", "lidar.range_noise=0.5"]  # which is warned of
    arguments = ["replay", bag, "--out", tmp_path, *FAST, *noisy, "--json"]
    assert "warning" in run(capsys, *arguments)[2]
    code, out, err = run(capsys, *arguments, "-q", "-v")
    assert code == 0 and err == "" and json.loads(out)["scans"] == 6
