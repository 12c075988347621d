"""The main job, to be watched: a human demonstration replayed to the node over DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from bnirl_ros.bags.qos import LATCHED, QosProfile
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.errors import InputError
from bnirl_ros.nodes.conversion import message_class
from bnirl_ros.nodes.process import run
from bnirl_ros.nodes.subgoal_node import OUTPUTS
from bnirl_ros.resources import share_folder
from bnirl_ros.views.messages import DiagnosticArray
from bnirl_ros.views.results import read_document, subgoals_in
from bnirl_ros.views.tables import subgoal_table

_RECORDED = {
    **{f"/{name}": type_name for name, type_name in TOPIC_TYPES.items()},
    **{f"/{topic.name}": topic.type_name for topic in OUTPUTS},
    "/diagnostics": DiagnosticArray.TYPE,
}
_PASSING = ("/pose", "/action", "/diagnostics")  # the others are latched
_DEPTH = 40_000  # [messages] that may wait to be recorded: as many as the node lets wait
HUMAN_BAG = "overcooked_random3"
"""The bag that is replayed unless another one is named: 16 episodes of people at play."""

_PATIENCE = 300.0  # [s] for anything that is waited for
_END_PATIENCE = 20.0  # [s] for a node to end


class _Watcher(Node):
    """Records what the node takes in and publishes, and remembers its last word on how it is."""

    def __init__(self, bag: BagWriter) -> None:
        super().__init__("demo")
        self.diagnostics: dict[str, str] = {}
        self.infer = self.create_client(Trigger, "/subgoal_node/infer")
        for topic, type_name in _RECORDED.items():
            latched = topic not in _PASSING
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            bag.add_topic(topic, type_name, LATCHED if latched else QosProfile())
            self.create_subscription(
                message_class(type_name),
                topic,
                self._recorder(bag, topic),
                QoSProfile(depth=_DEPTH, durability=durability),
                raw=True,
            )

    def _recorder(self, bag: BagWriter, topic: str) -> Callable[[bytes], None]:
        def record(data: bytes) -> None:
            bag.write_encoded(topic, data, time.time_ns())
            if topic == "/diagnostics":
                status = deserialize_message(data, message_class(DiagnosticArray.TYPE)).status[0]
                self.diagnostics = {entry.key: entry.value for entry in status.values}

        return record

    def spin_until(self, what: str, done: Callable[[], bool]) -> None:
        """Serve callbacks until something is done.

        Raises:
            InputError: it takes too long.
        """
        deadline = time.monotonic() + _PATIENCE
        while not done():
            if time.monotonic() > deadline:
                raise InputError(
                    f"{what} takes more than {_PATIENCE:g} s; look at the messages above"
                )
            rclpy.spin_once(self, timeout_sec=0.1)

    def news(self) -> str:
        """A line on what the node has found so far."""
        known = self.diagnostics
        if not int(known.get("observations", 0)):
            return "subgoal_node waits for the first observations"
        return (
            f"{known['observations']} observations, {known['subgoals']} subgoals, "
            f"{known['sweeps']} sweeps, R-hat {known['R-hat']}"
        )


def demo(bag: Path, out: Path) -> None:
    """Replay a bag to the node, both in processes of their own, and print what comes of it.

    Leaves in `out` the three result files of an inference, and a bag of what was published.

    Raises:
        InputError: a node ended with an error, or didn't answer in time.
    """
    with ExitStack() as stack:
        writer = stack.enter_context(BagWriter(out / "published", overwrite=True))
        watcher = _Watcher(writer)
        stack.callback(watcher.destroy_node)
        tell = stack.enter_context(_teller())
        parameters = ["--ros-args", "-p", f"result_folder:={out.resolve()}"]
        parameters += ["-p", "journal:=false"]  # it was demonstrated long ago, and is in a bag
        node = stack.enter_context(_process("subgoal_node", parameters))
        both = ["--subscribers", "2"]  # the node, and the watcher
        replay = stack.enter_context(_process("replay_node", [str(bag), "--fast", *both]))

        def replayed() -> bool:
            _check(node, "subgoal_node", may_end=False)
            tell(watcher.news())
            return _check(replay, "replay_node", may_end=True)

        def settled() -> bool:
            _check(node, "subgoal_node", may_end=False)
            tell(watcher.news())
            known = watcher.diagnostics
            return known.get("queue") == "0" and known.get("state") == "settled"

        def answered() -> bool:
            _check(node, "subgoal_node", may_end=False)
            return bool(answer.done())

        watcher.spin_until("the replay", replayed)
        watcher.spin_until("the inference", settled)
        tell("asks for an inference with fresh chains")
        answer = watcher.infer.call_async(Trigger.Request())
        watcher.spin_until("the inference", answered)
        if not answer.result().success:
            raise InputError(answer.result().message)
    _show(out)


def _show(out: Path) -> None:
    """Print the table, and where everything is."""
    document = read_document(out / "subgoals.json")
    diagnostics = document["diagnostics"]
    rhat = diagnostics["rhat"]
    print(subgoal_table(subgoals_in(document), document["visit_sequence"]))
    print(
        f"R-hat {'undefined' if rhat is None else format(rhat, '.3f')} over "
        f"{diagnostics['chains']} chains of {diagnostics['draws']} draws"
    )
    print(f"Picture: {out / 'subgoals.png'}")
    print(f"Subgoals and posterior: {out / 'subgoals.json'}, {out / 'posterior.npz'}")
    print(f"What was published, for Foxglove or ros2 bag play: {out / 'published'}")


def _check(process: subprocess.Popen[bytes], name: str, may_end: bool) -> bool:
    """Whether a node has ended.

    Raises:
        InputError: it ended with an error, or at all where it may not.
    """
    status = process.poll()
    if status or (status is not None and not may_end):
        raise InputError(f"{name} ended with status {status}; its messages above say why")
    return status is not None


@contextmanager
def _process(module: str, arguments: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A node in a process of its own, told to end with SIGINT if it has not ended by itself."""
    program = f"from bnirl_ros.nodes import start; raise SystemExit(start.{module}())"
    process = subprocess.Popen([sys.executable, "-c", program, *arguments])
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(_END_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()


@contextmanager
def _teller() -> Iterator[Callable[[str], None]]:
    """Shows news: on a terminal in a line of its own that changes, elsewhere now and then."""
    if sys.stderr.isatty():
        from rich.console import Console

        with Console(stderr=True).status("starts two nodes") as status:
            yield status.update
        return
    last = ("", 0.0)

    def tell(news: str) -> None:
        nonlocal last
        if news != last[0] and time.monotonic() - last[1] > 2.0:
            last = (news, time.monotonic())
            print(news, file=sys.stderr, flush=True)

    yield tell


def main(bag: Path | None, out: Path) -> int:
    """Run the demo with the human bag or another one; returns the exit status."""
    # Robots and other demos need not hear of it; who wants to listen names the same domain.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    domain = os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    print(f"To watch in RViz or Foxglove on this machine: ROS_DOMAIN_ID={domain}", flush=True)
    played = bag or share_folder() / "bags" / HUMAN_BAG
    finished = False

    def body() -> None:
        nonlocal finished
        demo(played, out)
        finished = True

    status = run("bnirl demo", body, [])
    if status == 0 and not finished:
        raise KeyboardInterrupt  # which ends a command, unlike a node, with status 130
    return status
