"""Chains go on in another process where they were, and never with what is not theirs."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from bnirl_ros.errors import InputError
from bnirl_ros.inference.background import BackgroundInference
from bnirl_ros.inference.checkpoint import (
    FORMAT,
    Checkpoint,
    checkpoint_from,
    digest_of,
)
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.partition_gibbs import PartitionState
from bnirl_ros.inference.pursuit_gibbs import PursuitState
from bnirl_ros.inference.running import RunningPosterior
from bnirl_ros.maps.grid_map import FeatureMap, GridMap
from test_running import MAP, MODELS, SETTINGS, placed, recorded


def swept(model: str, draws: int = 20) -> RunningPosterior:
    running = RunningPosterior(placed(2), MAP, replace(SETTINGS, model=model))
    running.advance(draws)
    return running


@pytest.fixture(scope="module")
def written() -> bytes:
    """A checkpoint."""
    return swept("sequential").checkpoint().to_bytes()


def drawn(running: RunningPosterior, draws: int) -> Draws:
    """The next draws."""
    kept = running._kept
    running.advance(draws)
    assert running._draws is not None
    return Draws(*(values[:, kept : kept + draws] for values in vars(running._draws).values()))


@pytest.mark.parametrize("model", MODELS)
def test_chains_go_on_draw_for_draw(model: str) -> None:
    running = swept(model)
    checkpoint = checkpoint_from(running.checkpoint().to_bytes(), "file")
    resumed = RunningPosterior.resumed(checkpoint, MAP, running.settings)
    one, other = drawn(running, 30), drawn(resumed, 30)
    for name, values in vars(one).items():
        np.testing.assert_array_equal(values, getattr(other, name))


@pytest.mark.parametrize("model", MODELS)
def test_chains_take_in_what_came_since(model: str) -> None:
    settings = replace(SETTINGS, model=model)
    checkpoint = checkpoint_from(swept(model, 100).checkpoint().to_bytes(), "file")
    resumed = RunningPosterior.resumed(checkpoint, MAP, settings)
    more = RunningPosterior(placed(4), MAP, settings, resumed)
    fresh = RunningPosterior(placed(4), MAP, settings)
    for running in (more, fresh):
        while not running.finished:
            running.advance(40)
    one, other = (running.posterior() for running in (more, fresh))
    assert np.abs(one.subgoal_probability() - other.subgoal_probability()).max() < 0.1
    np.testing.assert_array_equal(one.mode.subgoal_of, other.mode.subgoal_of)


# Refusals


def refused(data: bytes) -> str:
    with pytest.raises(InputError, match=r"^file: .*; the chains start anew$") as refusal:
        checkpoint_from(data, "file")
    return str(refusal.value)


@pytest.mark.parametrize("data", [b"", b"\n", b"PK\x03\x04", b"bnirl_ros checkpoint 1 \n"])
def test_other_files_are_refused(data: bytes) -> None:
    assert "is no checkpoint of bnirl_ros" in refused(data)


def test_another_version_is_refused(written: bytes) -> None:
    data = written.replace(b"checkpoint %d " % FORMAT, b"checkpoint 77 ", 1)
    assert "has the format 77 where this version of bnirl_ros knows" in refused(data)


def test_what_was_cut_or_changed_anywhere_is_refused(written: bytes) -> None:
    data = written
    first = data.index(b"\n") + 1
    generator = np.random.default_rng(0)
    for place in [*generator.integers(first, len(data), 200).tolist(), first, len(data) - 1]:
        assert "is damaged" in refused(data[:place])
        changed = bytearray(data)
        changed[place] ^= 1 << int(generator.integers(8))
        assert "is damaged" in refused(bytes(changed))


def turned(grid_map: GridMap) -> list[GridMap]:
    """Maps that are all but the same."""
    free = grid_map.free.copy()
    free[3, 3] = False
    return [
        replace(grid_map, free=free),
        replace(grid_map, free=grid_map.free.reshape(1, -1)),
        replace(grid_map, resolution=grid_map.resolution + 1e-9),
        replace(grid_map, origin=(0.0, 0.0, 1e-9)),
        replace(grid_map, frame_id="odom"),
        replace(
            grid_map,
            features=FeatureMap(np.zeros((7, 7, 1), dtype=np.int64), np.ones((7, 7), dtype=bool)),
        ),
    ]


@pytest.mark.parametrize("number", range(6))
def test_another_map_is_refused(number: int, written: bytes) -> None:
    other = turned(MAP)[number]
    assert digest_of(other) != digest_of(MAP)
    checkpoint = checkpoint_from(written, "file")
    with pytest.raises(InputError, match="was made on another map; the chains start anew"):
        RunningPosterior.resumed(checkpoint, other, SETTINGS)


def test_other_settings_are_refused(written: bytes) -> None:
    checkpoint = checkpoint_from(written, "file")
    with pytest.raises(InputError, match="was made with other settings; the chains start anew"):
        RunningPosterior.resumed(checkpoint, MAP, replace(SETTINGS, alpha=3.0))


def test_the_format_stands_for_these_fields() -> None:
    """Where they change, `FORMAT` has to be raised, and this with it."""
    assert FORMAT == 1
    assert PursuitState._fields == (
        *("subgoal_of", "switched", "slipped", "partition_of", "counts", "parameters", "sweeps"),
    )
    assert PartitionState._fields == (
        *("partition_of", "subgoal_of_slot", "size_of_slot", "slots", "position_of_slot"),
        "occupied",
    )
    assert list(Checkpoint.__dataclass_fields__) == [
        *("map_digest", "settings", "demonstration", "poses", "last_poses", "states"),
        "generators",
    ]


# The thread


def kept_by(worker: BackgroundInference, kept: list[bytes]) -> bytes:
    """The last checkpoint of chains that have come to their end."""
    deadline = time.monotonic() + 60.0
    worker.use_map(MAP)
    while not (worker.idle and kept):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return kept[-1]


def test_a_thread_keeps_its_chains_and_goes_on_from_them() -> None:
    recorder, kept = recorded(2), list[bytes]()
    worker = BackgroundInference(recorder, SETTINGS, 2.0, keep=kept.append)
    checkpoint = checkpoint_from(kept_by(worker, kept), "file")
    result = worker.take_result()
    worker.close()
    again = list[bytes]()
    second = BackgroundInference(recorder, SETTINGS, 2.0, checkpoint, again.append)
    kept_by(second, again)
    resumed = second.take_result()
    second.close()
    assert (second.error, second.last_error) == ("", "")
    assert result is not None
    assert resumed is not None
    assert result.summary is not None
    assert resumed.summary is not None
    assert {each.cell for each in result.summary.subgoals} == {
        each.cell for each in resumed.summary.subgoals
    }


def test_a_thread_says_that_a_checkpoint_is_of_another_map_and_infers_all_the_same() -> None:
    other = replace(MAP, resolution=0.25)
    recorder, kept = recorded(2), list[bytes]()
    checkpoint = replace(swept("paper").checkpoint(), map_digest=digest_of(other))
    worker = BackgroundInference(recorder, SETTINGS, 2.0, checkpoint, kept.append)
    kept_by(worker, kept)
    worker.close()
    assert worker.last_error == "checkpoint: was made on another map; the chains start anew"
    assert worker.error == ""


def test_a_thread_whose_checkpoints_cannot_be_written_infers_all_the_same() -> None:
    tried = list[bytes]()

    def fail(content: bytes) -> None:
        tried.append(content)
        raise InputError("the disk is full")

    worker = BackgroundInference(recorded(2), SETTINGS, 2.0, keep=fail)
    kept_by(worker, tried)
    assert worker.take_result() is not None
    worker.close()
    assert (worker.error, worker.last_error) == ("", "the disk is full")
