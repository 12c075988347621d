"""A planning map keeps what a robot can pass, and the walls between where it can."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import label

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap, load_map, parse_text_grid
from bnirl_ros.maps.coarsening import coarsen, with_free

SQUARE = np.ones((3, 3), dtype=bool)


def fine(free: npt.NDArray[np.bool_], resolution: float = 0.1) -> GridMap:
    return GridMap(free, resolution, (1.0, -2.0, 0.3), "plan")


def room_for_disc(grid_map: GridMap, radius: float) -> npt.NDArray[np.bool_]:
    """The cells at whose centres a disc touches no blocked cell, by trying each with each."""
    height, width = grid_map.free.shape
    y, x = np.mgrid[:height, :width]
    room = grid_map.free.copy()
    for blocked_y, blocked_x in np.argwhere(~grid_map.free):
        away = np.hypot(
            np.maximum(np.abs(x - blocked_x) - 0.5, 0), np.maximum(np.abs(y - blocked_y) - 0.5, 0)
        )
        room &= away * grid_map.resolution >= radius
    return room


def joined(free: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """(height, width) numbers of the parts of the free cells joined by their sides; 0: blocked."""
    return label(free)[0]


def with_blocked(shape: tuple[int, int], *cells: tuple[int, int]) -> npt.NDArray[np.bool_]:
    free = np.ones(shape, dtype=np.bool_)
    for x, y in cells:
        free[y, x] = False
    return free


@example(with_blocked((11, 4), (2, 6), (0, 8), (1, 10)), 3.0, 0.15, None)  # beside a free cell
@given(
    free=arrays(
        np.bool_, st.tuples(st.integers(4, 24), st.integers(4, 24)), elements=st.booleans()
    )
    | arrays(np.bool_, (20, 20), elements=st.sampled_from([True] * 9 + [False])),
    ratio=st.sampled_from([2.0, 2.4, 3.0, 5.0]),  # no centre of a finer cell on an edge
    radius=st.sampled_from([0.02, 0.1, 0.15, 0.25]),
    # Where a planning map before it lies [finer cells].
    before=st.none() | st.tuples(*[st.integers(-30, 30)] * 2),
)
def test_whatever_the_disc_can_drive_to_can_be_driven_to(
    free: npt.NDArray[np.bool_], ratio: float, radius: float, before: tuple[int, int] | None
) -> None:
    grid_map = fine(free)
    room = room_for_disc(grid_map, radius)
    assume(room.any())
    if before is None:
        planning = coarsen(grid_map, 0.1 * ratio, radius).grid_map
        assert planning.origin == grid_map.origin
    else:
        ((x, y),) = grid_map.centres_of([np.array(before) - 0.5]).tolist()
        earlier = GridMap(SQUARE, 0.1 * ratio, (x, y, 0.3), "plan")
        planning = coarsen(grid_map, 0.1 * ratio, radius, earlier).grid_map
        assert coarsen(grid_map, 0.1 * ratio, radius, planning).grid_map.is_same_as(planning)
        # Its cells are as before, and it begins in the cell in which the finer one does.
        (corner,) = earlier.coordinates_of([planning.origin[:2]])
        np.testing.assert_allclose(corner, np.rint(corner), atol=1e-6)
        (begins,) = planning.coordinates_of([grid_map.origin[:2]])
        assert (begins > -1e-6).all()
        assert (begins < 1).all()
    assert (planning.resolution, planning.origin[2]) == (0.1 * ratio, 0.3)
    assert planning.frame_id == "plan"
    y, x = np.nonzero(room)
    cells = planning.cells_of(grid_map.centres_of(np.column_stack([x, y])))
    assert planning.contains(cells).all()
    is_free = planning.is_free(cells)
    part = joined(room)[y, x]
    coarse_part = joined(planning.free)
    for number in np.unique(part):
        here = part == number
        if len(np.unique(cells[here], axis=0)) == 1:
            continue  # the disc cannot leave its cell, which may be closed
        kept = cells[here & is_free]
        assert len(kept)
        (in_part,) = np.unique(coarse_part[kept[:, 1], kept[:, 0]])
        # Cells in which the disc can be, though at no centre of a finer one, are free as well.
        free_cells = np.argwhere(coarse_part == in_part)[:, ::-1]
        for closed in cells[here & ~is_free]:
            assert np.abs(free_cells - closed).sum(axis=1).min() == 1


@given(
    width=st.integers(5, 9),
    offset=st.integers(1, 9),
    shift=st.integers(-1, 1),
    ratio=st.sampled_from([4, 5, 6]),
)
def test_a_corridor_that_the_robot_passes_stays_one(
    width: int, offset: int, shift: int, ratio: int
) -> None:
    free = np.zeros((40, 40), dtype=bool)
    for x in range(40):  # it may slant
        low = offset + 10 + shift * (x // 4)
        free[low : low + width, x] = True
    radius = 0.1 * (width - 2) / 2
    planning = coarsen(fine(free), 0.1 * ratio, radius).grid_map
    ends = joined(planning.free)[:, [0, (40 - 1) // ratio]]
    assert set(ends[:, 0][ends[:, 0] > 0]) == set(ends[:, 1][ends[:, 1] > 0])
    assert ends.any()
    # And one that it cannot pass, not even with a cell to spare, is none.
    with pytest.raises(InputError, match="has no place for a robot with a radius of"):
        coarsen(fine(free), 0.1 * ratio, 0.1 * (width + 2) / 2)


@pytest.mark.parametrize("row", range(10, 20))
@pytest.mark.parametrize("thickness", [1, 2])
def test_a_wall_thinner_than_a_cell_stays_closed(row: int, thickness: int) -> None:
    free = np.ones((30, 40), dtype=bool)
    free[row : row + thickness] = False
    coarsened = coarsen(fine(free), 0.5, 0.15)
    assert joined(coarsened.grid_map.free).max() == 2
    assert coarsened.through_walls == 0
    # With a door in it, the rooms are joined there, and there only.
    free[row : row + thickness, 20:24] = True
    planning = coarsen(fine(free), 0.5, 0.15).grid_map
    assert joined(planning.free).max() == 1
    planning.free[:, 3:6] = False
    assert joined(planning.free).max() == 4


def test_walls_that_cells_cannot_show_are_counted() -> None:
    free = np.zeros((10, 40), dtype=bool)
    free[1:5], free[6:9] = True, True  # two corridors in rows of cells side by side
    coarsened = coarsen(fine(free), 0.5, 0.1)
    assert coarsened.grid_map.free[:, 1:-1].all()
    # Of one of the corridors the blind ends are closed, which are next to the rest of it.
    assert np.count_nonzero(~coarsened.grid_map.free) == 2
    assert coarsened.through_walls == 6
    assert coarsen(fine(free), 0.2, 0.1).through_walls == 0


def test_a_map_with_cells_as_large_stays_as_it_is() -> None:
    grid_map = parse_text_grid("..#\n...\n", "test")
    assert coarsen(grid_map, 0.5, 0.3).grid_map is grid_map
    assert coarsen(grid_map, 1.0, 0.3).grid_map is grid_map


def test_open_space_stays_open() -> None:
    planning = coarsen(fine(np.ones((7, 11), dtype=bool)), 0.5, 0.3).grid_map
    assert planning.free.shape == (2, 3)
    assert planning.free.all()


def test_cells_are_opened_on_a_copy() -> None:
    grid_map = parse_text_grid("##.\n", "test")
    opened = with_free(grid_map, [(1, 0)])
    assert opened.free.tolist() == [[False, True, True]]
    assert grid_map.free.tolist() == [[False, False, True]]


@needs_shared_bags
def test_the_depot_has_its_ways() -> None:
    grid_map = load_map(SHARED_BAGS.parent / "maps" / "depot.yaml")
    coarsened = coarsen(grid_map, 0.5, 0.22)
    assert coarsened.grid_map.free.shape == (31, 61)
    parts = joined(coarsened.grid_map.free)
    assert parts[15, 8] == parts[22, 38] == parts[2, 45]  # round the shelves
    assert coarsened.through_walls <= 4
