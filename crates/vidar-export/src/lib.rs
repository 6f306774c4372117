//! Trajectories, PLY, GLB, COLMAP, transforms.json and depth PNG, written and read back.
//!
//! Every writer takes any [`std::io::Write`]; [`atomic::write_atomically`] makes a file of it that is either complete
//! or absent. Every reader takes untrusted bytes: it never panics, allocates in proportion to what is really
//! there, and its error names the place.

pub mod atomic;
mod axes;
mod bytes;
pub mod colmap;
pub mod depth;
pub mod error;
pub mod glb;
mod json;
pub mod ply;
mod text;
pub mod trajectory;
pub mod transforms;
mod vertices;
pub mod view;

pub use colmap::{ColmapFormat, ColmapModel, read_colmap, read_colmap_bytes, write_colmap};
pub use depth::{DepthFrame, DepthPngStats, DepthSidecar, read_depth_png, write_depth_png};
pub use error::ExportError;
pub use glb::{Glb, read_glb, write_glb_cloud, write_glb_mesh};
pub use ply::{Ply, read_ply, write_ply_cloud, write_ply_mesh};
pub use trajectory::{
    KittiTimes, read_euroc_csv, read_kitti, read_kitti_times, read_tum, write_euroc_csv, write_kitti,
    write_kitti_times, write_tum,
};
pub use transforms::{Transforms, read_transforms_json, write_transforms_json};
pub use view::{ExportView, ImportedView};
