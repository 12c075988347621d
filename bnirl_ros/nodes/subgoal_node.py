"""The node that tells, while a demonstration goes on, what the demonstrator is going for."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, take_action, take_pose
from bnirl_ros.demonstrations.placement import EPISODE_GAP, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference.background import BackgroundInference, Result
from bnirl_ros.inference.summary import Summary, nothing_found
from bnirl_ros.inference.watching import BackgroundWatch
from bnirl_ros.limits import Limits
from bnirl_ros.maps import FeatureLayer, GridMap, load_features, with_features
from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.parameters import NodeParameter, declare, declare_settings
from bnirl_ros.nodes.process import run, spin
from bnirl_ros.views.belief import belief_grid
from bnirl_ros.views.diagnostics import Health, diagnostic_array
from bnirl_ros.views.intent import current_subgoal, intent_markers, no_intent
from bnirl_ros.views.markers import assignment_markers, subgoal_markers
from bnirl_ros.views.messages import MarkerArray, Message, OccupancyGrid, PoseStamped
from bnirl_ros.views.messages import Path as PathMessage
from bnirl_ros.views.results import write_results
from bnirl_ros.views.waypoint_files import read_waypoints
from bnirl_ros.views.waypoints import Waypoints, path_of, waypoint_path

PARAMETERS = (
    NodeParameter(
        "episode_gap",
        EPISODE_GAP,
        Limits("longest time between two poses of one episode [s]", above=0.0, highest=1e6),
    ),
    NodeParameter(
        "queue_depth",
        40_000,
        Limits("messages of pose and action that may wait to be taken", lowest=1, highest=1e7),
    ),
    NodeParameter(
        "waiting_limit",
        40_000,
        Limits("poses, and actions, that may wait for the first map", lowest=0, highest=1e7),
    ),
    NodeParameter(
        "features",
        "",
        Limits("file with features of the map's cells, for feature subgoals; empty: none"),
    ),
    NodeParameter(
        "waypoints_file",
        "",
        Limits("waypoints.yaml to publish until there is a posterior; empty: none"),
    ),
    NodeParameter(
        "result_folder",
        "",
        Limits("folder for the result files of ~/infer, as of bnirl infer; empty: none"),
    ),
)
"""The node's own parameters; those of the inference are in `bnirl_ros.inference.settings`."""

OUTPUTS = {
    "subgoals": MarkerArray.TYPE,
    "assignments": MarkerArray.TYPE,
    "waypoints": PathMessage.TYPE,
    "subgoal_belief": OccupancyGrid.TYPE,
    "current_subgoal": PoseStamped.TYPE,
    "intent": MarkerArray.TYPE,
}
"""Message type of each topic that shows the posterior, or what is pursued now; all latched."""

View = Callable[[Summary, GridMap, int], Message]
"""Shows a summary on a map, in a message with this stamp [ns]."""

_LOOK_PERIOD = 0.1  # [s] between two looks at whether there is a result
_ASSIGNMENTS_PERIOD = 1.0  # [s] at the least between two messages on `assignments`
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SubgoalNode(Node):
    """Takes in poses, actions and maps, and publishes the subgoals that explain them.

    Topics, services and parameters are those of the README. Callbacks only record; a thread of
    its own infers, another one tells what is pursued now, and a timer publishes what they found.
    """

    def __init__(self) -> None:
        """Declare everything, and begin to listen.

        Raises:
            InputError: a parameter was given a value that it cannot have, or names a file that
                cannot be used.
        """
        super().__init__("subgoal_node")
        own = declare(self, PARAMETERS)
        settings = declare_settings(self, lambda changed: self._inference.use_settings(changed))
        self._result_folder: str = own["result_folder"]
        self._features: FeatureLayer | None = None
        if own["features"]:
            self._features = load_features(Path(own["features"]).expanduser())
        self._saved_waypoints: Waypoints | None = None
        if own["waypoints_file"]:
            self._saved_waypoints = read_waypoints(Path(own["waypoints_file"]).expanduser())
        self._recorder = Recorder(own["waiting_limit"])
        self._inference = BackgroundInference(self._recorder, settings, own["episode_gap"])
        self._watch = BackgroundWatch(self._recorder, own["episode_gap"])
        self._shown: dict[str, Message] = {}  # the last messages on what is pursued now
        self._faults: Counter[str] = Counter()
        self._result: Result | None = None
        self._assignments_due = False
        self._assignments_at = 0
        self._answers: list[tuple[Any, Future]] = []

        demonstration_qos = QoSProfile(depth=own["queue_depth"])
        for name, callback, qos in (
            ("pose", self._on_pose, demonstration_qos),
            ("action", self._on_action, demonstration_qos),
            ("map", self._on_map, _LATCHED),
        ):
            self.create_subscription(
                message_class(TOPIC_TYPES[name]),
                name,
                callback,
                qos,
                event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        self._outputs = {
            name: self.create_publisher(message_class(type_name), name, _LATCHED)
            for name, type_name in OUTPUTS.items()
        }
        self._send_saved_waypoints()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # In a group of its own: in the node's, everything else would wait until it is answered.
        answered_later = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/infer", self._on_infer, callback_group=answered_later)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_timer(_LOOK_PERIOD, self._look)
        self.create_timer(1.0, self._publish_diagnostics)

    def close(self) -> None:
        """End the inference and the watch, then the node."""
        self._inference.close()
        self._watch.close()
        self.destroy_node()

    def _on_pose(self, message: Any) -> None:
        self._taken(take_pose(self._recorder, message))

    def _on_action(self, message: Any) -> None:
        self._taken(take_action(self._recorder, message))

    def _taken(self, fault: str | None) -> None:
        if fault:
            self._log_fault(fault, self._recorder.faults[fault])
        else:
            self._inference.observations_arrived()
            self._watch.observations_arrived()

    def _on_map(self, message: Any) -> None:
        try:
            grid_map = map_of(message, "topic map")
            if self._features:
                grid_map = with_features(grid_map, self._features)
        except InputError as error:
            fault = str(error)
            self._faults[fault] += 1
            self._log_fault(fault, self._faults[fault])
            return
        self._recorder.map_arrived()
        self._inference.use_map(grid_map)

    def _on_lost(self, event: Any) -> None:
        self._faults["message lost on its way"] += event.total_count_change

    def _log_fault(self, fault: str, count: int) -> None:
        """Tell of the first one, the tenth, the hundredth...: no flood, and no silence."""
        if str(count).strip("0") == "1":
            self.get_logger().warning(f"left out {count} x {fault}")

    async def _on_infer(self, _: Any, response: Any) -> Any:
        request = self._inference.infer(self._keep)
        done: Future = Future()
        self._answers.append((request, done))
        await done  # the timer looks; meanwhile the executor goes on
        try:
            result: Result = request.result()
            response.message = self._in_words(result)
            response.success = True
        except CancelledError:
            response.message = "the node was stopped before the inference was done"
        except InputError as error:
            response.message = str(error)
        except Exception as error:
            response.message = f"the inference failed: {error}"
        return response

    def _keep(self, result: Result) -> None:
        """Write the result files where that is wanted; called in the inference's thread."""
        if self._result_folder:
            assert result.posterior is not None
            assert result.summary is not None
            assert result.settings is not None
            write_results(
                Path(self._result_folder).expanduser(),
                result.posterior,
                result.summary,
                result.grid_map,
                result.settings,
            )

    def _in_words(self, result: Result) -> str:
        assert result.summary is not None
        where = f"; written to {self._result_folder}" if self._result_folder else ""
        return (
            f"{len(result.summary.subgoals)} subgoals from "
            f"{len(result.placement.demonstration)} observations{where}"
        )

    def _on_reset(self, _: Any, response: Any) -> Any:
        self._recorder.clear()
        self._faults.clear()
        self._inference.reset()
        if self._result:
            grid_map = self._result.grid_map
            self._publish(Result(grid_map, place(self._recorder.snapshot(), grid_map), None, 0))
        response.success = True
        response.message = "all observations are forgotten"
        return response

    def _on_pause(self, request: Any, response: Any) -> Any:
        self._inference.pause(request.data)
        response.success = True
        response.message = "inference rests" if request.data else "inference goes on"
        return response

    def _look(self) -> None:
        """Answer whoever waits for an inference, and publish what is new."""
        for request, done in self._answers:
            if request.done():
                done.set_result(None)
        self._answers = [(request, done) for request, done in self._answers if not done.done()]
        result = self._inference.take_result()
        if result is not None:
            self._publish(result)
        told = self._watch.take()
        if told is not None:
            self._show("current_subgoal", current_subgoal(*told))
            self._show("intent", intent_markers(*told))
        now = self.get_clock().now().nanoseconds
        since = now - self._assignments_at
        if self._assignments_due and not 0 <= since < _ASSIGNMENTS_PERIOD * 1e9:
            assert self._result is not None
            self._send("assignments", assignment_markers, self._result, now)
            self._assignments_due, self._assignments_at = False, now

    def _publish(self, result: Result) -> None:
        self._result = result
        now = self.get_clock().now().nanoseconds
        self._send("subgoals", subgoal_markers, result, now)
        if result.summary or not self._saved_waypoints:
            self._send("waypoints", waypoint_path, result, now)
        else:
            self._send_saved_waypoints()
        self._send("subgoal_belief", belief_grid, result, now)
        self._assignments_due = True
        self._watch.use(result.intent_filter)
        if result.intent_filter is None and self._shown:
            self._shown.clear()
            self._outputs["intent"].publish(to_ros(no_intent(result.grid_map, now)))

    def _show(self, name: str, view: Message | None) -> None:
        """Publish what is pursued now, unless that is what was published last."""
        if view is not None and view != self._shown.get(name):
            self._shown[name] = view
            self._outputs[name].publish(to_ros(view))

    def _send(self, name: str, view: View, result: Result, stamp: int) -> None:
        summary = result.summary or nothing_found(result.grid_map)
        self._outputs[name].publish(to_ros(view(summary, result.grid_map, stamp)))

    def _send_saved_waypoints(self) -> None:
        """Publish the waypoints of a file, if one was given: they stand in for a posterior."""
        if self._saved_waypoints:
            path = path_of(self._saved_waypoints, self.get_clock().now().nanoseconds)
            self._outputs["waypoints"].publish(to_ros(path))

    def _publish_diagnostics(self) -> None:
        self._look()  # whoever reads "settled" has the last result
        result = self._result
        faults = self._recorder.faults + self._faults
        if result:
            faults = faults + result.placement.faults
        health = Health(
            name=self.get_fully_qualified_name().lstrip("/"),
            paused=self._inference.paused,
            idle=self._inference.idle and self._watch.idle,
            observations=len(result.placement.demonstration) if result else 0,
            waiting=len(self._recorder) - (result.placement.messages if result else 0),
            sweeps=result.sweeps if result else 0,
            summary=result.summary if result else None,
            faults=faults,
            error=self._inference.error or self._watch.error,
            last_error=self._inference.last_error or self._watch.last_error,
        )
        view = diagnostic_array(health, self.get_clock().now().nanoseconds)
        self._diagnostics.publish(to_ros(view))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; returns the exit status."""
    # Numpy holds the interpreter for up to its switch interval while a callback waits.
    sys.setswitchinterval(0.0005)

    def body() -> None:
        node = SubgoalNode()
        try:
            spin(node)
        finally:
            node.close()

    return run("subgoal_node", body, arguments)


if __name__ == "__main__":
    sys.exit(main())
