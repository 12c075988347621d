"""What our managed nodes have in common: life cycle, topics, counting and diagnostics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from bnirl_ros.confinement import inside, ros_folder
from bnirl_ros.errors import InputError
from bnirl_ros.limits import Limits
from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.parameters import Changeable, NodeParameter, declare
from bnirl_ros.nodes.process import run, spin
from bnirl_ros.nodes.subscriptions import Losses
from bnirl_ros.nodes.topics import NodeTopic
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.diagnostics import Health, diagnostic_array
from bnirl_ros.views.messages import DiagnosticArray, Message

AUTOSTART = NodeParameter(
    "autostart",
    True,
    Limits(
        "whether the node configures and activates itself; false where somebody else does, such "
        "as Nav2's lifecycle manager"
    ),
    Changeable.NEVER,
)
"""The parameter that all managed nodes have."""

FILE_FOLDER = NodeParameter(
    "file_folder",
    "",
    Limits(
        "folder out of which no parameter leads that is changed while the node runs; empty: "
        "bnirl_ros in ROS_HOME, which is ~/.ros unless it is set. What is given at the start may "
        "lie anywhere"
    ),
    Changeable.NEVER,
)
"""The parameter of managed nodes that take names of files."""

DIAGNOSTICS = NodeTopic(
    "/diagnostics",
    DiagnosticArray.TYPE,
    "once a second: what the node does, what it found and what it left out, counted by reason",
    latched=False,
)
"""The topic that all managed nodes publish, in whatever state they are."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last message is kept for whoever comes late."""

_DIAGNOSTICS_PERIOD = 1.0  # [s]
_LOG_PERIOD = 10.0  # [s] between two words on a failure


def with_common(table: Sequence[NodeParameter]) -> tuple[NodeParameter, ...]:
    """All parameters of a managed node that has a table of its own."""
    names_files = any(entry.names_file for entry in table)
    return (AUTOSTART, *((FILE_FOLDER,) if names_files else ()), *table)


class ManagedNode(LifecycleNode):
    """A lifecycle node that hears its topics, and publishes, only while it is active.

    Its parameters are declared when it is made, and taken when it is configured. A subclass says
    in `configure`, `activate`, `deactivate` and `clean_up` what each transition does.

    Attributes:
        configured: whether it is, be it active or not.
        active: whether it is.
        faults: how often each fault occurred among the messages that are left out.
    """

    def __init__(self, name: str, subject: str, table: Sequence[NodeParameter]) -> None:
        """Declare the parameters of a table and `autostart`.

        Args:
            name: of the node, unless it is remapped.
            subject: what its diagnostics are about, in a word.
            table: its parameters; those of an inference are declared besides.

        Raises:
            InputError: a parameter was given a value that it cannot have.
        """
        super().__init__(name)
        self.active = False
        self.faults: Counter[str] = Counter()
        self.configured = False
        self._told: dict[str, int] = {}  # with how many digits each fault was told
        self._failure = ""  # why the last transition was not made
        self._is_starting = False  # by itself, so that whoever started it is told what fails
        self._heard: list[Any] = []
        self._advertised: list[Any] = []
        self._taken_when_configured = {
            entry.name for entry in table if entry.changeable is Changeable.UNCONFIGURED
        }
        self._table = table
        self._subject = subject
        self._naming_files = {entry.name for entry in table if entry.names_file}
        self._given = declare(self, with_common(table))
        self._configured_with = self._given
        self.add_on_set_parameters_callback(self._refuse_changes)
        self._diagnostics = self.create_publisher(
            message_class(DIAGNOSTICS.type_name), DIAGNOSTICS.name, 10
        )
        self.every(_DIAGNOSTICS_PERIOD, self._publish_diagnostics)

    def configure(self, values: dict[str, Any]) -> None:
        """Prepare all that the node needs, with these values of the table's parameters.

        Raises:
            InputError: they cannot be used, and nothing was prepared; the node stays unconfigured.
        """
        raise NotImplementedError

    def activate(self) -> None:
        """Begin to hear and to publish."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Stop working; what was heard so far is kept. Topics are not heard any more."""

    def clean_up(self) -> None:
        """Let go of all that `configure` prepared."""
        raise NotImplementedError

    def health(self) -> Health:
        """How the node is."""
        raise NotImplementedError

    def start(self) -> None:
        """Configure and activate the node, unless somebody else is to do so.

        Raises:
            InputError: it cannot be configured.
        """
        if not self.get_parameter(AUTOSTART.name).value:
            return
        self._is_starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise InputError(self._failure)
        self._is_starting = False

    def close(self) -> None:
        """Let go of everything, in whatever state the node is."""
        self._end()
        self.destroy_node()

    def every(self, period: float, callback: Callable[[], None]) -> Any:
        """A timer [s] of the machine's own time: simulated time may stand still."""
        return self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def advertise(self, topics: Iterable[NodeTopic], depth: int = 10) -> dict[str, Any]:
        """Publishers of topics by their names, until the node is cleaned up.

        Args:
            topics: the topics.
            depth: messages of each that are kept for slow subscribers; of a latched one it is 1.
        """
        publishers = {
            topic.name: self.create_lifecycle_publisher(
                message_class(topic.type_name),
                topic.name,
                LATCHED if topic.latched else QoSProfile(depth=depth),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for topic in topics
        }
        self._advertised += publishers.values()
        return publishers

    def hear(
        self,
        topic: str,
        type_name: str,
        callback: Callable[[Any, Mapping[str, int]], None],
        qos: QoSProfile,
    ) -> Any:
        """Hear a topic until the node is deactivated; lost messages are counted.

        So is one on which the callback fails, and the node lives on.

        Args:
            topic, type_name: of the messages.
            callback: takes a message, and what rclpy knows of its way.
            qos: of the subscription, unless it is overridden.

        Returns:
            The subscription.
        """
        losses = Losses(lambda: subscription.get_publisher_count())

        def on_lost(event: Any) -> None:
            self._count_lost(losses.told(event.total_count_change))

        def take(message: Any, info: Mapping[str, int]) -> None:
            self._count_lost(losses.taken(info["publication_sequence_number"]))
            self._survive(callback, message, info)

        subscription = self.create_subscription(
            message_class(type_name),
            topic,
            take,
            qos,
            event_callbacks=SubscriptionEventCallbacks(message_lost=on_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._heard.append(subscription)
        return subscription

    def tell(self, faults: Mapping[str, int]) -> None:
        """Log the first of a fault's messages, ten, a hundred...: no flood, and no silence."""
        for fault, count in faults.items():
            if count and len(str(count)) > self._told.get(fault, 0):
                self._told[fault] = len(str(count))
                self.get_logger().warning(plain(f"left out {count} x {fault}"))

    def file(self, name: str) -> Path | None:
        """The file or folder that a parameter named when the node was configured, to be opened.

        None if it named none. What was given at the start is taken as it is. Anything else was
        named by somebody on the network, and must not lead out of `file_folder`: links on the way
        are resolved.

        Raises:
            InputError: it does, or leads nowhere.
        """
        return self._file_named(name, self._configured_with[name])

    def confined_to(self, name: str) -> Path | None:
        """The folder out of which a parameter's file must not lead; None: it may lie anywhere."""
        if self._configured_with[name] == self._given[name]:
            return None
        return self._file_folder

    def stamp(self) -> int:
        """Now [ns], by the node's clock."""
        return int(self.get_clock().now().nanoseconds)

    # What rclpy calls. It swallows exceptions, and takes the return value for what happened.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node; it stays unconfigured where that cannot be done."""
        values = {entry.name: self.get_parameter(entry.name).value for entry in self._table}
        self._configured_with = values
        outcome = self._tried("configured", lambda: self.configure(values))
        self.configured = outcome is TransitionCallbackReturn.SUCCESS
        return super().on_configure(state) if self.configured else outcome

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate the node: publishers first, then what publishes."""
        super().on_activate(state)
        self.active = True
        outcome = self._tried("activated", self.activate)
        if outcome is TransitionCallbackReturn.SUCCESS:
            self.get_logger().info("active")
        else:
            self.on_deactivate(state)
        return outcome

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate the node."""
        self._be_deaf()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean the node up; it can be configured anew."""
        self._end()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the node's work for good."""
        self._end()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a fault of the program in a transition: as if never configured."""
        self._end()
        return super().on_error(state)

    @property
    def _file_folder(self) -> Path:
        return Path(self._given[FILE_FOLDER.name] or ros_folder()).expanduser()

    def _file_named(self, name: str, value: str) -> Path | None:
        if not value:
            return None
        if value == self._given[name]:
            return Path(value).expanduser()
        return inside(self._file_folder, Path(value), name)

    def _survive(self, callback: Callable[..., None], *arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:
            self.faults["message on which the node failed"] += 1
            self.get_logger().error(
                plain(f"failed on a message: {type(error).__name__}: {error}"),
                throttle_duration_sec=_LOG_PERIOD,
            )

    def _tried(self, done: str, transition: Callable[[], None]) -> TransitionCallbackReturn:
        """What came of a part of a transition; a user's mistake is logged unless `start` tells."""
        try:
            transition()
        except InputError as error:
            self._failure = str(error)
            if not self._is_starting:
                self.get_logger().error(plain(f"cannot be {done}: {error}"))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._failure = f"cannot be {done}: {type(error).__name__}: {error}"
            self.get_logger().error(plain(self._failure))
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _be_deaf(self) -> None:
        if self.active:
            self.active = False
            for subscription in self._heard:
                self.destroy_subscription(subscription)
            self._heard.clear()
            self.deactivate()

    def _end(self) -> None:
        self._be_deaf()
        if self.configured:
            self.configured = False
            self.clean_up()
            for publisher in self._advertised:
                self.destroy_lifecycle_publisher(publisher)
            self._advertised.clear()
            self.faults.clear()
            self._told.clear()

    def _refuse_changes(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        late = [each.name for each in parameters if each.name in self._taken_when_configured]
        if late and self.configured:
            return SetParametersResult(
                successful=False,
                reason=f"{late[0]} is taken when the node is configured; deactivate it and clean "
                "it up first",
            )
        try:
            for each in parameters:
                if each.name in self._naming_files and isinstance(each.value, str):
                    self._file_named(each.name, each.value)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _count_lost(self, count: int) -> None:
        if count:
            self.faults["message lost on its way"] += count

    def _publish_diagnostics(self) -> None:
        if not self.configured:
            health = Health(self._subject, "unconfigured", "unconfigured")
        elif not self.active:
            health = replace(self.health(), state="inactive", message="inactive")
        else:
            health = self.health()
        name = self.get_fully_qualified_name().lstrip("/")
        publish(self._diagnostics, diagnostic_array(name, health, self.stamp()))


def publish(publisher: Any, view: Message) -> None:
    """Publish what a view says."""
    publisher.publish(to_ros(view))


def serve(name: str, make: Callable[[], ManagedNode], arguments: Sequence[str] | None) -> int:
    """Run a managed node until it is stopped; returns the exit status."""

    def body() -> None:
        node = make()
        try:
            node.start()
            spin(node)
        finally:
            node.close()

    return run(name, body, arguments)
