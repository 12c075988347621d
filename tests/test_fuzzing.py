"""A sample of the campaign of bad input: every door refuses it in a sentence, or bears it."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from bnirl_ros.errors import InputError
from bnirl_ros.fuzzing.__main__ import main
from bnirl_ros.fuzzing.campaign import campaign
from bnirl_ros.fuzzing.doors import Door, doors
from bnirl_ros.fuzzing.mutation import mutated

DOORS = tuple(doors())


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.name.replace(" ", "_"))
def test_a_door_bears_bad_input(door: Door) -> None:
    account = campaign(door, inputs=60)
    assert account.faults == ()
    assert account.tried == 60
    assert account.memory < 2**28


def test_equal_seeds_try_equal_input() -> None:
    seeds = (b"0123456789" * 3, b"abcdef")
    one, other, third = (
        [mutated(seeds[0], seeds, generator) for _ in range(200)]
        for generator in (random.Random(0), random.Random(0), random.Random(1))
    )
    assert one == other != third
    assert len(set(one)) > 150


def raising(error: BaseException) -> Callable[[bytes, Path], object]:
    def enter(data: bytes, _: Path) -> None:
        if data != b"good":
            raise error

    return enter


def test_the_campaign_finds_faults_and_keeps_their_input() -> None:
    account = campaign(Door("weak", (b"good",), raising(IndexError("too far"))), inputs=50)
    assert len(account.faults) == 20  # enough
    assert all("IndexError at test_fuzzing.py" in fault.what for fault in account.faults)
    strong = campaign(Door("strong", (b"good",), raising(InputError("no"))), inputs=50)
    assert (strong.faults, strong.refused + strong.accepted) == ((), 50)
    silent = campaign(Door("silent", (b"good",), raising(InputError(" "))), inputs=50)
    assert silent.faults[0].what == "refused without a word"


def test_good_input_has_to_be_taken() -> None:
    def refuse(*_: object) -> None:
        raise InputError("not today")

    account = campaign(Door("shut", (b"good",), refuse), inputs=5)
    assert account.faults[0].what == "good input: refused"


def test_too_much_memory_is_a_fault() -> None:
    account = campaign(Door("greedy", (b"1",), lambda data, _: bytearray(2**33)), inputs=3)
    assert account.faults[0].what.startswith("good input: MemoryError")


def test_the_command_tells_of_every_door(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--only", "text grid", "--inputs", "20", "--out", str(tmp_path / "out")]) == 0
    *_, row = capsys.readouterr().out.strip().split("\n")
    assert row.startswith("| text grid | 20 |")
    assert not (tmp_path / "out").exists()
