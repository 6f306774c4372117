//! Confidence-weighted TSDF and point fusion, mesh extraction, coverage.
//!
//! [`TsdfVolume`] turns metric views into a truncated signed distance field (Curless & Levoy, SIGGRAPH 1996) over
//! hashed blocks of voxels (Nießner et al., TOG 2013), and reads the surface from it by marching cubes.
//! [`PointFusion`] averages the pixels of each voxel instead. Both weigh pixels by confidence, viewing angle and
//! depth, hold to a memory budget, run on all threads of the caller's rayon pool, and give the same bits for any
//! order of views and any number of threads, because they add integers only.
//!
//! ```
//! use vidar_core::{AlignedView, Confidence, FrameId, Image, MetricDepth, Pinhole, Se3, Timestamp};
//! use vidar_fusion::{FusionConfig, TsdfVolume};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // A wall one metre in front of the camera, in two views.
//! let camera = Pinhole::new(80.0, 80.0, 39.5, 29.5, 80, 60)?;
//! let mut volume = TsdfVolume::new(&FusionConfig::default())?;
//! for i in 0..2 {
//!     let depth = MetricDepth::new(Image::filled(80, 60, 1.0));
//!     let confidence = Confidence::full(80, 60);
//!     let time = Timestamp::from_nanos(i);
//!     let view = AlignedView::new(FrameId(i as u32), time, Se3::IDENTITY, camera, depth, confidence)?;
//!     volume.integrate(&view)?;
//! }
//! let mesh = volume.extract_mesh();
//! assert!(mesh.positions.iter().all(|p| (p[2] - 1.0).abs() < 1e-3));
//! // Normals face the camera.
//! assert!(mesh.normals.iter().all(|n| n[2] < -0.99));
//! assert!(volume.coverage(&mesh).surface_area_m2 > 0.6);
//! # Ok(())
//! # }
//! ```
//!
//! Integration of a view: [`sample`] weighs its pixels, [`allocate`] finds the blocks it touches, [`update`] adds it to
//! the sums of each [`block`], [`carve`] adds free space. Extraction: [`field`] reads distances, [`cubes`] has the
//! triangles, [`extract`] makes the mesh, [`components`] removes small components, [`coverage`] measures what was
//! observed, [`double_wall`] detects double walls, [`floor`] what is seen through the floor, [`render`] shows the surface to a camera, [`texture`] gives it the pixels
//! of its images.
//!
//! A map whose poses still change is fused in [`SubVolumes`]: one volume per chunk, moved when the pose graph changes.

mod allocate;
mod block;
mod carve;
mod components;
mod config;
mod coverage;
mod cubes;
mod double_wall;
mod error;
mod extract;
mod field;
mod floor;
mod grid;
mod pixels;
mod point_sums;
mod points;
mod render;
mod sample;
mod sub_volumes;
mod texture;
mod update;
#[cfg(target_arch = "x86_64")]
mod update_avx2;
mod volume;

pub use config::FusionConfig;
pub use coverage::{CoverageReport, surface_area_m2};
pub use double_wall::{DoubleWallDetector, DoubleWallReport};
pub use error::FusionError;
pub use floor::Floor;
pub use grid::median_depth;
pub use points::PointFusion;
pub use render::{RenderedDepth, SurfaceRenderer};
pub use sub_volumes::{RevisedView, Revision, SubVolumeConfig, SubVolumeReport, SubVolumes};
pub use texture::{TextureCamera, TextureConfig, TextureImage, TextureReport, texture_mesh};
pub use volume::{IntegrationStats, TsdfVolume};
