"""The sequential model: a demonstrator pursues one subgoal until it gets there.

A family with the paper's mixture at one end. The subgoals that are pursued one after the other are
drawn from weights over the candidates with a Dirichlet prior, Dirichlet(eta P(g)), which is the
Chinese restaurant process on a discrete base. The subgoal is kept from one observation to the next
but for a switch, whose probability depends on whether the demonstrator has arrived. With a switch
at every observation, no slips and the likelihood (7), the observations are exchangeable and the
model is the paper's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.mdp.distinct import distinct
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.process import MarkovDecisionProcess, checked_states
from bnirl_ros.model.likelihood import action_columns, delays, value_losses

_VALUE_TOLERANCE = 1e-8  # far below what the likelihood can tell, also of ratios far away


class Prior(NamedTuple):
    """Prior of a parameter: log-normal or beta.

    Attributes:
        family: "log-normal", with median and standard deviation of the logarithm, or "beta".
        first, second: the two numbers of the family.
    """

    family: str
    first: float
    second: float

    def __str__(self) -> str:
        if self.family == "beta":
            return f"Beta({self.first:g}, {self.second:g})"
        return f"log-normal, median {self.first:g}, sigma {self.second:g}"

    def draw(self, generator: np.random.Generator) -> float:
        """A value from the prior."""
        if self.family == "beta":
            return float(generator.beta(self.first, self.second))
        return float(self.first * math.exp(self.second * generator.standard_normal()))


PRIORS: dict[str, Prior] = {
    "alpha": Prior("log-normal", 3.0, 1.0),
    "eta": Prior("log-normal", 3.0, 1.0),
    "slip": Prior("beta", 1.0, 9.0),
    "switch_on_arrival": Prior("beta", 1.0, 1.0),
    "switch_at_subgoal": Prior("beta", 1.0, 1.0),
    "switch_elsewhere": Prior("beta", 1.0, 19.0),
}
"""The parameters of the model, in the order in which they are drawn, and their weak priors.

alpha: confidence, nats for each step that an action costs (for likelihood (7), `VALUE_ALPHA`).
eta: concentration of the subgoals' weights.
slip: probability epsilon that an action is not explained by the subgoal, but uniform.
switch_on_arrival: probability rho that the next subgoal is drawn in the first state in which the
demonstrator is at its subgoal; it passes through.
switch_at_subgoal: the same in every further state there; it has stayed.
switch_elsewhere: the same everywhere else; it changed its mind.
"""

# Columns of arrays of the parameters, which are in the order of `PRIORS`.
ALPHA, ETA, SLIP, ON_ARRIVAL, AT_SUBGOAL, ELSEWHERE = range(len(PRIORS))

VALUE_ALPHA = Prior("log-normal", 50.0, 1.5)
"""The prior of alpha where the cost of an action is what it loses of Q*, as in (7)."""


@dataclass(frozen=True, eq=False)
class PursuitModel:
    """The sequential model of N observations with G candidate subgoals.

    For each observation t, in the order of a demonstration: theta_t is the subgoal. In an
    episode's first observation it is a fresh draw from the weights; in each other one it is, with
    probability rho, and else theta_(t-1). rho is judged in the state of observation t, by
    theta_(t-1). The weights, integrated out, are those of an urn of each `part`.

    Attributes:
        cost: (U, A, G) float64 what each action costs in each state; infinite for an action that
            is never observed, as it does the same as another.
        state_of: (N,) int64 row of `cost` for each observation.
        action_of: (N,) int64 column of `cost` for each observation.
        starts: (N,) bool which observations begin an episode.
        arrived: (U, G) bool whether a state counts as being at the subgoal.
        state_part: (U,) int64 connected part of the map in which each state lies.
        candidate_part: (G,) int64 the same for the candidates: only those of the same part are
            ever pursued, so P(g) and the urn are each part's own.
        place: (G, 2) int64 where each candidate lies: its cell, or the middle of its cells.
        fixed: values of the parameters in `PRIORS` that are not inferred.
        priors: of the parameters that are.
    """

    cost: npt.NDArray[np.float64]
    state_of: npt.NDArray[np.int64]
    action_of: npt.NDArray[np.int64]
    starts: npt.NDArray[np.bool_]
    arrived: npt.NDArray[np.bool_]
    state_part: npt.NDArray[np.int64]
    candidate_part: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    fixed: Mapping[str, float]
    priors: Mapping[str, Prior]

    @cached_property
    def prior(self) -> npt.NDArray[np.float64]:
        """(G,) P(g): uniform over the candidates of each part."""
        return 1.0 / np.bincount(self.candidate_part)[self.candidate_part]

    @cached_property
    def uniform(self) -> npt.NDArray[np.float64]:
        """(U,) probability of an action that is a slip: one over the actions that differ."""
        return 1.0 / np.isfinite(self.cost[:, :, 0]).sum(axis=1)

    def action_likelihood(self, parameters: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(U, A, G) P(a | s, g), slips included, with parameters in the order of `PRIORS`."""
        alpha, slip = parameters[ALPHA], parameters[SLIP]
        weights = np.exp(-alpha * self.cost)
        chosen = weights / weights.sum(axis=1, keepdims=True)
        uniform = np.isfinite(self.cost) * self.uniform[:, None, None]
        return np.asarray((1.0 - slip) * chosen + slip * uniform)

    def switch_probability(
        self, subgoal_of: npt.NDArray[np.int_], parameters: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """(N,) rho before each observation, by the subgoal before it; 1 at a start.

        Args:
            subgoal_of: (N,) candidate index theta of each observation's subgoal.
            parameters: in the order of `PRIORS`.
        """
        before = np.roll(subgoal_of, 1)
        here = self.arrived[self.state_of, before]
        there_already = self.arrived[np.roll(self.state_of, 1), before]
        return np.where(self.starts, 1.0, switch_probabilities(here, there_already, parameters))

    def log_joint(
        self,
        subgoal_of: npt.ArrayLike,
        switched: npt.ArrayLike,
        parameters: npt.NDArray[np.float64],
    ) -> float:
        """Log P(subgoals, switches, actions | parameters), weights and slips integrated out.

        Args:
            subgoal_of: (N,) candidate index theta of each observation's subgoal.
            switched: (N,) bool whether it is a draw of its own.
            parameters: in the order of `PRIORS`.
        """
        subgoals, switched = np.asarray(subgoal_of), np.asarray(switched, dtype=np.bool_)
        likelihood = self.action_likelihood(parameters)
        probability = likelihood[self.state_of, self.action_of, subgoals]
        rho = self.switch_probability(subgoals, parameters)
        eta = parameters[ETA]
        counts = np.bincount(subgoals[switched], minlength=len(self.prior))
        with np.errstate(divide="ignore"):
            total = np.log(probability).sum() + np.log(np.where(switched, rho, 1.0 - rho)).sum()
        for part in np.unique(self.candidate_part):
            here = self.candidate_part == part
            total += _log_urn(counts[here], eta * self.prior[here])
        return float(total)


def switch_probabilities(
    here: npt.NDArray[np.bool_],
    there_already: npt.NDArray[np.bool_],
    parameters: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Rho, element by element.

    Args:
        here: whether the demonstrator is at its subgoal where the next action is chosen.
        there_already: whether it was where the last action was chosen.
        parameters: in the order of `PRIORS`.
    """
    on_arrival, at_subgoal, elsewhere = parameters[[ON_ARRIVAL, AT_SUBGOAL, ELSEWHERE]]
    return np.where(here, np.where(there_already, at_subgoal, on_arrival), elsewhere)


def _log_urn(counts: npt.NDArray[np.int64], weights: npt.NDArray[np.float64]) -> float:
    """Log probability of a sequence of draws from a Polya urn, whatever their order."""
    drawn = counts > 0
    each = sum(
        math.lgamma(weight + count) - math.lgamma(weight)
        for weight, count in zip(weights[drawn], counts[drawn], strict=True)
    )
    return each + math.lgamma(weights.sum()) - math.lgamma(weights.sum() + counts.sum())


def pursuit_model(
    mdp: MarkovDecisionProcess,
    states: npt.ArrayLike,
    actions: npt.ArrayLike,
    starts: npt.ArrayLike,
    candidates: npt.ArrayLike | Goals,
    arrived: npt.NDArray[np.bool_] | None = None,
    likelihood: str = "delay",
    fixed: Mapping[str, float] | None = None,
    cost: npt.NDArray[np.float64] | None = None,
) -> PursuitModel:
    """The sequential model of a demonstration.

    Args:
        mdp: the grid world or finite MDP in which the observations were made.
        states: (N,) state number of each observation, in order.
        actions: (N,) its action, one of `mdp.actions`.
        starts: (N,) bool which observations begin an episode.
        candidates: the goals in the support of P(g), or (G,) state numbers of single ones.
        arrived: (U, G) whether each distinct state, in ascending order, counts as being at a
            candidate; by default only the candidate's own states.
        likelihood: "delay": actions cost steps, those that do the same are one action; "value":
            they cost value, equation (7) to the letter.
        fixed: values of parameters in `PRIORS` that are not to be inferred.
        cost: (U, A, G) `action_costs` in each distinct state, in ascending order, where they are
            known; by default they are found, which takes most of the time.

    Raises:
        InputError: an observation lies where no candidate can be reached, or there is no such
            action.
        ValueError: a candidate lies in more than one part of the map.
    """
    goals = candidates if isinstance(candidates, Goals) else Goals.of_states(candidates)
    visited, state_of = distinct(checked_states(mdp, states, "state"), mdp.state_count)
    action_of = action_columns(mdp, actions)
    parts = np.unique(
        np.concatenate([mdp.parts_of(visited), mdp.parts_of(goals.states)]), return_inverse=True
    )[1]
    state_part, goal_part = parts[: len(visited)], parts[len(visited) :]
    candidate_part = goal_part[goals.first[:-1]]
    if (goal_part != candidate_part[goals.goal_of]).any():
        raise ValueError("a candidate lies in more than one part of the map")
    if not np.isin(state_part, candidate_part).all():
        raise InputError("an observation lies where no candidate can be reached")
    priors = dict(PRIORS)
    if likelihood == "delay":
        action_of = mdp.same_action(visited)[state_of, action_of]
    else:
        priors["alpha"] = VALUE_ALPHA
    return PursuitModel(
        cost=action_costs(mdp, visited, goals, likelihood) if cost is None else cost,
        state_of=state_of,
        action_of=action_of.astype(np.int64),
        starts=np.asarray(starts, dtype=np.bool_),
        arrived=goals.hold(visited) if arrived is None else arrived,
        state_part=state_part,
        candidate_part=candidate_part,
        place=_middles(mdp, goals),
        fixed=dict(fixed or {}),
        priors=priors,
    )


def action_costs(
    mdp: MarkovDecisionProcess, states: npt.NDArray[np.int64], goals: Goals, likelihood: str
) -> npt.NDArray[np.float64]:
    """(U, A, G) what each action costs in each of the states (U,), as in `PursuitModel.cost`.

    Args:
        mdp: where they are.
        states: state numbers.
        goals: the candidates.
        likelihood: as in `pursuit_model`.
    """
    values = goal_values(mdp, goals, states, _VALUE_TOLERANCE)
    if likelihood != "delay":
        return value_losses(values)
    same = mdp.same_action(states)
    redundant = same != np.arange(same.shape[1])
    return np.where(redundant[:, :, None], np.inf, delays(values, mdp.discount))


def _middles(mdp: MarkovDecisionProcess, goals: Goals) -> npt.NDArray[np.int64]:
    """(G, 2) the mean place of the states of each goal, rounded."""
    sums = np.add.reduceat(mdp.places_of(goals.states), goals.first[:-1], axis=0)
    return np.asarray(np.rint(sums / goals.sizes[:, np.newaxis]), dtype=np.int64)
