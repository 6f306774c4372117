//! Licences of weights.

use serde::{Deserialize, Serialize};

/// The licence of weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Licence {
    /// Apache License 2.0.
    #[serde(rename = "Apache-2.0")]
    Apache2,
    /// Creative Commons Attribution-NonCommercial 4.0.
    #[serde(rename = "CC-BY-NC-4.0")]
    CcByNc4,
}

impl Licence {
    /// SPDX name.
    pub fn spdx(self) -> &'static str {
        match self {
            Self::Apache2 => "Apache-2.0",
            Self::CcByNc4 => "CC-BY-NC-4.0",
        }
    }

    /// Where its text is.
    pub fn text_url(self) -> &'static str {
        match self {
            Self::Apache2 => "https://www.apache.org/licenses/LICENSE-2.0",
            Self::CcByNc4 => "https://creativecommons.org/licenses/by-nc/4.0/legalcode",
        }
    }

    /// Whether commercial use is allowed.
    pub fn allows_commercial_use(self) -> bool {
        matches!(self, Self::Apache2)
    }
}

impl std::fmt::Display for Licence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.spdx())
    }
}
