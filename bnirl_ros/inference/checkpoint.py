"""The state of running chains as bytes, so that another process can go on with them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.partition_gibbs import PartitionState
from bnirl_ros.inference.pursuit_gibbs import PursuitState
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap

FORMAT = 1
"""Of the bytes; to be raised with any change of them, of the states or of their meaning."""

_FIRST_LINE = re.compile(rb"bnirl_ros checkpoint (\d{1,9}) ([0-9a-f]{64})\n")
_STATES: dict[str, Any] = {"sequential": PursuitState, "paper": PartitionState}


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Chains, and what they are the chains of.

    Attributes:
        map_digest: `digest_of` the map.
        settings: of the inference.
        demonstration: the N observations.
        poses: (N,) index of each observation among the recording's poses.
        last_poses: (L,) the same of each last pose.
        states: of the chains, as the model's sampler has them.
        generators: the state of each chain's random numbers.
    """

    map_digest: str
    settings: Settings
    demonstration: Demonstration
    poses: npt.NDArray[np.int64]
    last_poses: npt.NDArray[np.int64]
    states: tuple[Any, ...]
    generators: tuple[dict[str, Any], ...]

    def to_bytes(self) -> bytes:
        """What `checkpoint_from` reads: a line with a digest of what follows, and an .npz."""
        known = {
            "map": self.map_digest,
            "settings": asdict(self.settings),
            "generators": self.generators,
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            "known": np.frombuffer(json.dumps(known).encode(), dtype=np.uint8),
            "poses": self.poses,
            "last_poses": self.last_poses,
            **vars(self.demonstration),
        }
        for chain, state in enumerate(self.states):
            arrays |= {f"{chain}.{name}": values for name, values in state._asdict().items()}
        buffer = BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        content = buffer.getvalue()
        digest = hashlib.sha256(content).hexdigest()
        return f"bnirl_ros checkpoint {FORMAT} {digest}\n".encode() + content


def checkpoint_from(data: bytes, source: str) -> Checkpoint:
    """A checkpoint as `Checkpoint.to_bytes` wrote it; nothing is made of what others wrote.

    Args:
        data: the bytes.
        source: the file, for the error's sentence.

    Raises:
        InputError: they are no checkpoint, one of another version, or not whole.
    """
    first = _FIRST_LINE.match(data)
    if first is None:
        raise InputError(f"{source}: is no checkpoint of bnirl_ros; the chains start anew")
    if int(first[1]) != FORMAT:
        raise InputError(
            f"{source}: has the format {int(first[1])} where this version of bnirl_ros knows "
            f"{FORMAT} alone; the chains start anew"
        )
    content = data[first.end() :]
    if hashlib.sha256(content).hexdigest().encode() != first[2]:
        raise InputError(f"{source}: is damaged, as its digest tells; the chains start anew")
    with np.load(BytesIO(content), allow_pickle=False) as file:
        arrays = dict(file)
    return _checkpoint_of(arrays)


def _checkpoint_of(arrays: Mapping[str, npt.NDArray[Any]]) -> Checkpoint:
    known = json.loads(arrays["known"].tobytes())
    settings = Settings(**known["settings"])
    kind = _STATES[settings.model]
    fields = Demonstration.__dataclass_fields__
    return Checkpoint(
        map_digest=known["map"],
        settings=settings,
        demonstration=Demonstration(**{name: arrays[name] for name in fields}),
        poses=arrays["poses"],
        last_poses=arrays["last_poses"],
        states=tuple(
            kind(**{name: arrays[f"{chain}.{name}"] for name in kind._fields})
            for chain in range(len(known["generators"]))
        ),
        generators=tuple(known["generators"]),
    )


def digest_of(grid_map: GridMap) -> str:
    """What tells a map, with its features, from all others."""
    features = grid_map.features
    digest = hashlib.sha256(
        repr(
            (grid_map.free.shape, grid_map.resolution, grid_map.origin, grid_map.frame_id)
        ).encode()
    )
    digest.update(np.packbits(grid_map.free).tobytes())
    if features is not None:
        digest.update(repr((features.coordinates.shape, sorted(features.names.items()))).encode())
        digest.update(np.ascontiguousarray(features.coordinates).tobytes())
        digest.update(np.packbits(features.known).tobytes())
    return digest.hexdigest()
