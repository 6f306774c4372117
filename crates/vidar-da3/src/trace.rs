//! Tracing a run: intermediate results under the names that the reference files use.
//!
//! `patch_embed`, `tokens_in`, `blockII`, `featK`, `camtokK`, `pose_enc`, `cam_enc_tokens`, `head.…`: see
//! [`crate::check`]. Results arrive view by view; views of blocks are in the order of computation (the reference view first).

/// Memory layout of a traced tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Row-major in the order of the shape.
    Rows,
    /// `[rows, columns, channels]`; reference files store the channels first.
    Map,
}

/// One view's part of an intermediate result.
#[derive(Clone, Copy, Debug)]
pub struct Traced<'a> {
    /// Its name.
    pub name: &'a str,
    /// Which view, in the order of computation.
    pub view: usize,
    /// Shape of this view's part.
    pub shape: &'a [usize],
    /// Its memory layout.
    pub layout: Layout,
    /// The values.
    pub data: &'a [f32],
}

/// Receiver of intermediate results.
pub trait Trace: Sync {
    /// Whether a result of that name is wanted; others are not assembled.
    fn wants(&self, name: &str) -> bool;
    /// Receives one view's part.
    fn record(&self, tensor: Traced<'_>);
}
