"""Posterior draws, as every sampler records them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

DRAW_MEMORY = 1 << 30
"""What the draws of all chains may take [bytes], unless a single one of each takes more."""


@dataclass(frozen=True, eq=False)
class Draws:
    """What a chain leaves behind; with a further leading axis, what several chains do.

    Attributes:
        subgoal_of: (draw, N) int32 candidate index of each observation's subgoal; -1 for a slip.
        partition_of: (draw, N) int32 partition of each observation, numbered from 0 in the order
            of their first observations: two draws with the same partition are equal arrays; -1
            for a slip.
        log_joint: (draw,) float64 log joint of the model: of (10) for the paper's.
        parameters: (draw, P) float64 the parameters that are drawn too; P = 0 for the paper's
            model, else those of `bnirl_ros.model.pursuits.PRIORS`, in their order.
    """

    subgoal_of: npt.NDArray[np.int32]
    partition_of: npt.NDArray[np.int32]
    log_joint: npt.NDArray[np.float64]
    parameters: npt.NDArray[np.float64]

    @classmethod
    def empty(cls, shape: tuple[int, ...], observations: int, parameters: int = 0) -> Draws:
        """Room for draws: `shape` is (draws,) or (chains, draws)."""
        return cls(
            subgoal_of=np.empty((*shape, observations), dtype=np.int32),
            partition_of=np.empty((*shape, observations), dtype=np.int32),
            log_joint=np.empty(shape, dtype=np.float64),
            parameters=np.empty((*shape, parameters), dtype=np.float64),
        )

    def __getitem__(self, key: int | slice) -> Draws:
        """A part along the leading axis, as a view."""
        return Draws(*(values[key] for values in vars(self).values()))

    def drop_every_second(self) -> None:
        """Of several chains' draws, an even number, the second, fourth, ... become the first."""
        for values in vars(self).values():
            values[:, : values.shape[1] // 2] = values[:, 1::2].copy()

    def __len__(self) -> int:
        return len(self.log_joint)

    @property
    def partition_count(self) -> npt.NDArray[np.int64]:
        """(...,) number of partitions in each draw."""
        return np.asarray(self.partition_of.max(axis=-1, initial=-1) + 1, dtype=np.int64)


def most_draws(chains: int, observations: int) -> int:
    """How many draws of each chain fit into `DRAW_MEMORY`; at least one. Each takes 8 bytes for
    an observation."""
    return max(1, DRAW_MEMORY // (8 * chains * max(observations, 1)))
