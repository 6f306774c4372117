//! What can go wrong when a picture is made.

use thiserror::Error;

/// Why there is no picture.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ViewError {
    /// The picture has no pixels, or more columns or rows than PNG readers accept.
    #[error("a picture of {width}x{height} pixels cannot be written as PNG: each side must be 1 to {max}")]
    BadSize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Largest side.
        max: usize,
    },
    /// The PNG encoder refused.
    #[error("the PNG encoder refused a picture of {width}x{height} pixels: {source}")]
    Png {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// What it said.
        source: png::EncodingError,
    },
    /// An attribute list of a surface does not fit its vertices, or a triangle names a vertex that is not there.
    #[error(
        "{surface} is not consistent: {vertices} vertices, {triangles} triangles, but an attribute list has another length or an index lies outside"
    )]
    InconsistentSurface {
        /// `mesh` or `cloud`.
        surface: &'static str,
        /// Number of vertices.
        vertices: usize,
        /// Number of triangles.
        triangles: usize,
    },
    /// Values to be painted onto a surface are not one per vertex.
    #[error("values on the surface: expected {expected} (one per vertex), found {found}")]
    WrongValueCount {
        /// Number of vertices.
        expected: usize,
        /// Number of values.
        found: usize,
    },
    /// A camera holds a value that is not finite, or looks nowhere.
    #[error("map camera `{name}` is degenerate: {what}")]
    BadCamera {
        /// Name of the viewpoint.
        name: String,
        /// What is wrong.
        what: &'static str,
    },
}
