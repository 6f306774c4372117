//! What the front end cannot do. A track that is lost is an outcome, not an error.

use thiserror::Error;

/// Errors of the front end.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum FrontendError {
    /// An image is not of the size that the buffers were made for.
    #[error("image is {found_width}x{found_height}, the front end was made for {width}x{height}")]
    SizeMismatch {
        /// Columns expected.
        width: usize,
        /// Rows expected.
        height: usize,
        /// Columns found.
        found_width: usize,
        /// Rows found.
        found_height: usize,
    },
}
