"""Small kernels that several samplers need.

For an argument that is a literal, or a variable that begins as one, numba compiles a kernel once
more, with all that it calls: numbers that are handed to large kernels are np.int64 from the start.
"""

from __future__ import annotations

from numba import njit


@njit(nogil=True, cache=True)
def categorical(weights, total, generator):  # type: ignore[no-untyped-def]
    """Index drawn with probability weights / total; never one of weight zero."""
    remaining = generator.random() * total
    last = 0
    for index in range(weights.shape[0]):
        if weights[index] > 0.0:
            last = index
            remaining -= weights[index]
            if remaining < 0.0:
                break
    return last


@njit(nogil=True, cache=True)
def number_in_order(labels, scratch):  # type: ignore[no-untyped-def]
    """Number labels (N,) below N from 0 in the order in which they first occur, in place.

    Negative ones stay as they are. `scratch` (N,) is overwritten.
    """
    scratch[:] = -1
    count = 0
    for index in range(labels.shape[0]):
        label = labels[index]
        if label >= 0:
            if scratch[label] < 0:
                scratch[label] = count
                count += 1
            labels[index] = scratch[label]


@njit(nogil=True, cache=True)
def count_draws(counts, subgoal_of, switched, sign):  # type: ignore[no-untyped-def]
    """Add the draws of a sequence to counts (G,), or with sign -1 take them out."""
    for index in range(subgoal_of.shape[0]):
        if switched[index]:
            counts[subgoal_of[index]] += sign
