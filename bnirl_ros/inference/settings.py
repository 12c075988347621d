"""Every setting of an inference, declared once: for Python, the command line and the node."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from bnirl_ros.errors import InputError
from bnirl_ros.limits import check, setting
from bnirl_ros.model.candidates import CANDIDATE_KINDS
from bnirl_ros.model.likelihood import LIKELIHOODS
from bnirl_ros.model.pursuits import PRIORS, VALUE_ALPHA

PAPER_PARAMETERS = {"alpha": 50.0, "eta": 1.0}
"""What the paper's model takes where nothing is given: it infers neither."""

SEQUENTIAL_ONLY = {*PRIORS} - {*PAPER_PARAMETERS} | {"arrival_radius", "likelihood"}
"""Settings that only the sequential model has."""


def _parameter(name: str, description: str, **limits: Any) -> Any:
    """A parameter of the model, which is inferred where it is not given."""
    words = f"{description}; inferred where not given, prior {PRIORS[name]}"
    if name in PAPER_PARAMETERS:
        words += f"; {PAPER_PARAMETERS[name]:g} for the paper's model"
    return setting(None, words, **limits)


@dataclass(frozen=True)
class Settings:
    """Model and sampling settings; the defaults are those of `bnirl infer` and the node.

    Raises:
        InputError: a value is out of its range; the sentence names it.
    """

    model: str = setting(
        "sequential",
        "model of the demonstrator: pursuits in sequence, or the mixture of Michini & How",
        choices=("sequential", "paper"),
    )
    alpha: float | None = _parameter(
        "alpha", "confidence [nats for each step lost], or alpha of equation (7)", above=0.0
    )
    eta: float | None = _parameter("eta", "concentration of the subgoals' weights", above=0.0)
    slip: float | None = _parameter(
        "slip", "probability of an action that no subgoal explains", lowest=0.0, below=1.0
    )
    switch_on_arrival: float | None = _parameter(
        "switch_on_arrival", "probability of the next subgoal on arriving", lowest=0.0, highest=1.0
    )
    switch_at_subgoal: float | None = _parameter(
        "switch_at_subgoal",
        "probability of the next subgoal in each further observation there",
        lowest=0.0,
        highest=1.0,
    )
    switch_elsewhere: float | None = _parameter(
        "switch_elsewhere",
        "probability of another subgoal in each observation on the way",
        lowest=0.0,
        highest=1.0,
    )
    arrival_radius: float = setting(
        0.0, "distance within which a subgoal is reached [m]; 0: in its cell", lowest=0.0
    )
    likelihood: str = setting(
        "delay",
        "what actions of the sequential model cost: steps, or value as in equation (7); with "
        f"value the prior of alpha is {VALUE_ALPHA}",
        choices=LIKELIHOODS,
    )
    sweeps: int = setting(1000, "sweeps of each chain, burn-in included", lowest=1)
    burn_in: int = setting(200, "first sweeps of each chain that are left out", lowest=0)
    thin: int = setting(1, "every how many sweeps a draw is kept", lowest=1)
    max_sweeps: int = setting(
        0,
        "sweeps go on, twice as many each time, until the chains have converged, or up to so "
        "many; 0: no more than sweeps",
        lowest=0,
    )
    time_budget: float = setting(
        0.0,
        "time after which sweeping ends in any case [s]; results then depend on the machine; 0: "
        "no limit",
        lowest=0.0,
    )
    chains: int = setting(4, "number of independent chains", lowest=1, highest=1000)
    seed: int = setting(0, "seed of the random numbers", lowest=0)
    success: float = setting(
        0.7,
        "probability that a move goes as chosen; the rest is spread over the other actions",
        above=0.0,
        highest=1.0,
    )
    discount: float = setting(0.99, "discount factor gamma", lowest=0.0, below=1.0)
    moves: int = setting(
        8, "moves to neighbouring cells: 8, or 4 for no diagonals", choices=(4, 8)
    )
    candidates: str = setting(
        "visited",
        "cells that may be subgoals: the visited ones, or all free ones",
        choices=CANDIDATE_KINDS,
    )

    def __post_init__(self) -> None:
        check(self)
        if self.model == "paper":
            self._refuse_what_the_paper_does_not_know()
        if self.draws < 1:
            raise InputError(
                f"sweeps must leave a draw: {self.sweeps} sweeps less {self.burn_in} of burn-in "
                f"hold none at thin {self.thin}"
            )
        if self.max_sweeps:
            self._refuse_what_cannot_converge()

    def _refuse_what_cannot_converge(self) -> None:
        if self.max_sweeps < self.sweeps:
            raise InputError(
                f"max_sweeps must be 0 or at least sweeps, {self.sweeps}, not {self.max_sweeps}"
            )
        if self.chains < 2:
            raise InputError(
                "chains must be at least 2 with max_sweeps: one alone cannot tell whether it has "
                "converged"
            )

    def _refuse_what_the_paper_does_not_know(self) -> None:
        for each in fields(self):
            sequential = each.name in SEQUENTIAL_ONLY
            if sequential and getattr(self, each.name) != each.default:
                raise InputError(
                    f"{each.name} is no setting of the paper's model; leave it out, or take "
                    "the sequential model"
                )

    @property
    def fixed(self) -> dict[str, float]:
        """The parameters of the model that are not inferred, by name."""
        given = {name: getattr(self, name) for name in PRIORS}
        if self.model == "paper":
            given = {
                name: default if given[name] is None else given[name]
                for name, default in PAPER_PARAMETERS.items()
            }
        return {name: value for name, value in given.items() if value is not None}

    @property
    def draws(self) -> int:
        """Draws kept from each chain."""
        return (self.sweeps - self.burn_in) // self.thin
