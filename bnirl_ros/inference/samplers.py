"""Which sampler draws from which model: each is a module with the functions of `Sampler`."""

from __future__ import annotations

from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from bnirl_ros.inference import pursuit_gibbs, urn_gibbs
from bnirl_ros.inference.draws import Draws
from bnirl_ros.model.mixture import SubgoalMixture
from bnirl_ros.model.pursuits import PursuitModel

Model = SubgoalMixture | PursuitModel


class Sampler(Protocol):
    """What chains need of a sampler. States belong to it alone; `advance` changes them."""

    def room_for(self, model: Any, shape: tuple[int, ...]) -> Draws:
        """Draws still to be filled: `shape` is (draws,) or (chains, draws)."""

    def initial_state(self, model: Any, generator: np.random.Generator) -> Any:
        """Where a fresh chain starts."""

    def going_on(
        self,
        model: Any,
        state: Any,
        row_before: npt.NDArray[np.int64],
        candidate_now: npt.NDArray[np.int64],
        generator: np.random.Generator,
    ) -> Any:
        """A state of a changed demonstration that goes on from an older one.

        Args:
            model: of the observations now.
            state: of the observations before.
            row_before: (N,) row of each observation before; -1 for a new one.
            candidate_now: (G before,) index of each candidate now; -1 for none.
            generator: source of randomness.
        """

    def advance(
        self, model: Any, state: Any, generator: np.random.Generator, draws: Draws, thin: int = 1
    ) -> None:
        """Sweep on from `state` until all of `draws` is filled, one in `thin` sweeps."""


def sampler_of(model: Model) -> Sampler:
    """The sampler of a model."""
    module = urn_gibbs if isinstance(model, SubgoalMixture) else pursuit_gibbs
    return cast("Sampler", module)
