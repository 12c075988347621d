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
from bnirl_ros.nodes import discretiser_node, subgoal_node
from bnirl_ros.nodes.managed import AUTOSTART, DIAGNOSTICS
from bnirl_ros.nodes.parameters import NodeParameter, parameter_of
from bnirl_ros.nodes.topics import NodeService, NodeTopic

_INTRODUCTION = """\
# Topics, services and parameters

This page is made of the tables that the nodes are made of: `make reference` writes it. `ros2 node
info`, `ros2 param list` and `ros2 param describe` tell the same of a node that runs.

Names without a leading slash are relative: they are in the node's namespace, and can be remapped.
Those with `~/` are under the node's own name.

## What both nodes have in common

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

`replay_node --help` and `bnirl --help` tell of the programs that are no managed nodes.
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


@dataclass(frozen=True)
class _Page:
    """What there is to tell of a node."""

    name: str
    summary: str
    notes: str
    inputs: Sequence[NodeTopic]
    outputs: Sequence[NodeTopic]
    services: Sequence[NodeService]
    parameters: Sequence[NodeParameter]


_PAGES = (
    _Page(
        "subgoal_node",
        subgoal_node.SubgoalNode.__doc__ or "",
        _ON_SUBGOALS,
        subgoal_node.INPUTS,
        subgoal_node.OUTPUTS,
        subgoal_node.SERVICES,
        (*map(parameter_of, fields(Settings)), *subgoal_node.PARAMETERS),
    ),
    _Page(
        "discretiser_node",
        discretiser_node.DiscretiserNode.__doc__ or "",
        _ON_DISCRETISING,
        discretiser_node.INPUTS,
        discretiser_node.OUTPUTS,
        (),
        discretiser_node.PARAMETERS,
    ),
)


def reference() -> str:
    """The page, in Markdown."""
    return "\n".join([_INTRODUCTION, *map(_section, _PAGES)])


def _section(page: _Page) -> str:
    first_line = page.summary.partition("\n")[0]
    parts = [f"## {page.name}\n\n{first_line}\n\n{page.notes}"]
    parts.append("### Heard\n\n" + _topic_table(page.inputs))
    parts.append("### Published\n\n" + _topic_table((*page.outputs, DIAGNOSTICS)))
    if page.services:
        rows = [(f"`{each.name}`", each.type_name, each.meaning) for each in page.services]
        parts.append("### Services\n\n" + _table(("service", "type", "what it does"), rows))
    parts.append("### Parameters\n\n" + _parameter_table((AUTOSTART, *page.parameters)))
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
