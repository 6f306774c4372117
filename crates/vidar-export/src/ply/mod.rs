//! PLY: clouds and meshes with normals, colours and confidence.
//!
//! Written: `binary_little_endian 1.0`; element `vertex` with `float x y z`, then, where known,
//! `float nx ny nz`, `uchar red green blue` (sRGB), `float confidence`; for meshes element `face` with
//! `list uchar int vertex_indices`. The first comment is on normals, colours and confidence; the caller's follow (one line each), frame
//! and unit among them. Positions are not moved or scaled.
//!
//! Read: ASCII and binary of both byte orders, any scalar type for any property, unknown elements and properties
//! skipped, `vertex_index` as well as `vertex_indices`, polygons cut into fans of triangles, colours of 8 or 16
//! bits or float 0…1, `quality` as well as `confidence`. Counts are checked against the file size before
//! anything is allocated.
//!
//! NaN: the writer refuses it. The reader refuses a position that is not finite (naming the vertex) and, because
//! other tools write NaN normals for degenerate faces, reads such a normal as (0, 0, 0) and such a confidence as 0.

mod header;
mod read;
mod scalar;
mod write;

pub use read::{Ply, read_ply};
pub use write::{write_ply_cloud, write_ply_mesh};

pub(crate) const FORMAT: &str = "PLY";
