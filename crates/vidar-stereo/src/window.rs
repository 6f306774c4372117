//! The window of the matching cost, its units and the cost of what is not seen: what warping and matching agree on.

/// Cost of a window that is not visible in a neighbour; every visible one costs at most 1.
pub(crate) const HIDDEN: f32 = 2.0;
/// Window radius, pixels.
pub(crate) const RADIUS: usize = 2;
/// Matched units per grey level.
pub(crate) const UNITS: f32 = 4.0;
