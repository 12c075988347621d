"""What the demonstrator is going for now, while a demonstration goes on.

A posterior knows the subgoals and how a demonstrator like this one goes for them; what was done in
the present episode, whether the posterior has taken it in or not, tells which of them is pursued.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.placement import Placement
from bnirl_ros.errors import InputError
from bnirl_ros.inference.filtering import SubgoalFilter
from bnirl_ros.inference.posterior import Posterior
from bnirl_ros.inference.summary import Subgoal, Summary
from bnirl_ros.maps.grid_map import GridMap

_AT_ONCE = 256  # observations whose beliefs are held in memory


@dataclass(frozen=True, eq=False)
class Intent:
    """Which subgoal is pursued now, how probably.

    Now is when the next action is chosen: where the pose that follows the last action is known,
    and is at the subgoal, the demonstrator may have moved on to the next one already, with the
    probability that the model has for that. Until that pose is known, now is that last action.

    Attributes:
        grid_map, summary: the map, and what the posterior says; its subgoals are spoken of.
        probability: (J,) of each of its subgoals, by rank.
        cell: (x, y) of the demonstrator's latest pose.
        pose: number of that pose in the recording.
    """

    grid_map: GridMap
    summary: Summary
    probability: npt.NDArray[np.float64]
    cell: tuple[int, int]
    pose: int

    @property
    def another(self) -> float:
        """Probability that it is none of the subgoals."""
        return max(0.0, 1.0 - float(self.probability.sum()))

    @property
    def current(self) -> Subgoal | None:
        """The most probable subgoal, the first of equals; None where there are none."""
        if not len(self.probability):
            return None
        return self.summary.subgoals[int(self.probability.argmax())]


def by_subgoal(belief: npt.NDArray[np.float64], summary: Summary) -> npt.NDArray[np.float64]:
    """(..., J) probability of each subgoal, by rank, from that of the candidates (..., G).

    Candidates that count as one subgoal are summed; those that are none are left out.
    """
    ranks = np.arange(len(summary.subgoals)) + 1
    return belief @ (summary.rank_of_candidate[:, None] == ranks)


class IntentFilter:
    """Tells the intent of whoever demonstrates, from one posterior, as the demonstration grows.

    An observation is taken in once, so an episode of T costs O(T G) in all; see `SubgoalFilter`.
    """

    def __init__(
        self,
        posterior: Posterior,
        summary: Summary,
        grid_map: GridMap,
        before: IntentFilter | None = None,
    ) -> None:
        """A filter for whoever goes on like the demonstrator of a posterior.

        Args:
            posterior: of the sequential model.
            summary: `summarise` of it.
            grid_map: the map on which it was inferred.
            before: of an older posterior, whose goal values are used again as far as they hold.

        Raises:
            InputError: the posterior is not one of the sequential model.
        """
        self.grid_map, self.settings = grid_map, posterior.settings
        self._summary = summary
        older = before._filter if before else None
        self._filter: SubgoalFilter = SubgoalFilter(posterior, grid_map, older)
        self._taken = np.empty(0, dtype=np.int64)  # poses of what the filter has observed
        self._belief = np.empty(0)

    def intent(self, placement: Placement) -> Intent | None:
        """The intent after all that was seen of the last episode.

        Args:
            placement: of the recording so far, on the same map.

        Returns:
            None where there is no observation, or the demonstrator is where no candidate can be
            reached.
        """
        demonstration = placement.demonstration
        if not len(demonstration):
            return None
        first = int(np.searchsorted(demonstration.episode, demonstration.episode[-1]))
        try:
            self._take(demonstration, placement.poses, first)
            belief, cell, pose = self._belief, demonstration.cells[-1], placement.poses[-1]
            if demonstration.episode[-1] in demonstration.last_episode:
                cell, pose = demonstration.last_cells[-1], placement.last_poses[-1]
                belief = self._filter.expect(cell)
        except InputError:
            self._taken = self._taken[:0]
            return None
        probability = by_subgoal(belief, self._summary)
        place = int(cell[0]), int(cell[1])
        return Intent(self.grid_map, self._summary, probability, place, int(pose))

    def _take(
        self, demonstration: Demonstration, poses: npt.NDArray[np.int64], first: int
    ) -> None:
        """Observe what is new of the episode that begins with observation `first`."""
        episode = poses[first:]
        count = len(self._taken)
        # An action that comes late belongs before what was observed already.
        if not count or not np.array_equal(episode[:count], self._taken):
            self._filter.begin_episode()
            self._taken, count = episode[:0], 0
        for start in range(first + count, len(poses), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            cells, actions = demonstration.cells[part], demonstration.action[part]
            self._belief = self._filter.observe_all(cells, actions)[-1]
            self._taken = poses[first : start + len(actions)]
