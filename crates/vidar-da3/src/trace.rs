//! Looking into a run: intermediate results under the names that the reference files use.
//!
//! `patch_embed`, `tokens_in`, `blockII`, `featK`, `camtokK`, `pose_enc`, `cam_enc_tokens`, `head.…`: see
//! [`crate::check`]. Results come view by view; blocks are in the order of computation (the reference view first).

/// How the numbers of a traced tensor lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// As the shape says.
    Rows,
    /// `[rows, columns, channels]`; reference files have the channels first.
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
    /// How the numbers lie.
    pub layout: Layout,
    /// The numbers.
    pub data: &'a [f32],
}

/// Somebody who wants to see intermediate results.
pub trait Trace: Sync {
    /// Whether a result of that name is of interest; others are not put together at all.
    fn wants(&self, name: &str) -> bool;
    /// Takes one view's part.
    fn record(&self, tensor: Traced<'_>);
}
