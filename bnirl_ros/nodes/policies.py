"""policies/, what each node may do where access is controlled (SROS 2), made of its tables.

python -m bnirl_ros.nodes.policies policies
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from bnirl_ros.nodes.managed import DIAGNOSTICS
from bnirl_ros.nodes.record_node import contract
from bnirl_ros.nodes.reference import PAGES, NodePage
from bnirl_ros.nodes.subgoal_node import INPUTS

FORMAT = "0.2.0"
"""Version of sros2's policies that we write."""

OF_EVERY_NODE = ("/parameter_events", "/rosout")
"""What rclpy lets every node publish."""

SERVICES_OF_EVERY_NODE = (
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/get_type_description",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
)
"""What rclpy lets every node be asked for."""

SERVICES_OF_MANAGED_NODES = (
    "~/change_state",
    "~/get_available_states",
    "~/get_available_transitions",
    "~/get_state",
    "~/get_transition_graph",
)
"""What a lifecycle node can be asked for besides."""


@dataclass(frozen=True)
class Further:
    """What a node needs that its tables do not tell, with the reason.

    Attributes:
        heard: topics by reason.
        published: topics by reason.
    """

    heard: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    published: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


_CONTRACT = tuple(topic.name for topic in INPUTS)
_TIME = {"With use_sim_time": ("/clock",)}

FURTHER = {
    "subgoal_node": Further(
        heard={**_TIME, "Instead of map where discretiser_node makes one": ("planning_map",)}
    ),
    "discretiser_node": Further(
        heard={
            **_TIME,
            "The sources and the intent of config/nav2_robot.yaml; name here what source and "
            "intent name": ("amcl_pose", "cmd_vel", "odom"),
            "Where tf2_ros is installed": ("/tf", "/tf_static"),
        }
    ),
    "replay_node": Further(
        published={
            "A demonstration; name here what else is in the bag": _CONTRACT,
            "Where it is to tell the time": ("/clock",),
        }
    ),
    "record_node": Further(
        heard={"What is recorded unless others are named; name those here": contract()}
    ),
}
"""By node; the tables of a managed node tell nearly all."""


def policy(page: NodePage) -> str:
    """The policy of a node, as XML: it may do this, and nothing else."""
    further = FURTHER[page.name]
    published: dict[str, Iterable[str]] = {"": (topic.name for topic in page.outputs)}
    published |= further.published
    published["Of every node"] = OF_EVERY_NODE
    heard: dict[str, Iterable[str]] = {"": (topic.name for topic in page.inputs)}
    heard |= further.heard
    answered: dict[str, Iterable[str]] = {"": (service.name for service in page.services)}
    if page.managed:
        published["Of every managed node"] = (DIAGNOSTICS.name, "~/transition_event")
        answered["Of every managed node"] = SERVICES_OF_MANAGED_NODES
    answered["Of every node"] = SERVICES_OF_EVERY_NODE

    root = ElementTree.Element("policy", version=FORMAT)
    enclaves = ElementTree.SubElement(root, "enclaves")
    enclave = ElementTree.SubElement(enclaves, "enclave", path=f"/bnirl_ros/{page.name}")
    profiles = ElementTree.SubElement(enclave, "profiles")
    profile = ElementTree.SubElement(profiles, "profile", ns="/", node=page.name)
    _allow(profile, "topics", "publish", published)
    _allow(profile, "topics", "subscribe", heard)
    _allow(profile, "services", "reply", answered)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- What {page.name} may do. Made by make '
        f"policies; see docs/security.md. -->\n{text}\n"
    )


def _allow(
    profile: ElementTree.Element, kind: str, way: str, names: Mapping[str, Iterable[str]]
) -> None:
    """Allow names of a kind in one way; each group has its reason as a comment."""
    groups = {reason: tuple(group) for reason, group in names.items()}
    if not any(groups.values()):
        return
    rule = ElementTree.SubElement(profile, kind, {way: "ALLOW"})
    for reason, group in groups.items():
        if reason:
            rule.append(ElementTree.Comment(f" {reason}. "))
        for name in group:
            ElementTree.SubElement(rule, kind.removesuffix("s")).text = name


def policies() -> dict[str, str]:
    """The policy of each node, by the name of its file."""
    return {f"{page.name}.policy.xml": policy(page) for page in PAGES}


if __name__ == "__main__":
    for name, content in policies().items():
        Path(sys.argv[1], name).write_text(content, encoding="utf-8")
