//! JSON parsing with the position in every error.

use crate::error::ExportError;
use serde::de::DeserializeOwned;

/// Reads a JSON document; serde's depth limit bounds the nesting.
pub(crate) fn parse<T: DeserializeOwned>(format: &'static str, bytes: &[u8]) -> Result<T, ExportError> {
    serde_json::from_slice(bytes).map_err(|error| {
        let place = format!("line {} column {}", error.line(), error.column());
        let expected = if error.is_data() { "another value" } else { "a JSON document" };
        ExportError::malformed(format, place, expected, error.to_string())
    })
}
