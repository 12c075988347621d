"""A sample of the campaign of damage: what must be read of a damaged bag is read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bag_support import SHARED_BAGS
from bnirl_ros.bags.reader import Bag
from bnirl_ros.experiments.damage import Damage, campaign, main, problem_with, stretches_of

SHIPPED = Path(__file__).resolve().parent.parent / "bags"
FILES = [SHIPPED / "paper_loop" / "paper_loop_0.mcap", *sorted(SHARED_BAGS.rglob("*.mcap"))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_all_before_the_damage_is_read(path: Path) -> None:
    result = campaign(path, cuts=3, changes=5)
    assert result.problems == ()
    assert result.damages == 8


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_campaign_knows_what_is_in_a_file(path: Path) -> None:
    told = [each for part in stretches_of(path.read_bytes()) for each in part.messages]
    read = [(message.log_time, message.data) for message in Bag(path).messages()]
    assert sorted(told) == sorted(read)


def test_the_campaign_tells_what_is_missing(tmp_path: Path) -> None:
    data = FILES[0].read_bytes()
    stretches = stretches_of(data)
    # The file that is read is cut off earlier than the campaign takes it to be.
    shorter = data[: len(data) // 4]
    problem = problem_with(tmp_path / "bag.mcap", Damage(len(data) // 2, None), shorter, stretches)
    assert problem is not None
    assert problem.startswith("misses ")


def test_the_command_tells_of_every_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(FILES[0], tmp_path)
    assert main([str(tmp_path), "--cuts", "2", "--changes", "1", "--jobs", "1"]) == 0
    *_, row, _ = capsys.readouterr().out.split("\n")[:4]
    assert row.startswith("| paper_loop_0.mcap | 604 | 3 | 0 |")
    assert main([str(tmp_path / "nothing")]) == 1
    assert "no MCAP files" in capsys.readouterr().err
