//! Trajectories, PLY, GLB, COLMAP, transforms.json and depth PNG, written and read back.
//!
//! Every writer takes any [`std::io::Write`]; [`atomic::write_atomically`] makes a file of it that is either complete
//! or absent. Every reader takes untrusted bytes: it never panics, allocates in proportion to the
//! file size, and its error names the position.
//!
//! | Format | Frames and units | Kept | Lost |
//! |---|---|---|---|
//! | [TUM, EuRoC csv](trajectory) | `world_from_body`, the body named in a comment; m | time to 1 ns, pose to 1e-9 | – |
//! | [KITTI](trajectory) | same, body and times in a second file; m | pose to 13 digits | – |
//! | [PLY](ply) | world z up; m | every value | – |
//! | [GLB](glb) | vertices in the world; a root node rotates them to y up | every value; textures as JPEG | a texture is not read back |
//! | [depth PNG](depth) | z-depth, steps per metre in a sidecar | depth to half a step | depths out of range, counted |
//! | [COLMAP](colmap) | `camera_from_world`; pixel corner is (0, 0) | views, points, colours | time, normals, confidence |
//! | [transforms.json](transforms) | `world_from_camera`, OpenGL camera; pixel corner is (0, 0) | views, time | – |
//! | [MCAP of a run](scene) | world z up; m | what viewers show | precision of depth below 1 mm |
//!
//! None of these formats re-centres, rotates or rescales the world. [`official`] holds the files of the official Depth
//! Anything 3 program (npz, GLB scene, depth pictures, COLMAP) with that program's own conventions.
//!
//! # Checked against other tools
//!
//! Checked manually once, on the small data of the tests (three vertices with all attributes, two views, two poses):
//! - pycolmap 4.2.1 loads the text and the binary model; 1000 random points project through it to VIDAR's pixels plus
//!   (0.5, 0.5) within 1.2e-13 px; positions, colours and the error −1 are the same.
//! - Open3D 0.20.0 reads positions, normals, colours, triangles of the PLY files (and `confidence` through its tensor
//!   reader), and the GLB mesh turned y up with its colours as linear light. A GLB of points was not
//!   checked.
//! - evo 1.38.1 reads the TUM, EuRoC and KITTI files; positions and quaternions are the same.
//! - Pillow's 16-bit PNG is read, and the written header is byte for byte the same (a test).

pub mod atomic;
mod axes;
mod bytes;
pub mod colmap;
pub mod depth;
pub mod error;
pub mod glb;
mod json;
pub mod official;
mod origin;
mod patches;
pub mod ply;
pub mod scene;
mod text;
pub mod trajectory;
pub mod transforms;
mod vertices;
pub mod view;

pub use colmap::{ColmapFormat, ColmapModel, Observation, read_colmap, read_colmap_bytes, write_colmap};
pub use depth::{DepthFrame, DepthPngStats, DepthSidecar, read_depth_png, write_depth_png};
pub use error::ExportError;
pub use glb::{Glb, read_glb, write_glb_cloud, write_glb_mesh, write_glb_textured};
pub use origin::{STD_STEP, write_source_png, write_std_png};
pub use patches::{SurfaceChange, SurfacePatch, SurfacePatches, thinned_vertices};
pub use ply::{Ply, read_ply, write_ply_cloud, write_ply_mesh};
pub use trajectory::{
    KittiTimes, read_euroc_csv, read_kitti, read_kitti_times, read_tum, write_euroc_csv, write_kitti,
    write_kitti_times, write_tum,
};
pub use transforms::{Transforms, read_transforms_json, write_transforms_json};
pub use view::{ExportView, ImportedView};
