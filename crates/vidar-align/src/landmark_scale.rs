//! The scale of a chunk from landmarks whose metric depth is known.

/// ln(metres per chunk unit) with its evidence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogScale {
    /// The estimate.
    pub log_scale: f64,
    /// Standard deviation of it.
    pub std: f64,
    /// Landmarks that count as independent.
    pub effective: f64,
    /// Observations used.
    pub observations: usize,
}
