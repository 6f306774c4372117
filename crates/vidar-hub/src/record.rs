//! What is recorded beside weights: where they are from, and that their licence was accepted.

use crate::catalogue::Checkpoint;
use crate::error::HubError;
use serde::{Deserialize, Serialize};

/// Schema of [`Record`].
pub const RECORD_SCHEMA: &str = "vidar.model/1";
/// Schema of [`Acceptance`].
pub const ACCEPTANCE_SCHEMA: &str = "vidar.acceptance/1";
pub(crate) const RECORD: &str = "vidar-model.json";
pub(crate) const ACCEPTANCE: &str = "acceptance.json";

/// Source, lengths and hashes of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// [`RECORD_SCHEMA`].
    pub schema: String,
    /// Name of the checkpoint.
    pub name: String,
    /// Address or path it was taken from.
    pub source: String,
    /// Commit on the hub, where known.
    pub revision: Option<String>,
    /// SPDX licence of the weights.
    pub licence: String,
    /// When, RFC 3339.
    pub added: String,
    /// Its files.
    pub files: Vec<RecordedFile>,
}

/// One file of a record.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedFile {
    /// File name, in the folder of the record.
    pub name: String,
    /// Length.
    pub bytes: u64,
    /// SHA-256, lower-case hexadecimal digits.
    pub sha256: String,
    /// The source of the hash.
    pub identified_by: IdentifiedBy,
}

/// The source of an expected hash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IdentifiedBy {
    /// The list of official checkpoints.
    Catalogue,
    /// The hub it was fetched from.
    Hub,
    /// None: it is the hash of the received file.
    Nobody,
}

/// Record that a licence was accepted.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Acceptance {
    /// [`ACCEPTANCE_SCHEMA`].
    pub schema: String,
    /// Name of the checkpoint.
    pub model: String,
    /// SPDX name of the licence.
    pub licence: String,
    /// Address of its text.
    pub text: String,
    /// Who accepted.
    pub accepted_by: String,
    /// When, RFC 3339.
    pub accepted_at: String,
}

impl Acceptance {
    /// The acceptance of `checkpoint`'s licence, which the user named as `given`.
    pub fn new(checkpoint: &Checkpoint, given: &str, by: &str, at: &str) -> Result<Self, HubError> {
        let licence = checkpoint.licence;
        if !given.eq_ignore_ascii_case(licence.spdx()) {
            let name = checkpoint.name.to_owned();
            return Err(HubError::WrongLicence { name, licence, given: given.to_owned() });
        }
        Ok(Self {
            schema: ACCEPTANCE_SCHEMA.to_owned(),
            model: checkpoint.name.to_owned(),
            licence: licence.spdx().to_owned(),
            text: licence.text_url().to_owned(),
            accepted_by: by.to_owned(),
            accepted_at: at.to_owned(),
        })
    }

    pub(crate) fn is_of(&self, checkpoint: &Checkpoint) -> bool {
        self.schema == ACCEPTANCE_SCHEMA
            && self.model == checkpoint.name
            && self.licence == checkpoint.licence.spdx()
    }
}

/// The record of a checkpoint whose files are `files`.
pub(crate) fn record_of(
    checkpoint: &Checkpoint,
    source: String,
    revision: Option<String>,
    added: &str,
    files: Vec<RecordedFile>,
) -> Record {
    Record {
        schema: RECORD_SCHEMA.to_owned(),
        name: checkpoint.name.to_owned(),
        source,
        revision,
        licence: checkpoint.licence.spdx().to_owned(),
        added: added.to_owned(),
        files,
    }
}
