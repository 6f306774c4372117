//! Opening SALAD's checkpoint, with a hint for the user when the file is not one.

use crate::error::Error;
use std::path::Path;
use vidar_da3::Da3Error;
use vidar_da3::salad::Salad;

/// Opens the converted checkpoint.
///
/// # Errors
/// A file that is missing; [`Error::Usage`] for one that is not SALAD's, with a hint on how to convert the published one.
pub fn open(path: &Path) -> Result<Salad, Error> {
    Salad::open(path).map_err(|error| match error {
        Da3Error::Io { path, source } => Error::io("read", &path, source),
        Da3Error::NotSalad { .. } => Error::Usage {
            what: error.to_string(),
            hint: "convert the published one: python tools/salad_to_safetensors.py dino_salad.ckpt \
                   dino_salad.safetensors"
                .into(),
        },
        other => Error::Da3(other),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_files_are_refused_with_a_hint_to_the_conversion() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("dino_salad.ckpt");
        std::fs::write(&path, b"PK\x03\x04 a pickle").unwrap();
        let Err(Error::Usage { what, hint }) = open(&path) else { panic!("opened") };
        assert!(what.contains("is not a SALAD checkpoint") && hint.contains("salad_to_safetensors.py"));
        assert!(matches!(open(&folder.path().join("nothing")), Err(Error::Io { .. })));
    }
}
