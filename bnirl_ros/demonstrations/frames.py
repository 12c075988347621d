"""Frames and the transforms between them, as tf tells them, looked up at any time."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.messages import stamp_of

_SECOND = 1e9
_FARTHEST = 1e12  # [m]: the squares of what lies farther away, as some leave it, may overflow


class TransformBuffer:
    """All transforms of a recording, to be looked up once they are all there.

    The graph of frames and the interpolation (along screws, ScLERP) are pytransform3d's. A moving
    transform is known from its first stamp to its last one, as in tf2, and a static one always.

    Attributes:
        faults: how often each fault occurred among the transforms that were refused.
    """

    def __init__(self) -> None:
        """A buffer without a transform."""
        self.faults: Counter[str] = Counter()
        self._moving: dict[tuple[str, str], tuple[array[int], array[float]]] = {}
        self._static: dict[tuple[str, str], npt.NDArray[np.float64]] = {}
        self._manager: Any = None
        self._origin = 0  # the stamp [ns] that is 0 s for the manager: floats hold it exactly

    def add(self, message: Any, static: bool) -> None:
        """Take in a tf2_msgs/TFMessage; `static` tells that it came on /tf_static."""
        self._manager = None
        for transform in message.transforms:
            parent = frame_name(transform.header.frame_id)
            child = frame_name(transform.child_frame_id)
            pq = _pq_of(transform.transform)
            if not np.isfinite(pq).all() or parent == child:
                self.faults["transform that is none"] += 1
                continue
            if static:
                self._static[child, parent] = pq
                continue
            stamps, values = self._moving.setdefault((child, parent), (array("q"), array("d")))
            stamps.append(stamp_of(transform))
            values.extend(pq.tolist())

    @property
    def frames(self) -> list[str]:
        """The frames that occur, sorted."""
        return sorted({frame for edge in (*self._moving, *self._static) for frame in edge})

    def stamps_of(self, frame: str) -> npt.NDArray[np.int64]:
        """(P,) when a frame's place was told [ns], ascending, each once.

        Those of the transform by which it moves: its own, or where that is static its parent's.
        """
        parents = {child: parent for child, parent in self._static}
        seen = set()
        while frame in parents and frame not in seen:
            seen.add(frame)
            frame = parents[frame]
        stamps = [stamps for (child, _), (stamps, _) in self._moving.items() if child == frame]
        return np.unique(np.concatenate([np.asarray(each) for each in stamps] or [[]])).astype(
            np.int64
        )

    def look_up(
        self, target: str, source: str, stamps: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64] | None:
        """Where a frame is in another one.

        Args:
            target: the frame in which the answer is given.
            source: the frame that is looked for.
            stamps: (P,) when [ns].

        Returns:
            (P, 4, 4) homogeneous matrices that take points of `source` to `target`, NaN at times
            of which tf tells nothing; None where no transforms join the frames.
        """
        target, source = frame_name(target), frame_name(source)
        if source == target:
            return np.broadcast_to(np.eye(4), (len(stamps), 4, 4))
        manager = self._joined()
        if not {target, source} <= set(manager.nodes):
            return None
        times = (stamps - self._origin) / _SECOND
        try:
            found = manager.get_transform_at_time(source, target, times)
        except KeyError:
            return None
        return np.broadcast_to(found, (len(stamps), 4, 4))

    def _joined(self) -> Any:
        """The graph of all transforms."""
        if self._manager is not None:
            return self._manager
        from pytransform3d.transform_manager import (
            NumpyTimeseriesTransform,
            StaticTransform,
            TemporalTransformManager,
            TimeVaryingTransform,
        )
        from pytransform3d.transformations import transform_from_pq

        class KnownForATime(TimeVaryingTransform):  # type: ignore[misc]  # Any, for mypy
            """A moving transform that is NaN where it is not known, rather than an error."""

            def __init__(self, time: Any, pqs: Any) -> None:
                self._time = time
                self._series = NumpyTimeseriesTransform(time, pqs)

            def as_matrix(self, query_time: Any) -> Any:
                query = np.atleast_1d(query_time)
                known = (query >= self._time[0]) & (query <= self._time[-1])
                matrices = np.full((len(query), 4, 4), np.nan)
                if known.any():
                    matrices[known] = self._series.as_matrix(query[known])
                return matrices

            def check_transforms(self) -> Any:
                self._series.check_transforms()
                return self

        manager = TemporalTransformManager()
        self._origin = min((min(stamps) for stamps, _ in self._moving.values()), default=0)
        for (child, parent), pq in self._static.items():
            manager.add_transform(child, parent, StaticTransform(transform_from_pq(pq)))
        for (child, parent), (stamps, values) in self._moving.items():
            stamp, first = np.unique(np.asarray(stamps), return_index=True)
            pqs = np.asarray(values).reshape(-1, 7)[first]
            time = (stamp - self._origin) / _SECOND
            manager.add_transform(child, parent, KnownForATime(time, pqs))
        self._manager = manager
        return manager


def matrix_of(transform: Any) -> npt.NDArray[np.float64]:
    """The homogeneous matrix (4, 4) of a geometry_msgs/Transform; NaN where that is none."""
    from pytransform3d.transformations import transform_from_pq

    pq = _pq_of(transform)
    return transform_from_pq(pq) if np.isfinite(pq).all() else np.full((4, 4), np.nan)


def moved(
    matrices: npt.NDArray[np.float64],
    points: npt.NDArray[np.float64],
    headings: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """(P, 3) x, y [m] and heading [rad] of poses after a transform each.

    Args:
        matrices: (P, 4, 4) homogeneous.
        points: (P, 4) homogeneous [m].
        headings: (P,) [rad].
    """
    positions = np.einsum("pij,pj->pi", matrices, points)
    ahead = np.column_stack([np.cos(headings), np.sin(headings)])
    turned = np.einsum("pij,pj->pi", matrices[:, :2, :2], ahead)
    return np.column_stack([positions[:, :2], np.arctan2(turned[:, 1], turned[:, 0])])


def _pq_of(transform: Any) -> npt.NDArray[np.float64]:
    """(7,) position and unit quaternion, real part first; not finite where there is none."""
    shift, turn = transform.translation, transform.rotation
    pq = np.array([shift.x, shift.y, shift.z, turn.w, turn.x, turn.y, turn.z])
    length = math.hypot(*pq[3:])
    pq[3:] = pq[3:] / length if 1e-6 <= length < math.inf else math.nan
    pq[:3][np.abs(pq[:3]) > _FARTHEST] = math.nan
    return pq


def frame_name(name: str) -> str:
    """The name of a frame without the leading slash that old programs write."""
    return name.removeprefix("/")
