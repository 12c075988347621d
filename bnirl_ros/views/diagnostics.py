"""How a node is, for /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bnirl_ros.inference.summary import Summary
from bnirl_ros.views.messages import DiagnosticArray, DiagnosticStatus, KeyValue
from bnirl_ros.views.stamped import header_of


@dataclass(frozen=True)
class Health:
    """How a node is.

    Attributes:
        subject: what this is about, such as "inference".
        state: what the node does, in a word.
        message: what there is to say if nothing is wrong.
        values: what else there is to tell, in the order in which it is shown.
        faults: how often each fault occurred among the messages that are left out.
        error: what is wrong now; empty for nothing.
        last_error: what went wrong last, be it mended or not; empty for nothing.
    """

    subject: str
    state: str
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    faults: Mapping[str, int] = field(default_factory=dict)
    error: str = ""
    last_error: str = ""


def inference_values(
    summary: Summary | None, observations: int, sweeps: int, waiting: int
) -> dict[str, str]:
    """What there is to tell of a node that infers.

    Args:
        summary: what the last result says; None without observations.
        observations: those in the last result.
        sweeps: of each chain for the last result.
        waiting: poses and actions received since then.
    """
    return {
        "observations": str(observations),
        "subgoals": str(len(summary.subgoals) if summary else 0),
        "sweeps": str(sweeps),
        "R-hat": _number(summary.rhat if summary else None),
        "effective sample size": _number(summary.ess if summary else None),
        "converged": _converged(summary),
        "queue": str(waiting),
    }


def _converged(summary: Summary | None) -> str:
    """Whether the chains have, and if not, why not."""
    if summary is None:
        return "no"
    return f"no: {summary.convergence.doubt}" if summary.convergence.doubt else "yes"


def diagnostic_array(name: str, health: Health, stamp_ns: int) -> DiagnosticArray:
    """The message for /diagnostics: an error if all fails, a warning if any is left out.

    Args:
        name: the node's.
        health: how it is.
        stamp_ns: when [ns].
    """
    drops = sum(health.faults.values())
    if health.error:
        level, message = DiagnosticStatus.ERROR, health.error
    elif drops:
        level, message = DiagnosticStatus.WARN, f"{drops} messages left out"
    else:
        level, message = DiagnosticStatus.OK, health.message
    values = {
        "state": health.state,
        **health.values,
        "drops": str(drops),
        **{f"left out: {fault}": str(count) for fault, count in sorted(health.faults.items())},
        "last error": health.last_error,
    }
    status = DiagnosticStatus(
        level=level,
        name=f"{name}: {health.subject}",
        message=message,
        values=[KeyValue(key, value) for key, value in values.items()],
    )
    return DiagnosticArray(header=header_of("", stamp_ns), status=[status])


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4g}"
