"""One camera and an IMU into a metric dense 3-D map.

Conventions: `a_from_b` maps coordinates in b to coordinates in a; metres, seconds (times are int nanoseconds), radians; the
camera looks along z, x right, y down; pixel (0, 0) is the centre of the top-left pixel; depth is z, not ray length.
Docstrings are those of the module: `help(vidar.Recording)`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Optional, Union, final

import numpy as np
import numpy.typing as npt

_Path = Union[str, PathLike[str]]
_Paths = Union[_Path, Sequence[_Path]]
_Settings = Optional[Mapping[str, Any]]
_Progress = Optional[Callable[[dict[str, Any]], Any]]
_F32 = npt.NDArray[np.float32]
_F64 = npt.NDArray[np.float64]
_I64 = npt.NDArray[np.int64]
_U8 = npt.NDArray[np.uint8]
_U32 = npt.NDArray[np.uint32]

__version__: str

class VidarError(Exception):
    """An error of VIDAR, with the codes of the command line (`vidar explain E0208`)."""

    code: str
    message: str
    where: Optional[str]
    hint: Optional[str]
    exit_status: int

@final
class Frame:
    def __init__(self, frame: int, time_ns: int, pixels: npt.NDArray[Any], *, camera: int = 0) -> None: ...
    @property
    def frame(self) -> int: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def time(self) -> float: ...
    @property
    def camera(self) -> int: ...
    @property
    def pixels(self) -> npt.NDArray[Any]: ...

@final
class ImuSample:
    def __init__(self, time_ns: int, gyro: npt.ArrayLike, accel: npt.ArrayLike) -> None: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def time(self) -> float: ...
    @property
    def gyro(self) -> _F64: ...
    @property
    def accel(self) -> _F64: ...

@final
class DepthImage:
    @property
    def time_ns(self) -> int: ...
    @property
    def camera(self) -> int: ...
    @property
    def depth(self) -> _F32: ...

@final
class GroundTruth:
    @property
    def time_ns(self) -> int: ...
    @property
    def world_from_body(self) -> _F64: ...

_Event = Union[Frame, ImuSample, DepthImage, GroundTruth]

@final
class Camera:
    def __init__(
        self,
        model: str,
        width: int,
        height: int,
        *,
        body_from_camera: Optional[npt.ArrayLike] = None,
        time_offset: float = 0.0,
    ) -> None: ...
    @property
    def model(self) -> str: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def parameters(self) -> dict[str, float]: ...
    @property
    def matrix(self) -> _F64: ...
    @property
    def body_from_camera(self) -> _F64: ...
    @property
    def time_offset(self) -> float: ...

@final
class ImuNoise:
    def __init__(
        self,
        gyro_noise_density: float,
        gyro_random_walk: float,
        accel_noise_density: float,
        accel_random_walk: float,
        rate_hz: float,
    ) -> None: ...

@final
class Recording:
    def __init__(
        self,
        path: _Path,
        *,
        format: Optional[str] = None,
        camera: Optional[int] = None,
        calibration: Optional[_Paths] = None,
        topics: Union[None, str, Sequence[str]] = None,
        camera_model: Optional[str] = None,
        trajectory: Optional[_Path] = None,
        trajectory_format: Optional[str] = None,
        trajectory_body: Optional[str] = None,
        imu: Optional[_Paths] = None,
        timestamps: Optional[_Path] = None,
        time_unit: Optional[str] = None,
        depth_intrinsics: Optional[Sequence[float]] = None,
        depth_scale: Optional[float] = None,
        color_from_depth: Optional[npt.ArrayLike] = None,
        decoder: Optional[str] = None,
        start: Optional[float] = None,
        end: Optional[float] = None,
        stride: Optional[int] = None,
        preset: Optional[str] = None,
        config: Optional[_Path] = None,
        settings: _Settings = None,
    ) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def reason(self) -> str: ...
    @property
    def streams(self) -> list[dict[str, Any]]: ...
    @property
    def duration(self) -> float: ...
    @property
    def camera(self) -> int: ...
    @property
    def cameras(self) -> list[Camera]: ...
    @property
    def imu_noise(self) -> Optional[dict[str, float]]: ...
    @property
    def calibration(self) -> str: ...
    @property
    def readout(self) -> Optional[float]: ...
    @property
    def image_times_ns(self) -> _I64: ...
    @property
    def imu(self) -> tuple[_I64, _F64, _F64]: ...
    @property
    def ground_truth(self) -> Optional[Trajectory]: ...
    @property
    def trajectory(self) -> Optional[Trajectory]: ...
    @property
    def reference_cloud(self) -> Optional[Path]: ...
    @property
    def warnings(self) -> list[dict[str, Any]]: ...
    def image(self, index: int) -> Frame: ...
    def __iter__(self) -> Iterator[_Event]: ...

@final
class Odometry:
    def __init__(
        self,
        camera: Camera,
        imu: Optional[ImuNoise] = None,
        *,
        preset: Optional[str] = None,
        config: Optional[_Path] = None,
        settings: _Settings = None,
    ) -> None: ...
    @classmethod
    def of(
        cls,
        recording: Recording,
        *,
        preset: Optional[str] = None,
        config: Optional[_Path] = None,
        settings: _Settings = None,
    ) -> Odometry: ...
    def push(self, event: _Event) -> Optional[State]: ...
    def finish(self) -> list[State]: ...
    @property
    def counts(self) -> dict[str, int]: ...

@final
class State:
    @property
    def frame(self) -> int: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def time(self) -> float: ...
    @property
    def status(self) -> str: ...
    @property
    def health(self) -> str: ...
    @property
    def is_metric(self) -> bool: ...
    @property
    def reason(self) -> Optional[str]: ...
    @property
    def segment(self) -> Optional[int]: ...
    @property
    def world_from_body(self) -> Optional[_F64]: ...
    @property
    def velocity(self) -> Optional[_F64]: ...
    @property
    def gyro_bias(self) -> Optional[_F64]: ...
    @property
    def accel_bias(self) -> Optional[_F64]: ...
    @property
    def covariance(self) -> Optional[_F64]: ...
    @property
    def scale_std(self) -> Optional[float]: ...
    @property
    def is_keyframe(self) -> bool: ...
    @property
    def landmarks(self) -> Optional[_F64]: ...

@final
class Trajectory:
    def __init__(self, times_ns: npt.NDArray[np.int64], world_from_body: npt.ArrayLike, *, body: str = "imu") -> None: ...
    @classmethod
    def read(
        cls,
        path: _Path,
        *,
        trajectory_format: Optional[str] = None,
        trajectory_body: Optional[str] = None,
        time_unit: Optional[str] = None,
        timestamps: Optional[_Path] = None,
    ) -> Trajectory: ...
    def write(self, path: _Path, format: str = "tum") -> None: ...
    @property
    def body(self) -> str: ...
    @property
    def times_ns(self) -> _I64: ...
    @property
    def world_from_body(self) -> _F64: ...
    @property
    def positions(self) -> _F64: ...
    @property
    def quaternions_xyzw(self) -> _F64: ...
    @property
    def length(self) -> float: ...
    def __len__(self) -> int: ...

@final
class Alignment:
    @property
    def scale(self) -> float: ...
    @property
    def rotation(self) -> _F64: ...
    @property
    def translation(self) -> _F64: ...
    @property
    def matrix(self) -> _F64: ...
    @property
    def pairs(self) -> int: ...
    @property
    def rmse(self) -> float: ...
    def apply(self, points: npt.ArrayLike) -> _F64: ...

@final
class DepthAnything3:
    def __init__(
        self,
        model: str = "da3-nano",
        *,
        model_dir: Optional[_Path] = None,
        device: str = "cpu",
        precision: str = "auto",
    ) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def is_any_view(self) -> bool: ...
    @property
    def compute(self) -> str: ...
    def predict(
        self,
        images: Union[Sequence[_U8], _U8],
        *,
        world_from_camera: Optional[npt.ArrayLike] = None,
        intrinsics: Optional[npt.ArrayLike] = None,
        process_size: Optional[int] = None,
    ) -> DepthPrediction: ...

@final
class DepthPrediction:
    @property
    def depth(self) -> _F32: ...
    @property
    def confidence(self) -> Optional[_F32]: ...
    @property
    def world_from_camera(self) -> Optional[_F64]: ...
    @property
    def intrinsics(self) -> Optional[_F64]: ...
    @property
    def images(self) -> _U8: ...
    @property
    def is_metric(self) -> bool: ...

@final
class Mesh:
    def __init__(
        self,
        vertices: _F32,
        triangles: _U32,
        *,
        normals: Optional[_F32] = None,
        colors: Optional[_U8] = None,
        confidence: Optional[_F32] = None,
    ) -> None: ...
    @classmethod
    def read(cls, path: _Path) -> Mesh: ...
    def write(self, path: _Path) -> None: ...
    @property
    def vertices(self) -> _F32: ...
    @property
    def triangles(self) -> _U32: ...
    @property
    def normals(self) -> Optional[_F32]: ...
    @property
    def colors(self) -> Optional[_U8]: ...
    @property
    def confidence(self) -> Optional[_F32]: ...

@final
class PointCloud:
    def __init__(
        self,
        positions: _F32,
        *,
        normals: Optional[_F32] = None,
        colors: Optional[_U8] = None,
        confidence: Optional[_F32] = None,
    ) -> None: ...
    @classmethod
    def read(cls, path: _Path) -> PointCloud: ...
    def write(self, path: _Path) -> None: ...
    @property
    def positions(self) -> _F32: ...
    @property
    def normals(self) -> Optional[_F32]: ...
    @property
    def colors(self) -> Optional[_U8]: ...
    @property
    def confidence(self) -> Optional[_F32]: ...
    def __len__(self) -> int: ...

@final
class Evaluation:
    @property
    def kind(self) -> str: ...
    @property
    def scores(self) -> dict[str, float]: ...
    @property
    def report(self) -> dict[str, Any]: ...
    @property
    def warnings(self) -> list[dict[str, Any]]: ...

@final
class Run:
    @property
    def folder(self) -> Path: ...
    @property
    def manifest(self) -> dict[str, Any]: ...
    @property
    def exit_status(self) -> Optional[int]: ...
    @property
    def metrics(self) -> dict[str, Any]: ...
    @property
    def scores(self) -> dict[str, float]: ...
    @property
    def trajectory(self) -> Optional[Trajectory]: ...
    @property
    def keyframes(self) -> Optional[Trajectory]: ...
    @property
    def mesh(self) -> Mesh: ...
    @property
    def points(self) -> PointCloud: ...
    @property
    def views(self) -> list[View]: ...
    def export(
        self,
        to: str,
        output: _Path,
        *,
        tracks: bool = False,
        input_size: bool = False,
        texture_px: int | None = None,
    ) -> list[Path]: ...

@final
class View:
    @property
    def frame(self) -> int: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def world_from_camera(self) -> _F64: ...
    @property
    def intrinsics(self) -> _F64: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def image_path(self) -> Optional[Path]: ...
    @property
    def depth(self) -> _F32: ...

def align(
    source: Union[Trajectory, npt.ArrayLike],
    target: Union[Trajectory, npt.ArrayLike],
    *,
    scale: bool = True,
    weights: Optional[npt.ArrayLike] = None,
    max_time_difference: float = 0.01,
) -> Alignment: ...
def fuse(
    depth: _F32,
    world_from_camera: npt.ArrayLike,
    intrinsics: npt.ArrayLike,
    *,
    confidence: Optional[_F32] = None,
    colors: Optional[_U8] = None,
    progress: _Progress = None,
    preset: Optional[str] = None,
    config: Optional[_Path] = None,
    settings: _Settings = None,
) -> Mesh: ...
def evaluate(
    estimate: Union[Trajectory, Mesh, PointCloud, npt.ArrayLike, _Path],
    truth: Union[None, Trajectory, Mesh, PointCloud, npt.ArrayLike, _Path] = None,
    *,
    trajectory_format: Optional[str] = None,
    trajectory_body: Optional[str] = None,
    time_unit: Optional[str] = None,
    timestamps: Optional[_Path] = None,
    preset: Optional[str] = None,
    config: Optional[_Path] = None,
    settings: _Settings = None,
) -> Evaluation: ...
def run(
    path: _Path,
    output: Optional[_Path] = None,
    *,
    reference: Optional[_Path] = None,
    mcap: Optional[_Path] = None,
    force: bool = False,
    resume: bool = False,
    progress: _Progress = None,
    geometry: Optional[str] = None,
    mode: Optional[str] = None,
    model_dir: Optional[_Path] = None,
    device: Optional[str] = None,
    map: Optional[_Path] = None,
    format: Optional[str] = None,
    camera: Optional[int] = None,
    calibration: Optional[_Paths] = None,
    topics: Union[None, str, Sequence[str]] = None,
    camera_model: Optional[str] = None,
    trajectory: Optional[_Path] = None,
    trajectory_format: Optional[str] = None,
    trajectory_body: Optional[str] = None,
    imu: Optional[_Paths] = None,
    timestamps: Optional[_Path] = None,
    time_unit: Optional[str] = None,
    depth_intrinsics: Optional[Sequence[float]] = None,
    depth_scale: Optional[float] = None,
    color_from_depth: Optional[npt.ArrayLike] = None,
    decoder: Optional[str] = None,
    start: Optional[float] = None,
    end: Optional[float] = None,
    stride: Optional[int] = None,
    preset: Optional[str] = None,
    config: Optional[_Path] = None,
    settings: _Settings = None,
) -> Run: ...
def read_run(folder: _Path) -> Run: ...
