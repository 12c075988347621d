"""How a node is, for /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bnirl_ros.inference.summary import Summary
from bnirl_ros.views.messages import DiagnosticArray, DiagnosticStatus, KeyValue
from bnirl_ros.views.stamped import header_of


@dataclass(frozen=True)
class Health:
    """What there is to say of a node that infers.

    Attributes:
        name: the node's name.
        paused, idle: whether running inference rests; whether it has nothing to do.
        observations: those in the last result.
        waiting: poses and actions received since then.
        sweeps: sweeps of each chain for the last result.
        summary: what it says; None without observations.
        faults: how often each fault occurred among the messages that are left out.
        error: what is wrong with the inference now; empty for nothing.
        last_error: what went wrong last, be it mended or not; empty for nothing.
    """

    name: str
    paused: bool
    idle: bool
    observations: int
    waiting: int
    sweeps: int
    summary: Summary | None
    faults: Mapping[str, int]
    error: str
    last_error: str


def diagnostic_array(health: Health, stamp_ns: int) -> DiagnosticArray:
    """The message for /diagnostics: an error if inference fails, a warning if any is left out."""
    summary = health.summary
    drops = sum(health.faults.values())
    if health.error:
        level, message = DiagnosticStatus.ERROR, health.error
    elif drops:
        level, message = DiagnosticStatus.WARN, f"{drops} messages left out"
    elif summary is None:
        level, message = DiagnosticStatus.OK, "waiting for a map and observations"
    else:
        level = DiagnosticStatus.OK
        message = f"{len(summary.subgoals)} subgoals from {health.observations} observations"
    values = {
        "state": "paused" if health.paused else "settled" if health.idle else "inferring",
        "observations": str(health.observations),
        "subgoals": str(len(summary.subgoals) if summary else 0),
        "sweeps": str(health.sweeps),
        "R-hat": _number(summary.rhat if summary else None),
        "effective sample size": _number(summary.ess if summary else None),
        "queue": str(health.waiting),
        "drops": str(drops),
        **{f"left out: {fault}": str(count) for fault, count in sorted(health.faults.items())},
        "last error": health.last_error,
    }
    status = DiagnosticStatus(
        level=level,
        name=f"{health.name}: inference",
        message=message,
        values=[KeyValue(key, value) for key, value in values.items()],
    )
    return DiagnosticArray(header=header_of("", stamp_ns), status=[status])


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4g}"
