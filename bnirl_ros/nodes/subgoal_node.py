"""The node that tells, while a demonstration goes on, what the demonstrator is going for."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from bnirl_ros.bags.demonstration import RecordedDemonstration
from bnirl_ros.confinement import ros_folder
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, take_action, take_pose
from bnirl_ros.demonstrations.placement import EPISODE_GAP, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference.background import BackgroundInference, Result
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Summary, nothing_found
from bnirl_ros.inference.watching import BackgroundWatch
from bnirl_ros.journal.keeper import Keeper
from bnirl_ros.limits import Limits
from bnirl_ros.maps import FeatureLayer, GridMap, load_features, with_features
from bnirl_ros.nodes.drawing import Drawing
from bnirl_ros.nodes.garbage import GarbageSearch
from bnirl_ros.nodes.managed import LATCHED, ManagedNode, publish, serve
from bnirl_ros.nodes.parameters import NodeParameter, declare_settings
from bnirl_ros.nodes.subscriptions import take_together
from bnirl_ros.nodes.topics import NodeService, NodeTopic
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.belief import belief_grid
from bnirl_ros.views.diagnostics import Health, inference_values
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
        "observation_limit",
        100_000,
        Limits(
            "poses, and actions, that are kept and inferred from: of more the oldest eighth is "
            "forgotten",
            lowest=8,
            highest=1e8,
        ),
    ),
    NodeParameter(
        "features",
        "",
        Limits("file with features of the map's cells, for feature subgoals; empty: none"),
        names_file=True,
    ),
    NodeParameter(
        "waypoints_file",
        "",
        Limits("waypoints.yaml to publish until there is a posterior; empty: none"),
        names_file=True,
    ),
    NodeParameter(
        "result_folder",
        "",
        Limits("folder for the result files of ~/infer, as of bnirl infer; empty: none"),
        names_file=True,
    ),
    NodeParameter(
        "journal",
        True,
        Limits("whether what is observed is kept on the disk, so that it outlives the process"),
    ),
    NodeParameter(
        "journal_folder",
        "",
        Limits(
            "folder of the journals; empty: journals in bnirl_ros in ROS_HOME, which is ~/.ros "
            "unless it is set, below it the node's name with its namespace"
        ),
        names_file=True,
    ),
    NodeParameter(
        "journal_interval",
        1.0,
        Limits("longest time that an observation waits to be kept [s]", above=0.0, highest=3600.0),
    ),
)
"""The node's own parameters; those of the inference are in `bnirl_ros.inference.settings`."""

INPUTS = (
    NodeTopic(
        "pose",
        TOPIC_TYPES["pose"],
        "centre of the demonstrator's cell, in the map frame",
        latched=False,
    ),
    NodeTopic(
        "action",
        TOPIC_TYPES["action"],
        "unit step (dx, dy) along the map's axes, each -1, 0 or 1; (0, 0) is stay; stamped as the "
        "pose in which it was chosen",
        latched=False,
    ),
    NodeTopic("map", TOPIC_TYPES["map"], "0-49 is free, 50-100 and unknown are blocked"),
)
"""What is heard."""

OUTPUTS = (
    NodeTopic(
        "subgoals",
        MarkerArray.TYPE,
        "sphere, arrow and label of each subgoal, with its rank as id",
    ),
    NodeTopic(
        "assignments",
        MarkerArray.TYPE,
        "the actions that belong to each subgoal, in its colour; those that none explains, in "
        "grey; once a second at most",
    ),
    NodeTopic(
        "waypoints",
        PathMessage.TYPE,
        "the subgoals in the order visited, each heading for the next",
    ),
    NodeTopic(
        "subgoal_belief", OccupancyGrid.TYPE, "probability, 0-100, that a cell is a subgoal"
    ),
    NodeTopic(
        "current_subgoal",
        PoseStamped.TYPE,
        "the subgoal that is most probably pursued now, as its waypoint; stamped as the "
        "demonstrator's latest pose",
    ),
    NodeTopic(
        "intent",
        MarkerArray.TYPE,
        "an arrow from the demonstrator to each subgoal that may be pursued now, its rank as id "
        "and its probability as opacity, and a label with both; the label of id 0 tells how "
        "probably it is none of them",
    ),
)
"""What shows the posterior, or what is pursued now."""

SERVICES = (
    NodeService(
        "~/infer",
        "std_srvs/srv/Trigger",
        "infer afresh from all that was observed, exactly as `bnirl infer` does",
    ),
    NodeService("~/reset", "std_srvs/srv/Trigger", "forget all observations"),
    NodeService("~/pause", "std_srvs/srv/SetBool", "stop and go on inferring"),
)
"""What it can be asked to do while it is active."""

View = Callable[[Summary, GridMap, int], Message]
"""Shows a summary on a map, in a message with this stamp [ns]."""

_LOOK_PERIOD = 0.1  # [s] between two looks at whether there is a result
_ASSIGNMENTS_PERIOD = 1.0  # [s] at the least between two messages on `assignments`


class SubgoalNode(ManagedNode):
    """Takes in poses, actions and maps, and publishes the subgoals that explain them.

    Callbacks only record; a thread of its own infers, another one tells what is pursued now, and a
    timer publishes what they found.
    """

    def __init__(self) -> None:
        """Declare parameters and services.

        Raises:
            InputError: a parameter was given a value that it cannot have.
        """
        super().__init__("subgoal_node", "inference", PARAMETERS)
        self._settings = declare_settings(self, self._use_settings)
        self._answers: list[tuple[Any, Future]] = []
        self._garbage = GarbageSearch()
        # In a group of its own: in the node's, everything else would wait until it is answered.
        answered_later = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/infer", self._on_infer, callback_group=answered_later)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.every(_LOOK_PERIOD, self._look)

    def configure(self, values: dict[str, Any]) -> None:
        """Read the files that parameters name, and start the two threads."""
        self._depth: int = values["queue_depth"]
        self._result_folder: str = values["result_folder"]
        self._features: FeatureLayer | None = None
        if features := self.file("features"):
            self._features = load_features(features, self.confined_to("features"))
        self._saved_waypoints: Waypoints | None = None
        if waypoints := self.file("waypoints_file"):
            self._saved_waypoints = read_waypoints(waypoints)
        self._recorder = Recorder(values["waiting_limit"], values["observation_limit"])
        self._keeper = keeper = self._journal(values)
        self._outputs = self.advertise(OUTPUTS)
        self._shown: dict[str, Message] = {}  # the last messages on what is pursued now
        self._result: Result | None = None
        self._drawing = Drawing()
        self._assignments_due = False
        self._assignments_at = -math.inf  # [s] by the machine's own time
        self._paused = False
        gap = values["episode_gap"]
        self._inference = BackgroundInference(
            self._recorder,
            self._settings,
            gap,
            keeper.checkpoint if keeper else None,
            keeper.keep_checkpoint if keeper else None,
        )
        self._watch = BackgroundWatch(self._recorder, gap)
        self._grid_map: GridMap | None = None
        for warning in keeper.warnings if keeper else ():
            self._warn(warning)
        if keeper and keeper.recovered:
            self._go_on_from(keeper.recovered)

    def activate(self) -> None:
        """Hear, infer, and publish what was found before."""
        self._inference.pause(self._paused)
        self._send_saved_waypoints()
        if self._result:
            self._publish(self._result)
        by_name = {"pose": self._on_pose, "action": self._on_action, "map": self._on_map}
        heard = {}
        for topic in INPUTS:
            qos = LATCHED if topic.latched else QoSProfile(depth=self._depth)
            heard[topic.name] = self.hear(topic.name, topic.type_name, by_name[topic.name], qos)
        take_together([heard["pose"], heard["action"]])

    def deactivate(self) -> None:
        """Let the inference rest."""
        self._inference.pause(True)
        self._drawing.forget()

    def clean_up(self) -> None:
        """End the threads, and answer who waits for an inference."""
        self._inference.close()
        self._watch.close()
        self._drawing.close()
        if self._keeper:
            self._keeper.close()
            self._warn(self._keeper.error)
        self._answer()

    def health(self) -> Health:
        """How the inference gets on, and what was left out."""
        self._look()  # whoever reads "settled" has the last result
        # What the last result left out may only have come too late for it.
        faults = self._recorder.faults + self.faults
        self.tell(faults)
        result = self._result
        summary = result.summary if result else None
        observations = len(result.placement.demonstration) if result else 0
        if self._paused:
            state = "paused"
        elif not (self._inference.idle and self._watch.idle and self._drawing.idle):
            state = "inferring"
        else:
            state = "settled" if summary else "waiting"
        return Health(
            subject="inference",
            state=state,
            message=f"{len(summary.subgoals)} subgoals from {observations} observations"
            if summary
            else "waiting for a map and observations",
            values=inference_values(
                summary,
                observations,
                result.sweeps if result else 0,
                len(self._recorder) - (result.placement.messages if result else 0),
            ),
            faults=faults + result.placement.faults if result else faults,
            error=self._inference.error or self._watch.error or self._unkept,
            last_error=self._inference.last_error or self._watch.last_error,
        )

    def _use_settings(self, settings: Settings) -> None:
        self._settings = settings
        if self.configured:
            self._inference.use_settings(settings)

    def _on_pose(self, message: Any, _: Mapping[str, int]) -> None:
        self._taken(take_pose(self._recorder, message))

    def _on_action(self, message: Any, _: Mapping[str, int]) -> None:
        self._taken(take_action(self._recorder, message))

    def _taken(self, fault: str | None) -> None:
        if fault is None:
            self._inference.observations_arrived()
            self._watch.observations_arrived()

    def _on_map(self, message: Any, _: Mapping[str, int]) -> None:
        try:
            grid_map = map_of(message, "topic map")
            is_new = self._grid_map is None or not grid_map.is_same_as(self._grid_map)
            self._use_map(grid_map)
        except InputError as error:
            self.faults[str(error)] += 1
            return
        if self._keeper and is_new:
            self._keeper.map_arrived(serialize_message(message))

    def _use_map(self, grid_map: GridMap) -> None:
        featured = with_features(grid_map, self._features) if self._features else grid_map
        self._grid_map = grid_map
        self._recorder.map_arrived()
        self._inference.use_map(featured)

    def _journal(self, values: dict[str, Any]) -> Keeper | None:
        """What keeps the observations, if anything is to; the recorder has what was kept."""
        if not values["journal"]:
            return None
        folder = self.file("journal_folder")
        name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        place = folder or ros_folder() / "journals" / name
        try:
            return Keeper(place, self._recorder, values["journal_interval"])
        except InputError as error:
            if folder:
                raise
            self._warn(f"{error}; until then, what is observed is lost with the process")
            return None

    def _go_on_from(self, recovered: RecordedDemonstration) -> None:
        """Infer from what a process had kept that was cut off, and say so."""
        assert self._keeper is not None
        recording = recovered.recording
        self.get_logger().info(
            plain(
                f"goes on with {len(recording.pose_stamps)} poses and {len(recording.actions)} "
                f"actions that {self._keeper.journal} held, since the last run did not end in "
                "order; ~/reset forgets them"
            )
        )
        if recovered.grid_map:
            try:
                self._use_map(recovered.grid_map)
            except InputError as error:
                self._warn(f"the map of the last run is not used: {error}")
        self._inference.observations_arrived()
        self._watch.observations_arrived()

    @property
    def _unkept(self) -> str:
        return self._keeper.error if self._keeper else ""

    def _warn(self, sentence: str) -> None:
        if sentence:
            self.get_logger().warning(plain(sentence))

    async def _on_infer(self, _: Any, response: Any) -> Any:
        if self._is_refused(response):
            return response
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
        folder = self.file("result_folder")  # now, since links may have been laid meanwhile
        if folder:
            assert result.posterior is not None
            assert result.summary is not None
            assert result.settings is not None
            write_results(
                folder,
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
        if self._is_refused(response):
            return response
        if self._keeper:
            self._keeper.begin_anew()
        self._recorder.clear()
        self.faults.clear()
        self._inference.reset()
        if self._result:
            grid_map = self._result.grid_map
            self._publish(Result(grid_map, place(self._recorder.snapshot(), grid_map), None, 0))
        response.success = True
        response.message = "all observations are forgotten"
        return response

    def _on_pause(self, request: Any, response: Any) -> Any:
        if self._is_refused(response):
            return response
        self._paused = request.data
        self._inference.pause(self._paused)
        response.success = True
        response.message = "inference rests" if request.data else "inference goes on"
        return response

    def _is_refused(self, response: Any) -> bool:
        """Whether a service cannot be given now; the response tells why."""
        if self.active:
            return False
        response.success = False
        response.message = f"{self.get_name()} is not active; activate it first"
        return True

    def _look(self) -> None:
        """Answer whoever waits for an inference, and publish what is new."""
        self._answer()
        if not self.active:
            return
        self._garbage.look(len(self._recorder), time.monotonic())
        self._drawing.publish()
        result = self._inference.take_result()
        if result is not None:
            self._publish(result)
        told = self._watch.take()
        if told is not None:
            self._show("current_subgoal", current_subgoal(*told))
            self._show("intent", intent_markers(*told))
        now = time.monotonic()
        if self._assignments_due and now - self._assignments_at > _ASSIGNMENTS_PERIOD:
            assert self._result is not None
            self._send("assignments", assignment_markers, self._result)
            self._assignments_due, self._assignments_at = False, now

    def _answer(self) -> None:
        """Answer the requests for an inference that is done, or will not be."""
        for request, done in self._answers:
            if request.done():
                done.set_result(None)
        self._answers = [(request, done) for request, done in self._answers if not done.done()]

    def _publish(self, result: Result) -> None:
        if result.summary:
            self._garbage.keep_all()  # all modules and kernels are there now, and stay
        self._result = result
        self._send("subgoals", subgoal_markers, result)
        if result.summary or not self._saved_waypoints:
            self._send("waypoints", waypoint_path, result)
        else:
            self._send_saved_waypoints()
        self._send("subgoal_belief", belief_grid, result)
        self._assignments_due = True
        self._watch.use(result.intent_filter)
        if result.intent_filter is None and self._shown:
            self._shown.clear()
            publish(self._outputs["intent"], no_intent(result.grid_map, self.stamp()))

    def _show(self, name: str, view: Message | None) -> None:
        """Publish what is pursued now, unless that is what was published last."""
        if view is not None and view != self._shown.get(name):
            self._shown[name] = view
            publish(self._outputs[name], view)

    def _send(self, name: str, view: View, result: Result) -> None:
        summary = result.summary or nothing_found(result.grid_map)
        stamp = self.stamp()
        self._drawing.ask(self._outputs[name], lambda: view(summary, result.grid_map, stamp))

    def _send_saved_waypoints(self) -> None:
        """Publish the waypoints of a file, if one was given: they stand in for a posterior."""
        if self._saved_waypoints:
            waypoints, stamp = self._saved_waypoints, self.stamp()
            self._drawing.ask(self._outputs["waypoints"], lambda: path_of(waypoints, stamp))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; returns the exit status."""
    # Numpy holds the interpreter for up to its switch interval while a callback waits.
    sys.setswitchinterval(0.0005)
    GarbageSearch.only_here()
    return serve("subgoal_node", SubgoalNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
