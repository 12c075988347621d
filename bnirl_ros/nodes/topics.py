"""Topics and services of a node as tables: what is made, documented and tested is one list."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NodeTopic:
    """A topic that a node hears or publishes.

    Attributes:
        name: relative unless it says otherwise; can be remapped.
        type_name: such as "geometry_msgs/msg/PoseStamped".
        meaning: for the reference.
        latched: whether the last message is kept for whoever comes late (transient local).
    """

    name: str
    type_name: str
    meaning: str
    latched: bool = True


@dataclass(frozen=True)
class NodeService:
    """A service of a node.

    Attributes:
        name: its own, under the node's name.
        type_name: such as "std_srvs/srv/Trigger".
        meaning: for the reference.
    """

    name: str
    type_name: str
    meaning: str
