//! The types that all crates of VIDAR share, without any input or output.
//!
//! The stage crates depend on this crate and not on each other.
//!
//! Conventions, written once and used everywhere:
//! - **Frames.** `a_from_b` maps coordinates in *b* to coordinates in *a*: `p_in_a = a_from_b * p_in_b`.
//! - **Axes.** World: right-handed, z up, gravity (0, 0, −9.81) m/s². Body = IMU. Camera: x right, y down, z forward.
//! - **Pixels.** The centre of the top-left pixel is (0, 0).
//! - **Depth.** z-depth in metres, `f32`; invalid = NaN.
//! - **Units.** SI and radians; a scalar in another unit says so in its name. Time is integer nanoseconds.
//! - **Perturbation.** Right: `T ⊞ δ = T · exp(δ)`, tangent order [rotation, translation, log-scale].
//!
//! `docs/concepts/frames-and-units.md` explains them with the conversions to other programs' conventions.
//!
//! # Example
//!
//! Projects a point of the world into a camera that is mounted on a moving body.
//!
//! ```
//! use nalgebra::{Matrix3, Vector3};
//! use vidar_core::{
//!     BodyFrame, CameraId, CameraModel, Duration, Pinhole, Rig, RigCamera, Se3, So3, StampedPose, Timestamp, Trajectory,
//! };
//!
//! // A camera 10 cm ahead of the IMU that looks along the body's x axis (x ahead, y left, z up).
//! let model = CameraModel::Pinhole(Pinhole::new(400.0, 400.0, 319.5, 239.5, 640, 480)?);
//! let columns = [-Vector3::y(), -Vector3::z(), Vector3::x()]; // the camera's x, y, z in the body
//! let body_from_camera_rotation = So3::from_matrix(&Matrix3::from_columns(&columns)).ok_or("not a rotation")?;
//! let body_from_camera = Se3::new(body_from_camera_rotation, Vector3::new(0.1, 0.0, 0.0));
//! let camera = RigCamera { model, body_from_camera, time_offset: Duration::ZERO, rate_hz: None };
//! let rig = Rig { cameras: vec![camera], imu: None };
//!
//! // The body flies 1 m ahead in 50 ms.
//! let start = Timestamp::parse_secs("1403636580.838555648")?;
//! let pose = |millis, x| StampedPose {
//!     time: start + Duration::from_millis(millis),
//!     world_from_body: Se3::from_translation(Vector3::new(x, 0.0, 1.0)),
//! };
//! let flight = Trajectory::new(BodyFrame::Imu, vec![pose(0, 0.0), pose(50, 1.0)])?;
//!
//! // The camera's pose half way: p_in_camera = world_from_camera⁻¹ · p_in_world.
//! let camera_flight = flight.in_frame(BodyFrame::Camera(CameraId(0)), &rig)?;
//! let half_way = start + Duration::from_millis(25);
//! let world_from_camera =
//!     camera_flight.interpolate(half_way, Duration::from_millis(50)).ok_or("outside the flight")?;
//! let point_in_world = Vector3::new(4.6, -1.0, 1.5);
//! let point_in_camera = vidar_core::LieGroup::inverse(&world_from_camera) * point_in_world;
//!
//! // 4 m ahead of the camera, 1 m to its right, 0.5 m above.
//! assert!((point_in_camera - Vector3::new(1.0, -0.5, 4.0)).norm() < 1e-12);
//! let pixel = rig.cameras[0].model.project(&point_in_camera).ok_or("not in front")?;
//! assert!((pixel.x - 419.5).abs() < 1e-9 && (pixel.y - 189.5).abs() < 1e-9);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod camera;
pub mod geometry;
pub mod id;
pub mod image;
pub mod lie;
pub mod model;
pub mod odometry;
pub mod origin;
pub mod printable;
pub mod procrustes;
pub mod random;
pub mod remap;
pub mod rig;
pub mod sensor;
pub mod simd;
pub mod surface;
mod svd3;
pub mod testing;
pub mod time;
pub mod trajectory;
pub mod umeyama;
pub mod warning;

pub use camera::{CameraError, CameraModel, LensMotion, ParametricCamera, Pinhole};
pub use geometry::{AlignedView, Confidence, GeometryError, MetricDepth, RelativeDepth};
pub use id::{CameraId, ChunkId, FrameId, KeyframeId, LandmarkId};
pub use image::{FrameImage, Image, ImageError};
pub use lie::{LieGroup, Se3, Sim3, So3};
pub use model::{
    ChunkView, ChunkViews, GeometryModel, GeometryPrediction, ModelError, ModelInfo, ViewGeometry, Watch,
};
pub use odometry::{
    Health, NavCovariance, NavState, OdometryKeyframe, PoseCovariance, RevisedPose, SparseLandmark,
};
pub use origin::{DepthOrigin, DepthSource};
pub use printable::{printable, printable_json, printable_lines};
pub use procrustes::{NearestRotation, nearest_rotation};
pub use rig::{ImuNoise, Rig, RigCamera};
pub use sensor::{AngularRate, Frame, ImuSample, SensorEvent, SpecificForce, TimedVector, merge_imu};
pub use surface::{PointCloud, TexturedMesh, TriangleMesh};
pub use time::{Duration, TimeError, Timestamp};
pub use trajectory::{BodyFrame, StampedPose, Trajectory, TrajectoryError};
pub use umeyama::{UmeyamaError, umeyama_se3, umeyama_sim3, umeyama_sim3_weighted};
pub use warning::{Severity, Warning};

/// Standard gravity magnitude used for synthetic data, m/s².
pub const GRAVITY_MPS2: f64 = 9.81;
