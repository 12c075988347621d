"""docs/reference.md, made of the tables that the nodes themselves are made of.

python -m bnirl_ros.nodes.reference docs/reference.md
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from bnirl_ros.inference.settings import Settings
from bnirl_ros.nodes import discretiser_node, record_node, replay_node, subgoal_node
from bnirl_ros.nodes.managed import DIAGNOSTICS, with_common
from bnirl_ros.nodes.parameters import NodeParameter, parameter_of
from bnirl_ros.nodes.topics import NodeService, NodeTopic

_INTRODUCTION = """\
# Topics, services and parameters

This page is made of the tables that the nodes are made of: `make reference` writes it. `ros2 node
info`, `ros2 param list` and `ros2 param describe` tell the same of a node that runs.

Names without a leading slash are relative: they are in the node's namespace, and can be remapped.
Those with `~/` are under the node's own name.

## What subgoal_node and discretiser_node have in common

Both are managed nodes with the services `~/change_state` and `~/get_state` of lifecycle_msgs. A
node that is not active hears and publishes nothing but `/diagnostics`; what it has gathered it
keeps until it is cleaned up. With `autostart` it configures and activates itself.

A parameter that is changed *at any time* takes effect at once, one that is changed *while
unconfigured* with the next configuration, and one that is given *at the start only* is read-only.
A value that cannot be is refused with the reason.

The QoS of each topic is a read-only parameter: `qos_overrides.<topic>.subscription.reliability`,
`.history` and `.depth`, and the same with `publisher`; `<topic>` is the whole name, such as
`/pose`. What is latched is reliable and transient local with a depth of one, so that whoever comes
late gets the last message. `use_sim_time` makes `/clock` the time of what is published; where it
jumps back a new episode begins.

What cannot be used is left out, counted by its fault, and told on `/diagnostics`, in the log the
first time and at every tenfold.

"""

_ON_SUBGOALS = """\
Pose and action are paired by equal stamps. A new episode begins where the stamps of poses are more
than `episode_gap` apart or go backwards, or the cells are no neighbours.

`current_subgoal` and `intent` follow the demonstrator, not the inference: they come within a
fraction of a second of a pose or action, ten times a second at most, by the latest posterior that
there is, also while inference rests. Now is when the next action is chosen, so on arrival they
turn to what may come next. Before the first posterior, and with the paper's model, which knows no
order, there are none. A pose cannot be taken back: after `~/reset` the last `current_subgoal`
stays, and `intent` is emptied. `docs/inference.md` tells how early the next subgoal is named.
"""

_ON_DISCRETISING = """\
The motion is that on the topic that `source` names:

| type | what it takes |
| --- | --- |
| nav_msgs/msg/Odometry | tf2_ros, unless the map is in its frame |
| geometry_msgs/msg/PoseWithCovarianceStamped | as of AMCL |
| geometry_msgs/msg/PoseStamped | |
| tf2_msgs/msg/TFMessage | tf2_ros; followed is `base_frame` |
| geometry_msgs/msg/TwistStamped, geometry_msgs/msg/Twist | `start` |

The node waits until somebody hears `pose`, so that nothing is lost, and until the topic is there,
whose type it asks for. If `source` is empty it takes odometry where tf2_ros is installed, and else
poses with covariance; no others, which may be anybody's. The topic is heard by best effort if any
of its publishers offers no more. A Twist has no stamp, so the commands are followed by when they
were published.

`subgoal_node` is to hear `planning_map` as its `map`, and its `episode_gap` is to be
`longest_silence`, for there is a pose only where a cell is entered. `docs/raw_bags.md` tells how
cells and actions are made.
"""


_ON_REPLAYING = """\
It is also `bnirl replay`, and no managed node but a program that ends with the bag; `--help` tells
its options, which are those of `ros2 bag play` and some more. QoS, header stamps and bytes are as
recorded. Several bags, and all bags in a folder, are played as one in the order of log time; a
silence between them is cut to five seconds, see `--longest-silence`.

It waits until every topic has a subscriber, and says for whom it waits; `--wait` limits that,
`--topics` leaves out what nobody will hear, and `~/resume` begins at once. Beginning at
`--start-offset`, and after `~/seek`, it first sends the last messages that were latched there. At
the start of a bag the first latched messages of its first five seconds come first. With `--clock`,
`/clock` is the log time of the recording, from the beginning on, also while it waits or is paused,
and never ahead of a message that was not sent; it jumps back where the replay does.

A service that needs a value takes it from a parameter, which has no effect by itself:

    ros2 param set /replay_node seek_to 12.5
    ros2 service call /replay_node/seek std_srvs/srv/Trigger

Where something cannot be done, `success` is false and `message` says why; else it tells where the
replay is. The last line on standard output tells how many messages of each topic were sent, and
which were not and why.
"""

_ON_RECORDING = """\
It is also `bnirl record`, and no managed node but a program that runs until it is stopped;
`--help` tells its options. Without names it records what `subgoal_node` hears and publishes. A
topic is heard from when somebody publishes it, with the most that all of its publishers offer in
reliability and durability. The bag is a folder as of `ros2 bag record -s mcap`. It ends whole with
SIGINT and SIGTERM, and when the disk is full. Where the process is killed the last two seconds may
be missing, and metadata.yaml is. Types are those of `msg_schemas`.
"""


@dataclass(frozen=True)
class NodePage:
    """What there is to tell of a node."""

    name: str
    summary: str
    notes: str
    inputs: Sequence[NodeTopic]
    outputs: Sequence[NodeTopic]
    services: Sequence[NodeService]
    parameters: Sequence[NodeParameter]
    managed: bool = True


PAGES = (
    NodePage(
        "subgoal_node",
        subgoal_node.SubgoalNode.__doc__ or "",
        _ON_SUBGOALS,
        subgoal_node.INPUTS,
        subgoal_node.OUTPUTS,
        subgoal_node.SERVICES,
        (*map(parameter_of, fields(Settings)), *subgoal_node.PARAMETERS),
    ),
    NodePage(
        "discretiser_node",
        discretiser_node.DiscretiserNode.__doc__ or "",
        _ON_DISCRETISING,
        discretiser_node.INPUTS,
        discretiser_node.OUTPUTS,
        (),
        discretiser_node.PARAMETERS,
    ),
    NodePage(
        "replay_node",
        replay_node.ReplayNode.__doc__ or "",
        _ON_REPLAYING,
        (),
        (),
        replay_node.SERVICES,
        replay_node.PARAMETERS,
        managed=False,
    ),
    NodePage(
        "record_node",
        record_node.RecordNode.__doc__ or "",
        _ON_RECORDING,
        (),
        (),
        (),
        (),
        managed=False,
    ),
)


def reference() -> str:
    """The page, in Markdown."""
    return "\n".join([_INTRODUCTION, *map(_section, PAGES)])


def _section(page: NodePage) -> str:
    first_line = page.summary.partition("\n")[0]
    parts = [f"## {page.name}\n\n{first_line}\n\n{page.notes}"]
    outputs = (*page.outputs, DIAGNOSTICS) if page.managed else page.outputs
    parameters = with_common(page.parameters) if page.managed else page.parameters
    if page.inputs:
        parts.append("### Heard\n\n" + _topic_table(page.inputs))
    if outputs:
        parts.append("### Published\n\n" + _topic_table(outputs))
    if page.services:
        rows = [(f"`{each.name}`", each.type_name, each.meaning) for each in page.services]
        parts.append("### Services\n\n" + _table(("service", "type", "what it does"), rows))
    if parameters:
        parts.append("### Parameters\n\n" + _parameter_table(parameters))
    return "\n".join(parts)


def _topic_table(topics: Iterable[NodeTopic]) -> str:
    rows = [
        (
            f"`{topic.name}`",
            topic.type_name + (", latched" if topic.latched else ""),
            topic.meaning,
        )
        for topic in topics
    ]
    return _table(("topic", "type", "meaning"), rows)


def _parameter_table(parameters: Iterable[NodeParameter]) -> str:
    rows = [
        (
            f"`{each.name}`",
            type(each.default).__name__,
            f"`{_in_yaml(each.default)}`",
            _range(each),
            each.changeable.value,
            each.limits.description,
        )
        for each in parameters
    ]
    return _table(("parameter", "type", "default", "range", "changed", "meaning"), rows)


def _range(parameter: NodeParameter) -> str:
    limits = parameter.limits
    if limits.choices:
        return ", ".join(map(str, limits.choices))
    if isinstance(parameter.default, str | bool):
        return ""
    return limits.range_in_words()


def _in_yaml(value: object) -> str:
    """A default as it is written in a parameter file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.1f}" if math.isfinite(value) and value == round(value) else f"{value:g}"
    return f'"{value}"' if value == "" else str(value)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(reference(), encoding="utf-8")
