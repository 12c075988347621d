"""How a demonstrator chooses its actions, given its subgoal.

Both forms are a softmax over what an action costs, in units of its own: P(a | s, g) is
proportional to exp(-alpha cost(s, a, g)), the best action costing nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.mdp.process import MarkovDecisionProcess

LIKELIHOODS = ("delay", "value")
"""What an action costs: steps until the subgoal (`delays`), or value (`value_losses`, (7))."""

_LOWEST_VALUE = 1e-11  # of Q*: below it, differences between actions are rounding
_NEVER = 1e9  # steps; an action from which the goal cannot be reached any more


def action_columns(mdp: MarkovDecisionProcess, actions: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """(N,) column of each action (N,) among those of a process.

    Raises:
        InputError: there is no such action.
    """
    chosen = np.asarray(actions)
    there = np.isin(chosen, mdp.actions)
    if not there.all():
        known = ", ".join(map(str, mdp.actions))
        raise InputError(f"action {chosen[~there][0]}: is none of {known}")
    return np.searchsorted(mdp.actions, chosen)


def action_log_likelihood(
    values: npt.NDArray[np.float64], confidence: float
) -> npt.NDArray[np.float64]:
    """Log of equation (7): log softmax over the actions of alpha Q*(s, a, R_g).

    Args:
        values: (U, A, G) optimal action values of each goal at each state.
        confidence: alpha, how surely the demonstrator takes the better action; above 0.

    Returns:
        (U, A, G) log P(a | s, g).
    """
    logits = -confidence * value_losses(values)
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))


def value_losses(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(U, A, G) what each action loses of Q*: the cost behind equation (7)."""
    return np.asarray(values.max(axis=1, keepdims=True) - values)


def delays(values: npt.NDArray[np.float64], discount: float) -> npt.NDArray[np.float64]:
    """(U, A, G) how many steps later each action brings the demonstrator to the subgoal [steps].

    Off the goal, Q* of a single goal is proportional to E[gamma^T], T the number of steps until
    the goal. So log Q* / log gamma is the certain number of steps that is worth as much as the
    uncertain one (the certainty equivalent of an exponential utility), and tends to E[T] as gamma
    tends to 1. Its differences depend neither on the reward, nor on how far away the goal is, nor,
    to first order, on the discount. So a confidence in nats for each step lost means the same on
    every map, where alpha in (7) does not.

    Where the goal cannot be reached, or is so far away that its value is rounding, no action costs
    anything; nor with a discount of 0, which tells no time.

    Args:
        values: (U, A, G) optimal action values of each goal at each state.
        discount: gamma, with which they were found.
    """
    if discount == 0.0:
        return np.zeros_like(values)
    best = values.max(axis=1, keepdims=True)
    tells = best > _LOWEST_VALUE
    with np.errstate(divide="ignore"):
        share = np.log(np.divide(values, best, out=np.ones_like(values), where=tells))
    return np.minimum(share / np.log(discount), _NEVER)
