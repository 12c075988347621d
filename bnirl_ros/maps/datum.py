"""Where on the earth a map frame lies: from its metres to longitude and latitude."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError

SEMI_MAJOR_AXIS = 6_378_137.0
"""Of the WGS 84 ellipsoid [m]."""

FLATTENING = 1.0 / 298.257223563
"""Of the WGS 84 ellipsoid."""


@dataclass(frozen=True)
class Datum:
    """Place and direction of a map frame's origin on the WGS 84 ellipsoid.

    It means what the datum of robot_localization's navsat_transform_node does.

    Attributes:
        latitude: north of the equator [degrees].
        longitude: east of Greenwich [degrees].
        yaw: of the frame's x axis, counter-clockwise from east (REP-103) [rad].

    Raises:
        InputError: a number is not finite, or no latitude or longitude.
    """

    latitude: float
    longitude: float
    yaw: float

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, value, limit in (
            ("latitude", self.latitude, 90.0),
            ("longitude", self.longitude, 180.0),
            ("yaw", self.yaw, math.inf),
        ):
            if not math.isfinite(value) or abs(value) > limit:
                words = f"from -{limit:g} to {limit:g}" if limit < math.inf else "a finite number"
                raise InputError(f"datum: the {name} must be {words}, not {value:g}")

    def on_earth(self, positions: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(N, 2) longitude and latitude [degrees] of positions (N, 2) in the map frame [m].

        The map lies in the plane that touches the ellipsoid at its origin. What is a kilometre
        away from there is 8 cm above the ellipsoid, and is taken straight down.
        """
        x, y = np.asarray(positions, dtype=np.float64).reshape(-1, 2).T
        east = x * math.cos(self.yaw) - y * math.sin(self.yaw)
        north = x * math.sin(self.yaw) + y * math.cos(self.yaw)

        # To the coordinates of space, and back to the ellipsoid by B. R. Bowring,
        # Transformation from spatial to geographical coordinates, Survey Review 23 (181), 1976.
        squared = FLATTENING * (2.0 - FLATTENING)  # eccentricity
        semi_minor_axis = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
        latitude, longitude = math.radians(self.latitude), math.radians(self.longitude)
        normal = SEMI_MAJOR_AXIS / math.sqrt(1.0 - squared * math.sin(latitude) ** 2)
        # From the earth's axis in the plane of the datum's meridian, and along the axis.
        outwards = normal * math.cos(latitude) - north * math.sin(latitude)
        upwards = normal * (1.0 - squared) * math.sin(latitude) + north * math.cos(latitude)
        across = np.hypot(outwards, east)
        reduced = np.arctan2(upwards * SEMI_MAJOR_AXIS, across * semi_minor_axis)
        found = np.arctan2(
            upwards + squared / (1.0 - squared) * semi_minor_axis * np.sin(reduced) ** 3,
            across - squared * SEMI_MAJOR_AXIS * np.cos(reduced) ** 3,
        )
        turned = longitude + np.arctan2(east, outwards)
        turned = np.remainder(turned + math.pi, 2.0 * math.pi) - math.pi
        return np.degrees(np.column_stack([turned, found]))
