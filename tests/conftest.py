"""Settings for all tests, and fixtures that several of them share."""

from __future__ import annotations

import gc
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import setuptools
from hypothesis import settings

from bnirl_ros import cli
from cli_support import Command, Ended

if TYPE_CHECKING:
    from ros_support import NodeProcess, Peer, Subgoals

# How long an example takes says nothing here: kernels compile, and the machine may be busy.
settings.register_profile("bnirl_ros", deadline=None)
settings.load_profile("bnirl_ros")


@pytest.fixture
def setup_arguments(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py hands over to setuptools."""
    arguments: dict[str, Any] = {}
    monkeypatch.chdir(Path(__file__).resolve().parent.parent)
    monkeypatch.setattr(setuptools, "setup", arguments.update)
    runpy.run_path("setup.py")
    return arguments


@pytest.fixture
def bnirl(capsys: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """The command, called in this process, which is a second quicker."""

    def call(*arguments: str | Path) -> Ended:
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse
            status = int(end.code or 0)
        return Ended(status, *capsys.readouterr())

    yield call
    gc.unfreeze()  # the command lives as long as its process: it has no use for the collector
    gc.enable()


@pytest.fixture(scope="module")
def own_domain(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nodes of this module's tests meet nobody else."""
    from ros_support import isolate

    isolate(tmp_path_factory.mktemp("ros_log"))


@pytest.fixture
def peer(own_domain: None) -> Iterator[Peer]:
    """A node of the test's own."""
    from ros_support import Peer

    made = Peer()
    yield made
    made.close()


@pytest.fixture
def start(own_domain: None, tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """Start a node by name, with arguments; it is killed at the end, if it has not ended."""
    from ros_support import NodeProcess

    started: list[NodeProcess] = []

    def start_node(name: str, *arguments: str | Path) -> NodeProcess:
        folder = tmp_path / f"process{len(started)}"
        folder.mkdir()
        started.append(NodeProcess(name, folder, *arguments))
        return started[-1]

    yield start_node
    for process in started:
        process.kill()


@pytest.fixture
def subgoals(start: Callable[..., NodeProcess], peer: Peer) -> Callable[..., Subgoals]:
    """Start a subgoal node with parameters, which is active."""
    from ros_support import Subgoals, as_arguments

    def start_it(**parameters: Any) -> Subgoals:
        node = Subgoals(start("subgoal_node", *as_arguments(parameters)), peer)
        node.meet()
        return node

    return start_it
