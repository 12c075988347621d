"""A demonstration: what the demonstrator did, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Observations (s_i, a_i) of equation (4) in canonical order: by episode, then by stamp.

    Attributes:
        episode: (N,) int64 number of the episode of each observation, ascending.
        cells: (N, 2) int64 cell (x, y) in which each action was chosen.
        action: (N,) int64 index into `ACTION_NAMES`.
        last_episode: (L,) int64 the episodes whose last pose is known though no action was taken
            there, ascending.
        last_cells: (L, 2) int64 those last poses' cells.
    """

    episode: npt.NDArray[np.int64]
    cells: npt.NDArray[np.int64]
    action: npt.NDArray[np.int64]
    last_episode: npt.NDArray[np.int64]
    last_cells: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.action)

    @property
    def starts(self) -> npt.NDArray[np.bool_]:
        """(N,) which observations begin an episode."""
        return np.diff(self.episode, prepend=-1) != 0

    @property
    def observations(self) -> npt.NDArray[np.int64]:
        """(N, 4) int64: episode, x, y, action index."""
        return np.column_stack([self.episode, self.cells, self.action])

    def of_episodes(self, episodes: npt.ArrayLike) -> Demonstration:
        """What was seen in the episodes with these numbers, which they keep."""
        observed = np.isin(self.episode, episodes)
        ended = np.isin(self.last_episode, episodes)
        return Demonstration(
            episode=self.episode[observed],
            cells=self.cells[observed],
            action=self.action[observed],
            last_episode=self.last_episode[ended],
            last_cells=self.last_cells[ended],
        )
