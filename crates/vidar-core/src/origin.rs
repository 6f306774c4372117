//! Where each pixel's depth comes from, and its standard deviation.

use serde::{Deserialize, Serialize};

/// Where a pixel's depth comes from, most trustworthy first. The numbers are those of files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum DepthSource {
    /// There is no depth.
    #[default]
    None = 0,
    /// Multi-view stereo of this view.
    Stereo = 1,
    /// The fused surface, seen from this view.
    Map = 2,
    /// A plane through measured depth around an untextured region.
    Plane = 3,
    /// A network's depth, bent onto what is measured: a guess.
    Network = 4,
    /// Interpolated between what is measured: a guess.
    Interpolation = 5,
}

impl DepthSource {
    /// All that stand for a depth, in the order of their numbers.
    pub const ALL: [Self; 5] = [Self::Stereo, Self::Map, Self::Plane, Self::Network, Self::Interpolation];

    /// Whether no measurement supports the pixel itself.
    pub fn is_guess(self) -> bool {
        matches!(self, Self::Network | Self::Interpolation)
    }

    /// Its name in files and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Stereo => "stereo",
            Self::Map => "map",
            Self::Plane => "plane",
            Self::Network => "network",
            Self::Interpolation => "interpolation",
        }
    }
}

/// Where one pixel's depth comes from, and how exact it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthOrigin {
    /// Its source.
    pub source: DepthSource,
    /// Standard deviation of ln(depth), so roughly the relative one; NaN where the source is `None`.
    pub log_std: f32,
}

impl DepthOrigin {
    /// A pixel without depth.
    pub const NONE: Self = Self { source: DepthSource::None, log_std: f32::NAN };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_files_are_one_to_five() {
        for (number, source) in DepthSource::ALL.into_iter().enumerate() {
            assert_eq!(source as usize, number + 1, "{}", source.name());
        }
        assert_eq!(DepthSource::ALL.into_iter().filter(|s| s.is_guess()).count(), 2);
    }
}
