"""What is known of goals that were solved before, while a demonstration grows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld

_STATES = 1024  # of which goals are known: the visited ones and those around
_ROOM = 1 << 22  # numbers that are kept: 32 MB
_PREPARED = 1 << 16  # cells of a map on which goals are solved that may never be asked for


class KnownGoals:
    """What actions do in the visited states and those around, for each goal ever asked for.

    To solve a goal tells that of all states. So where another one nearby is visited, that one
    alone has to be solved as a goal. What is kept has a bound, but for what was asked for last.
    """

    def __init__(
        self,
        world: GridWorld,
        find: Callable[[npt.NDArray[np.int64], Goals], npt.NDArray[np.float64]],
    ) -> None:
        """Nothing known yet.

        Args:
            world: where the goals are.
            find: what solves goals: of states (U,) and goals it makes (U, A, G), such as the costs
                of actions.
        """
        self.world, self._find = world, find
        self._kept_in = np.empty(0, dtype=np.int64)  # states, ascending
        self._of_goal: dict[bytes, npt.NDArray[np.float64]] = {}  # (states, A) for each
        self._asked = np.empty(0, dtype=np.int64), Goals.of_sets([])  # last
        self._lane_of: dict[bytes, int] = {}  # of the goals in the last answer
        self._answer = np.empty((0, len(world.actions), 0))

    def of(self, states: npt.NDArray[np.int64], goals: Goals) -> npt.NDArray[np.float64]:
        """(U, A, G) as it is found; an equal question gets the same array again.

        Args:
            states: (U,) state numbers, ascending.
            goals: the goals.
        """
        before, old = self._asked
        if not (
            np.array_equal(states, before)
            and np.array_equal(goals.first, old.first)
            and np.array_equal(goals.states, old.states)
        ):
            keys = self._have(states, goals)
            rows = np.searchsorted(self._kept_in, states)
            answer = self._with_one_more(states, keys, rows)
            if answer is None:
                by_goal = np.empty((len(goals), len(states) * len(self.world.actions)))
                for lane, key in enumerate(keys):
                    self._of_goal[key].take(
                        rows, axis=0, out=by_goal[lane].reshape(len(states), -1)
                    )
                answer = np.ascontiguousarray(by_goal.T).reshape(len(states), -1, len(goals))
            self._asked, self._answer = (states, goals), answer
            self._lane_of = dict(zip(keys, range(len(keys)), strict=True))
        return self._answer

    def _with_one_more(
        self,
        states: npt.NDArray[np.int64],
        keys: list[bytes],
        rows: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.float64] | None:
        """The last answer with a further state, a further goal, or both; None if that is not all.

        To copy it takes a third of the time that it takes to gather it.
        """
        before, known = self._asked[0], self._lane_of
        new = np.flatnonzero(~np.isin(states, before))
        lanes = [lane for lane, key in enumerate(keys) if key not in known]
        if (
            len(new) > 1
            or len(lanes) > 1
            or len(states) - len(new) != len(before)
            or [known[key] for key in keys if key in known] != list(range(len(known)))
        ):
            return None
        answer = self._answer
        for row in new:
            of_state = [self._of_goal[key][rows[row]] for key in known]
            answer = np.insert(answer, row, np.array(of_state).T, axis=0)
        for lane in lanes:
            answer = np.insert(answer, lane, self._of_goal[keys[lane]][rows], axis=2)
        return answer

    def prepare(self, state: int) -> None:
        """Solve what a step from a state to a cell that was never visited will ask for."""
        if self.world.state_count > _PREPARED:
            return
        states, goals = self._asked
        near = self._around(np.array([state]))
        every = Goals.of_sets([*(goals[goal] for goal in range(len(goals))), *near[:, None]])
        self._have(np.union1d(states, near), every)

    def _have(self, states: npt.NDArray[np.int64], goals: Goals) -> list[bytes]:
        """Know these goals in these states, and what there is room for besides.

        Returns:
            what each goal is kept by.
        """
        keys = [goals[goal].tobytes() for goal in range(len(goals))]
        if not np.isin(states, self._kept_in).all():
            room = min(_STATES, _ROOM // (2 * len(self.world.actions) * max(1, len(keys))))
            self._kept_in = self._widened(states, room)
            self._of_goal.clear()
        missing = [goal for goal, key in enumerate(keys) if key not in self._of_goal]
        if not missing:
            return keys
        room = _ROOM // (len(self.world.actions) * len(self._kept_in))
        if len(self._of_goal) + len(missing) > room:
            asked = {*keys}
            self._of_goal = {key: kept for key, kept in self._of_goal.items() if key in asked}
        new = Goals.of_sets(goals[goal] for goal in missing)
        found = self._find(self._kept_in, new)
        for lane, goal in enumerate(missing):
            self._of_goal[keys[goal]] = np.ascontiguousarray(found[:, :, lane])
        return keys

    def _widened(self, states: npt.NDArray[np.int64], room: int) -> npt.NDArray[np.int64]:
        """These states, and those around them that there is room for."""
        count = 0
        while count < len(states) < room:
            count = len(states)
            states = np.union1d(states, self._around(states))
        return states

    def _around(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """The states, and the free ones beside them, ascending."""
        cells = (self.world.cells_of(states)[:, None] + STEPS).reshape(-1, 2)
        height, width = self.world.free.shape
        cells = cells[((cells >= 0) & (cells < (width, height))).all(axis=1)]
        near = np.unique(self.world.states_of(cells))
        return near[self.world.free.reshape(-1)[near]]
