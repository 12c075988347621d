"""Settings for all tests, and fixtures of those that start nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from ros_support import NodeProcess, Peer, Subgoals

# How long an example takes says nothing here: kernels compile, and the machine may be busy.
settings.register_profile("bnirl_ros", deadline=None)
settings.load_profile("bnirl_ros")


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
