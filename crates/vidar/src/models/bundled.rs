//! da3-nano: VIDAR's own small network, built into the program. `training/` describes how it was trained,
//! `models/da3-nano/README.md` what it can and cannot do.

use super::ModelIdentity;
use crate::error::Error;
use std::sync::Arc;
use std::sync::OnceLock;
use vidar_core::Warning;
use vidar_da3::config::json;
use vidar_da3::{Da3, Da3Config, Da3Options};
use vidar_da3_nano::{CONFIG, WEIGHTS};
use vidar_hub::sha256_hex;
use vidar_nn::Checkpoint;

/// Its name on the command line.
pub const NAME: &str = "da3-nano";
/// Licence of its weights.
pub const LICENCE: &str = "MIT OR Apache-2.0";
/// Longer side of the pictures that it was trained for, px.
pub const PROCESS_SIZE_PX: usize = 280;
/// Advice on when to choose it.
pub const NOTE: &str =
    "built in; trained on rendered rooms, for first tries: for real recordings use da3-small";
/// Source of weights and description, for errors and manifests.
pub const SOURCE: &str = "built into the program (models/da3-nano)";

/// Its architecture.
pub fn config() -> Result<Da3Config, Error> {
    Ok(json::parse(CONFIG, SOURCE)?)
}

/// Length of its weights, bytes.
pub fn bytes() -> u64 {
    WEIGHTS.len() as u64
}

/// Number of parameters.
pub fn parameters() -> Result<u64, Error> {
    let shapes = vidar_da3::weights::inventory::parameters(&config()?);
    Ok(shapes.iter().filter(|p| p.is_read).map(|p| p.shape.iter().product::<usize>() as u64).sum())
}

/// SHA-256 of its weights.
pub fn sha256() -> &'static str {
    static HASH: OnceLock<String> = OnceLock::new();
    HASH.get_or_init(|| sha256_hex(WEIGHTS))
}

/// Opens the network; its weights are not copied.
pub fn open(options: &Da3Options) -> Result<Da3, Error> {
    let checkpoint = Checkpoint::from_static(WEIGHTS, SOURCE).map_err(vidar_da3::Da3Error::from)?;
    Ok(Da3::with_weights(config()?, Arc::new(checkpoint), options)?)
}

/// Its identity in manifests.
pub fn identity() -> ModelIdentity {
    ModelIdentity {
        name: NAME.to_owned(),
        official: None,
        licence: LICENCE.to_owned(),
        weights_sha256: Some(sha256().to_owned()),
        weights_bytes: bytes(),
        source: Some(SOURCE.to_owned()),
        acceptance: None,
        is_trained: true,
    }
}

/// The warning for its users.
pub(crate) fn small_network_warning(identity: &ModelIdentity) -> Option<Warning> {
    (identity.name == NAME).then(|| {
        let message = "da3-nano is small and was trained on rendered rooms only";
        let hint = "for your own recordings fetch official weights: `vidar model pull da3-small`";
        Warning::new("small-network", message).hint(hint)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_da3::weights::verify;

    #[test]
    fn it_is_complete_and_small() {
        let checkpoint = Checkpoint::from_static(WEIGHTS, SOURCE).unwrap();
        verify(&checkpoint, &config().unwrap()).unwrap();
        assert!(bytes() <= 16 << 20, "{} bytes", bytes());
        // The file that the model card's errors were measured with: both halves, in their order.
        assert_eq!(sha256(), "79c0847b4af72a3052444027f454272f57424043a12548e1ed24fd67da2bbb52");
        open(&Da3Options::default()).unwrap();
    }
}
