//! VIDAR's shared vocabulary, without any input or output.
//!
//! Every crate of the workspace speaks in these types, and the stage crates know nothing else of each other.
//!
//! Conventions, written once and used everywhere:
//! - **Frames.** `a_from_b` maps coordinates in *b* to coordinates in *a*: `p_in_a = a_from_b * p_in_b`.
//! - **Axes.** World: right-handed, z up, gravity (0, 0, −9.81) m/s². Body = IMU. Camera: x right, y down, z forward.
//! - **Pixels.** The centre of the top-left pixel is (0, 0).
//! - **Depth.** z-depth in metres, `f32`; invalid = NaN.
//! - **Units.** SI and radians; a scalar in another unit says so in its name. Time is integer nanoseconds.
//! - **Perturbation.** Right: `T ⊞ δ = T · exp(δ)`, tangent order [rotation, translation, log-scale].

pub mod camera;
pub mod geometry;
pub mod id;
pub mod image;
pub mod lie;
pub mod model;
pub mod remap;
pub mod rig;
pub mod sensor;
pub mod surface;
mod svd3;
pub mod testing;
pub mod time;
pub mod trajectory;
pub mod umeyama;
pub mod warning;

pub use camera::{CameraError, CameraModel, ParametricCamera, Pinhole};
pub use geometry::{AlignedView, Confidence, GeometryError, MetricDepth, RelativeDepth};
pub use id::{CameraId, ChunkId, FrameId, KeyframeId, LandmarkId};
pub use image::{FrameImage, Image, ImageError};
pub use lie::{LieGroup, Se3, Sim3, So3};
pub use model::{
    ChunkView, ChunkViews, GeometryModel, GeometryPrediction, ModelError, ModelInfo, ViewGeometry,
};
pub use rig::{ImuNoise, Rig, RigCamera};
pub use sensor::{AngularRate, Frame, ImuSample, SensorEvent, SpecificForce};
pub use surface::{PointCloud, TriangleMesh};
pub use time::{Duration, TimeError, Timestamp};
pub use trajectory::{BodyFrame, StampedPose, Trajectory, TrajectoryError};
pub use umeyama::{UmeyamaError, umeyama_se3, umeyama_sim3, umeyama_sim3_weighted};
pub use warning::Warning;

/// Standard gravity magnitude used for synthetic data, m/s².
pub const GRAVITY_MPS2: f64 = 9.81;
