//! Errors of drawing pictures.

use thiserror::Error;

/// Errors of drawing a picture.
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
    /// The PNG encoder failed.
    #[error("the PNG encoder failed on a picture of {width}x{height} pixels: {source}")]
    Png {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Its error.
        source: png::EncodingError,
    },
    /// An attribute list of a surface does not match its vertices, or a triangle index is out of range.
    #[error(
        "{surface} is not consistent: {vertices} vertices, {triangles} triangles, but an attribute list has another length or an index is out of range"
    )]
    InconsistentSurface {
        /// `mesh` or `cloud`.
        surface: &'static str,
        /// Number of vertices.
        vertices: usize,
        /// Number of triangles.
        triangles: usize,
    },
    /// The number of values on a surface is not one per vertex.
    #[error("values on the surface: expected {expected} (one per vertex), found {found}")]
    WrongValueCount {
        /// Number of vertices.
        expected: usize,
        /// Number of values.
        found: usize,
    },
    /// A camera contains a value that is not finite, or has no valid direction.
    #[error("map camera `{name}` is degenerate: {what}")]
    BadCamera {
        /// Name of the viewpoint.
        name: String,
        /// What is wrong.
        what: &'static str,
    },
}
