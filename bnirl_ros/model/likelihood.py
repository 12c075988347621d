"""How a demonstrator chooses its actions, given its subgoal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


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
    logits = confidence * (values - values.max(axis=1, keepdims=True))
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))
