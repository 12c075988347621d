"""Random draws that several kernels need."""

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
