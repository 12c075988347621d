"""The messages that are shown and recorded, as dataclasses with the ROS messages' field names.

What a field means is said in `msg_schemas/`; the defaults are ROS's. One generic function encodes
them for a bag and one fills rclpy's messages from them, so names and order must match: a test
holds them equal to the installed definitions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import ClassVar

import numpy as np
import numpy.typing as npt


def _no_bytes() -> npt.NDArray[np.uint8]:
    return np.zeros(0, dtype=np.uint8)


def _no_cells() -> npt.NDArray[np.int8]:
    return np.zeros(0, dtype=np.int8)


def _no_covariance() -> npt.NDArray[np.float64]:
    return np.zeros(36)


class Message:
    """A message: equal to another one of its type where all fields are, arrays by their values."""

    TYPE: ClassVar[str]
    __hash__ = None  # type: ignore[assignment]  # its fields can be changed

    def __eq__(self, other: object) -> bool:
        """Whether the other is of the same type and all fields are equal."""
        if type(self) is not type(other):
            return NotImplemented
        return all(
            np.array_equal(mine, yours) if isinstance(mine, np.ndarray) else mine == yours
            for mine, yours in (
                (getattr(self, each.name), getattr(other, each.name))
                for each in fields(self)  # type: ignore[arg-type]  # only dataclasses derive
            )
        )


@dataclass(eq=False)
class Time(Message):
    """builtin_interfaces/msg/Time: seconds and nanoseconds since the clock's epoch."""

    TYPE: ClassVar[str] = "builtin_interfaces/msg/Time"
    sec: int = 0
    nanosec: int = 0


@dataclass(eq=False)
class Duration(Message):
    """builtin_interfaces/msg/Duration: seconds and nanoseconds."""

    TYPE: ClassVar[str] = "builtin_interfaces/msg/Duration"
    sec: int = 0
    nanosec: int = 0


@dataclass(eq=False)
class Header(Message):
    """std_msgs/msg/Header: when, and in which frame."""

    TYPE: ClassVar[str] = "std_msgs/msg/Header"
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass(eq=False)
class ColorRGBA(Message):
    """std_msgs/msg/ColorRGBA: red, green, blue and opacity, each from 0 to 1."""

    TYPE: ClassVar[str] = "std_msgs/msg/ColorRGBA"
    r: float = 0.0
    g: float = 0.0
    b: float = 0.0
    a: float = 0.0


@dataclass(eq=False)
class Point(Message):
    """geometry_msgs/msg/Point [m]."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Point"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(eq=False)
class Vector3(Message):
    """geometry_msgs/msg/Vector3: a direction with a length."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Vector3"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(eq=False)
class Vector3Stamped(Message):
    """geometry_msgs/msg/Vector3Stamped."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Vector3Stamped"
    header: Header = field(default_factory=Header)
    vector: Vector3 = field(default_factory=Vector3)


@dataclass(eq=False)
class Twist(Message):
    """geometry_msgs/msg/Twist: velocities along [m/s] and about [rad/s] the body's axes."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Twist"
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass(eq=False)
class Quaternion(Message):
    """geometry_msgs/msg/Quaternion: a rotation, by default none."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Quaternion"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(eq=False)
class Pose(Message):
    """geometry_msgs/msg/Pose: position [m] and orientation."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Pose"
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(eq=False)
class PoseStamped(Message):
    """geometry_msgs/msg/PoseStamped."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseStamped"
    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass(eq=False)
class PoseWithCovariance(Message):
    """geometry_msgs/msg/PoseWithCovariance; `covariance` (36,) is a 6 x 6 matrix by rows."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose = field(default_factory=Pose)
    covariance: npt.NDArray[np.float64] = field(default_factory=_no_covariance)


@dataclass(eq=False)
class PoseWithCovarianceStamped(Message):
    """geometry_msgs/msg/PoseWithCovarianceStamped."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovarianceStamped"
    header: Header = field(default_factory=Header)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass(eq=False)
class TwistStamped(Message):
    """geometry_msgs/msg/TwistStamped."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TwistStamped"
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass(eq=False)
class TwistWithCovariance(Message):
    """geometry_msgs/msg/TwistWithCovariance; `covariance` (36,) is a 6 x 6 matrix by rows."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TwistWithCovariance"
    twist: Twist = field(default_factory=Twist)
    covariance: npt.NDArray[np.float64] = field(default_factory=_no_covariance)


@dataclass(eq=False)
class Odometry(Message):
    """nav_msgs/msg/Odometry: the pose of a child frame in the header's frame, and its velocity."""

    TYPE: ClassVar[str] = "nav_msgs/msg/Odometry"
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass(eq=False)
class Transform(Message):
    """geometry_msgs/msg/Transform: a shift [m] and a rotation."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Transform"
    translation: Vector3 = field(default_factory=Vector3)
    rotation: Quaternion = field(default_factory=Quaternion)


@dataclass(eq=False)
class TransformStamped(Message):
    """geometry_msgs/msg/TransformStamped: where a child frame is in the header's frame."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TransformStamped"
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    transform: Transform = field(default_factory=Transform)


@dataclass(eq=False)
class TFMessage(Message):
    """tf2_msgs/msg/TFMessage."""

    TYPE: ClassVar[str] = "tf2_msgs/msg/TFMessage"
    transforms: list[TransformStamped] = field(default_factory=list)


@dataclass(eq=False)
class CompressedImage(Message):
    """sensor_msgs/msg/CompressedImage; here only a part of Marker."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CompressedImage"
    header: Header = field(default_factory=Header)
    format: str = ""
    data: npt.NDArray[np.uint8] = field(default_factory=_no_bytes)


@dataclass(eq=False)
class UVCoordinate(Message):
    """visualization_msgs/msg/UVCoordinate: a place on a texture, each from 0 to 1."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/UVCoordinate"
    u: float = 0.0
    v: float = 0.0


@dataclass(eq=False)
class MeshFile(Message):
    """visualization_msgs/msg/MeshFile."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/MeshFile"
    filename: str = ""
    data: npt.NDArray[np.uint8] = field(default_factory=_no_bytes)


@dataclass(eq=False)
class Marker(Message):
    """visualization_msgs/msg/Marker: one thing drawn by RViz or Foxglove, keyed by (ns, id)."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/Marker"

    ARROW: ClassVar[int] = 0
    CUBE: ClassVar[int] = 1
    SPHERE: ClassVar[int] = 2
    CYLINDER: ClassVar[int] = 3
    LINE_STRIP: ClassVar[int] = 4
    LINE_LIST: ClassVar[int] = 5
    CUBE_LIST: ClassVar[int] = 6
    SPHERE_LIST: ClassVar[int] = 7
    POINTS: ClassVar[int] = 8
    TEXT_VIEW_FACING: ClassVar[int] = 9
    MESH_RESOURCE: ClassVar[int] = 10
    TRIANGLE_LIST: ClassVar[int] = 11
    ARROW_STRIP: ClassVar[int] = 12

    ADD: ClassVar[int] = 0
    MODIFY: ClassVar[int] = 0
    DELETE: ClassVar[int] = 2
    DELETEALL: ClassVar[int] = 3

    header: Header = field(default_factory=Header)
    ns: str = ""
    id: int = 0
    type: int = 0
    action: int = 0
    pose: Pose = field(default_factory=Pose)
    scale: Vector3 = field(default_factory=Vector3)
    color: ColorRGBA = field(default_factory=ColorRGBA)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: list[Point] = field(default_factory=list)
    colors: list[ColorRGBA] = field(default_factory=list)
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: list[UVCoordinate] = field(default_factory=list)
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@dataclass(eq=False)
class MarkerArray(Message):
    """visualization_msgs/msg/MarkerArray."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/MarkerArray"
    markers: list[Marker] = field(default_factory=list)


@dataclass(eq=False)
class MapMetaData(Message):
    """nav_msgs/msg/MapMetaData: the grid's resolution [m], its size in cells, and its origin."""

    TYPE: ClassVar[str] = "nav_msgs/msg/MapMetaData"
    map_load_time: Time = field(default_factory=Time)
    resolution: float = 0.0
    width: int = 0
    height: int = 0
    origin: Pose = field(default_factory=Pose)


@dataclass(eq=False)
class OccupancyGrid(Message):
    """nav_msgs/msg/OccupancyGrid: `data` (height * width) int8, row by row from the lower left."""

    TYPE: ClassVar[str] = "nav_msgs/msg/OccupancyGrid"
    header: Header = field(default_factory=Header)
    info: MapMetaData = field(default_factory=MapMetaData)
    data: npt.NDArray[np.int8] = field(default_factory=_no_cells)


@dataclass(eq=False)
class Path(Message):
    """nav_msgs/msg/Path: poses in the order in which they are to be visited."""

    TYPE: ClassVar[str] = "nav_msgs/msg/Path"
    header: Header = field(default_factory=Header)
    poses: list[PoseStamped] = field(default_factory=list)


@dataclass(eq=False)
class KeyValue(Message):
    """diagnostic_msgs/msg/KeyValue."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/KeyValue"
    key: str = ""
    value: str = ""


@dataclass(eq=False)
class DiagnosticStatus(Message):
    """diagnostic_msgs/msg/DiagnosticStatus; `level` is a number (rclpy has one byte instead)."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticStatus"

    OK: ClassVar[int] = 0
    WARN: ClassVar[int] = 1
    ERROR: ClassVar[int] = 2
    STALE: ClassVar[int] = 3

    level: int = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: list[KeyValue] = field(default_factory=list)


@dataclass(eq=False)
class DiagnosticArray(Message):
    """diagnostic_msgs/msg/DiagnosticArray."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticArray"
    header: Header = field(default_factory=Header)
    status: list[DiagnosticStatus] = field(default_factory=list)


MESSAGE_TYPES: dict[str, type[Message]] = {kind.TYPE: kind for kind in Message.__subclasses__()}
"""Every message type above by its name."""
