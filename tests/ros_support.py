"""What the tests of the nodes share: nodes as processes, and a node of the test's own."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bnirl_ros
from demonstration_support import TopicMessage

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
_qos = importlib.import_module("rclpy.qos")
_executors = importlib.import_module("rclpy.executors")
_diagnostic_msgs = importlib.import_module("diagnostic_msgs.msg")
_parameter = importlib.import_module("rclpy.parameter")
parameter_services = importlib.import_module("rcl_interfaces.srv")
services = importlib.import_module("std_srvs.srv")

from bnirl_ros.nodes.conversion import message_class, to_ros  # noqa: E402  # needs rclpy
from bnirl_ros.nodes.subgoal_node import INPUTS, OUTPUTS  # noqa: E402

PATIENCE = 90.0
"""How long to wait for what should come at once [s]; kernels may have to be compiled first."""

RELIABLE = _qos.QoSProfile(depth=40_000)
LATCHED = _qos.QoSProfile(depth=1, durability=_qos.DurabilityPolicy.TRANSIENT_LOCAL)


def isolate(log_folder: Path) -> None:
    """Let this process and those it starts meet on this machine, and nobody else."""
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(log_folder),
    }
    # A shell's `&` lets its processes, and theirs, ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@dataclass(frozen=True)
class Ended:
    """How a process ended, and what it said."""

    status: int
    out: str
    err: str


class NodeProcess:
    """One of our nodes, started as `ros2 run` starts it."""

    def __init__(self, name: str, folder: Path, *arguments: str | Path) -> None:
        """`folder`: for what it says."""
        self._out, self._err = folder / "out.txt", folder / "err.txt"
        code = f"import sys; from bnirl_ros.nodes.start import {name}; sys.exit({name}())"
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, arguments)],
                stdout=out,
                stderr=err,
                env={
                    "ROS_HOME": str(folder / "ros_home"),  # what one kept is no other's to find
                    **os.environ,
                    "PYTHONPATH": str(Path(bnirl_ros.__file__).parents[1]),
                },
            )

    @property
    def err(self) -> str:
        """What it has said on standard error so far."""
        return self._err.read_text()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def end(self, number: signal.Signals | None = None) -> Ended:
        """Send it a signal, if one is given, and wait for its end."""
        if number is not None:
            self.send(number)
        try:
            status = self._process.wait(PATIENCE)
        finally:
            self.kill()
        return Ended(status, self._out.read_text(), self.err)

    def kill(self) -> None:
        if self.running:
            self._process.kill()
            self._process.wait()


class Peer:
    """A node of the test's own. It does nothing unless the test waits."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("peer", context=self._context)
        self._executor = _executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def until(self, happened: Callable[[], Any], what: str | Callable[[], str]) -> Any:
        """Take messages until something is true; returns it. `what` is for the failure."""
        deadline = time.monotonic() + PATIENCE
        while not (value := happened()):
            if time.monotonic() > deadline:
                words = what if isinstance(what, str) else what()
                raise AssertionError(f"waited in vain for {words}")
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def rest(self, seconds: float) -> None:
        """Take messages for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def listen(self, kind: Any, topic: str, qos: Any = LATCHED) -> list[Any]:
        """A list that grows by the messages of a topic."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, qos)
        return received

    def publisher(self, kind: Any, topic: str, qos: Any = RELIABLE) -> Any:
        """A publisher that has a subscriber."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.until(lambda: publisher.get_subscription_count() > 0, f"a subscriber of {topic}")
        return publisher

    def ask(self, kind: Any, service: str, request: Any = None) -> Any:
        """The future of a service's response."""
        if service not in self._clients:
            client = self._clients[service] = self.node.create_client(kind, service)
            self.until(client.service_is_ready, service)
            self.let_them_find_us()
        return self._clients[service].call_async(request or kind.Request())

    def let_them_find_us(self) -> None:
        """Give the other side time to find us, as we have found it: for speed only.

        What is sent before is not lost, but waits for what Fast DDS does every three seconds.
        """
        self.rest(0.2)

    def call(self, kind: Any, service: str, request: Any = None) -> Any:
        """The response of a service."""
        answer = self.ask(kind, service, request)
        self.until(answer.done, f"an answer of {service}")
        return answer.result()


class Watched:
    """A managed node in a process, and what it says of itself."""

    def __init__(self, process: NodeProcess, peer: Peer, name: str) -> None:
        """`name`: the node's, with its namespace."""
        self.process, self.peer, self.name = process, peer, name
        self._diagnostics = peer.listen(_diagnostic_msgs.DiagnosticArray, "/diagnostics", 10)

    def call(self, service: str, request: Any = None) -> Any:
        """The response of one of its own services."""
        kind = services.SetBool if service == "pause" else services.Trigger
        return self.peer.call(kind, f"/{self.name}/{service}", request)

    def health(self) -> dict[str, str]:
        """The newest diagnostics; empty before the first."""
        told = [
            status
            for array in self._diagnostics
            for status in array.status
            if status.name.startswith(f"{self.name}:")
        ]
        if not told:
            return {}
        status = told[-1]
        return {
            **{each.key: each.value for each in status.values},
            "level": int.from_bytes(status.level),
            "message": status.message,
        }

    @property
    def clock(self) -> int:
        """The time of its last diagnostics, by its own clock [s]."""
        return self._diagnostics[-1].header.stamp.sec if self._diagnostics else -1

    def until_health(self, what: str, **wanted: str) -> dict[str, str]:
        """Wait for diagnostics that say so."""

        def is_so() -> bool:
            health = self.health()
            return all(health.get(key.replace("_", " ")) == value for key, value in wanted.items())

        self.peer.until(is_so, lambda: f"{what}, {wanted}; says {self.health()}")
        return self.health()

    def until_quiet(self) -> None:
        """Wait until it has counted the same for longer than what was sent may take to come.

        Fast DDS sends again, every three seconds, what did not get across.
        """

        def counted() -> list[str | None]:
            return [self.health().get(key) for key in ("observations", "drops", "queue")]

        before = None
        while counted() != before:
            before, since = counted(), self.clock
            self.peer.until(lambda since=since: self.clock >= since + 4, "diagnostics")

    def until_fault(self, words: str, count: int) -> None:
        """Wait until a fault with these words was counted so often."""
        self.peer.until(
            lambda: any(
                key.startswith("left out: ") and words in key and value == str(count)
                for key, value in self.health().items()
            ),
            lambda: f"{count} x {words}; says {self.health()}",
        )

    def set(self, **values: Any) -> list[Any]:
        """Set parameters, one after the other; returns the results."""
        request = parameter_services.SetParameters.Request()
        request.parameters = [
            _parameter.Parameter(name, value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        kind = parameter_services.SetParameters
        return self.peer.call(kind, f"/{self.name}/set_parameters", request).results


class Subgoals(Watched):
    """A subgoal node in a process, and all that it says."""

    def __init__(self, process: NodeProcess, peer: Peer) -> None:
        super().__init__(process, peer, "subgoal_node")
        self.outputs = {
            topic.name: peer.listen(message_class(topic.type_name), f"/{topic.name}")
            for topic in OUTPUTS
        }
        self._publishers: dict[str, Any] = {}

    def meet(self) -> None:
        """Wait until the node hears its topics, as it does when it is active."""
        for topic in INPUTS:
            if topic.name not in self._publishers:
                self._publishers[topic.name] = self.peer.publisher(
                    message_class(topic.type_name),
                    f"/{topic.name}",
                    LATCHED if topic.latched else RELIABLE,
                )
            publisher = self._publishers[topic.name]
            self.peer.until(
                lambda publisher=publisher: publisher.get_subscription_count() > 0, topic.name
            )
        self.peer.let_them_find_us()

    def send(self, *groups: list[TopicMessage]) -> None:
        """Publish messages, in their order; they arrive all, but later."""
        for name, view, _ in chain(*groups):
            self._publishers[name].publish(to_ros(view))

    def until_settled(self, observations: int) -> dict[str, str]:
        """Wait until all is taken in and inference has come to its end."""
        return self.until_health(
            "rest", state="settled", queue="0", observations=str(observations)
        )

    def shown(self) -> dict[int, tuple[float, float]]:
        """Place of each subgoal shown, by its rank."""
        return {
            marker.id: (marker.pose.position.x, marker.pose.position.y)
            for marker in self.outputs["subgoals"][-1].markers
            if marker.ns == "subgoal"
        }

    def until_shown(self, places: set[tuple[float, float]]) -> None:
        """Wait until exactly these subgoals are shown."""
        outputs = self.outputs["subgoals"]
        self.peer.until(
            lambda: outputs and set(self.shown().values()) == places, f"subgoals at {places}"
        )


def as_arguments(parameters: Mapping[str, Any]) -> list[str]:
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return ["--ros-args", *words] if words else []


def assert_silent_end(process: NodeProcess, number: signal.Signals) -> None:
    end = process.end(number)
    assert end.status == 0, end
    assert "Traceback" not in end.err
    assert "Error" not in end.err


def assert_same_results(folder: Path, other: Path) -> None:
    """The result files of two inferences are equal number for number."""
    first, second = ((each / "subgoals.json").read_text() for each in (folder, other))
    assert json.loads(first) == json.loads(second)
    with np.load(folder / "posterior.npz") as one, np.load(other / "posterior.npz") as two:
        assert set(one) == set(two)
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])
    assert (folder / "subgoals.png").is_file()
