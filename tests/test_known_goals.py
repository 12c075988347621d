"""What is known of goals answers every question as a solver would that is asked afresh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from bnirl_ros.inference.known_goals import KnownGoals
from bnirl_ros.mdp.distinct import ascending, distinct
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld

WORLD = GridWorld(np.ones((5, 5), dtype=np.bool_))
NUMBER = st.integers(0, WORLD.state_count - 1)
STATES = st.sets(NUMBER, min_size=1).map(sorted)


def told(states: npt.NDArray[np.int64], goals: Goals) -> npt.NDArray[np.float64]:
    """(U, A, G) a number of its own for every state, action and goal of one state."""
    actions = np.arange(len(WORLD.actions))
    of_pair = states[:, None] * len(actions) + actions
    return np.asarray(of_pair[:, :, None] * 100.0 + goals.states)


@given(st.lists(st.tuples(STATES, STATES), min_size=1, max_size=6))
def test_any_question_is_answered(questions: list[tuple[list[int], list[int]]]) -> None:
    known = KnownGoals(WORLD, told)
    for states, goals in questions:
        asked = np.array(states), Goals.of_states(goals)
        np.testing.assert_array_equal(known.of(*asked), told(*asked))


@given(STATES, STATES, st.lists(st.tuples(NUMBER, NUMBER), max_size=10))
def test_questions_that_grow_by_one_are_answered(
    states: list[int], goals: list[int], further: list[tuple[int, int]]
) -> None:
    known = KnownGoals(WORLD, told)
    for state, goal in [(states[0], goals[0]), *further]:
        states, goals = sorted({*states, state}), sorted({*goals, goal})
        asked = np.array(states), Goals.of_states(goals)
        answer = known.of(*asked)
        np.testing.assert_array_equal(answer, told(*asked))
        assert answer.flags.c_contiguous


@given(st.lists(st.integers(0, 300)))
def test_numbers_below_a_bound_are_told_apart_and_sorted(values: list[int]) -> None:
    numbers = np.array(values, dtype=np.int64)
    for bound in (301, 70_000):
        found, index = np.unique(numbers, return_inverse=True)
        np.testing.assert_array_equal(distinct(numbers, bound)[0], found)
        np.testing.assert_array_equal(distinct(numbers, bound)[1], index)
        np.testing.assert_array_equal(
            ascending(numbers, bound), np.argsort(numbers, kind="stable")
        )
