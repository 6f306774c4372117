//! The network of workers elsewhere as the source of depth: found, checked, asked.

use crate::config::Config;
use crate::engine::Prediction;
use crate::error::Error;
use crate::models::{self, bundled};
use crate::run_folder::now_ns;
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::time::Duration;
use vidar_core::{ChunkViews, ModelError, ModelInfo, Watch};
use vidar_da3::{Da3ModelConfig, PoseMode};
use vidar_hub::catalogue;
use vidar_link::geometry::{Expected, ModelFacts, Predicted, RemoteModel, RemoteOptions, RemoteReport};
use vidar_link::{Link, LinkError, Role};

/// Workers that are asked for predictions.
pub struct RemoteSource {
    model: RemoteModel,
    mode: PoseMode,
    wants_tokens: bool,
}

/// Who is asked, for more links to the same workers.
pub(super) struct WorkerGroup {
    /// How many there are.
    pub workers: usize,
    key: String,
    mode: PoseMode,
    facts: ModelFacts,
    wants_tokens: bool,
}

impl WorkerGroup {
    /// A link of its own, which of equally busy workers asks the one of this rank.
    ///
    /// # Errors
    /// As [`RemoteSource::open`]; and workers whose model is another one now.
    pub(super) fn join(&self, config: &Config, rank: usize) -> Result<RemoteSource, Error> {
        let source = RemoteSource {
            wants_tokens: self.wants_tokens,
            ..RemoteSource::ranked(&self.key, config, self.mode, rank)?
        };
        match *source.facts() == self.facts {
            true => Ok(source),
            false => Err(LinkError::OtherModel {
                key: self.key.clone(),
                reason: "they have another model than before".into(),
            }
            .into()),
        }
    }
}

impl RemoteSource {
    /// Finds the workers under a key and checks their model, its hash and its licence.
    ///
    /// # Errors
    /// No link, no worker, another model than asked for, or a licence that is not accepted.
    pub(super) fn open(key: &str, config: &Config, mode: PoseMode) -> Result<Self, Error> {
        Self::ranked(key, config, mode, 0)
    }

    fn ranked(key: &str, config: &Config, mode: PoseMode, rank: usize) -> Result<Self, Error> {
        let expected = expected(&config.remote.model)?;
        let settings = Da3ModelConfig { mode, ..config.model.network.clone() };
        let settings = serde_json::to_string(&settings)
            .map_err(|e| Error::BadValue { reason: format!("model.network: {e}") })?;
        let options = RemoteOptions {
            settings,
            expected,
            images: config.remote.images,
            depth: config.remote.depth,
            timeout: Duration::from_secs_f64(config.link.timeout_secs),
            patience: Duration::from_secs_f64(config.link.patience_secs),
            run: run_number() ^ rank as u64,
            rank,
        };
        let reach = Link::open(&config.link.options(), Role::Client)?.reach(key)?;
        let model = RemoteModel::open(reach, options, &|| false)?;
        check_licence(key, model.facts())?;
        if model.facts().model == bundled::NAME && config.remote.model.is_empty() {
            // Its images have another size, and it is told its poses, which the settings know only by its name.
            let reason = format!("they have {}: say so with remote.model={}", bundled::NAME, bundled::NAME);
            return Err(LinkError::OtherModel { key: key.to_owned(), reason }.into());
        }
        Ok(Self { model, mode, wants_tokens: false })
    }

    pub(super) fn info(&self) -> &ModelInfo {
        &self.model.facts().info
    }

    pub(super) fn facts(&self) -> &ModelFacts {
        self.model.facts()
    }

    pub(super) fn token_channels(&self) -> Option<usize> {
        self.model.facts().token_channels.map(|c| c as usize)
    }

    pub(super) fn keep_place_tokens(&mut self) {
        self.wants_tokens = true;
    }

    /// The workers that are known now.
    pub(super) fn group(&self) -> WorkerGroup {
        let (workers, key, facts) = (self.model.workers(), self.report().key, self.facts().clone());
        WorkerGroup { workers, key, mode: self.mode, facts, wants_tokens: self.wants_tokens }
    }

    pub(super) fn report(&self) -> RemoteReport {
        self.model.report()
    }

    pub(super) fn predict(
        &mut self,
        views: &ChunkViews,
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<Prediction, ModelError> {
        let Predicted { geometry, tokens } = self.model.predict(views, wanted, self.wants_tokens, watch)?;
        Ok(Prediction { tokens, ..Prediction::of(geometry) })
    }
}

/// What the name of a model says of its weights.
fn expected(name: &str) -> Result<Expected, Error> {
    let weights_sha256 = match name {
        "" => return Ok(Expected::default()),
        bundled::NAME => Some(bundled::sha256().to_owned()),
        other => models::known_hash(other)?.map(str::to_owned),
    };
    Ok(Expected { name: Some(name.to_owned()), weights_sha256 })
}

/// Weights that are known come with their own licence; one that forbids commercial use must have been accepted here.
fn check_licence(key: &str, facts: &ModelFacts) -> Result<(), Error> {
    let hash = facts.info.weights_sha256.as_deref();
    let other = |reason: String| Err(LinkError::OtherModel { key: key.to_owned(), reason }.into());
    let official = hash.and_then(catalogue::of_hash);
    let known = match official {
        Some(checkpoint) => Some((checkpoint.name, checkpoint.licence.spdx())),
        None => (hash == Some(bundled::sha256())).then_some((bundled::NAME, bundled::LICENCE)),
    };
    match known {
        Some((name, licence)) if licence != facts.licence => {
            let found = vidar_core::printable(&facts.licence);
            return other(format!(
                "these are the weights of {name}, whose licence is {licence}, not {found}"
            ));
        }
        None if models::known_hash(&facts.model).is_ok_and(|h| h.is_some())
            || facts.model == bundled::NAME =>
        {
            let name = vidar_core::printable(&facts.model);
            return other(format!("they call their model {name}, and its weights have another hash"));
        }
        _ => {}
    }
    if let Some(checkpoint) = official {
        models::store(true)?.require_acceptance(checkpoint)?;
    }
    Ok(())
}

/// A number that tells this run's requests from those of others.
fn run_number() -> u64 {
    let digest = Sha256::digest(format!("{} {}", std::process::id(), now_ns()));
    digest.iter().take(8).fold(0, |n, byte| n << 8 | u64::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn facts(model: &str, licence: &str, hash: Option<&str>) -> ModelFacts {
        ModelFacts {
            model: model.into(),
            licence: licence.into(),
            info: ModelInfo {
                name: model.into(),
                licence: licence.into(),
                weights_sha256: hash.map(str::to_owned),
                needs_poses: false,
                min_views: 1,
            },
            token_channels: None,
            arithmetic: "cpu".into(),
        }
    }

    #[test]
    fn known_weights_come_with_their_own_licence_and_known_names_with_their_weights() {
        let code = |facts: &ModelFacts| check_licence("k", facts).map_err(|e| e.code()).err();
        let own = Some(bundled::sha256());
        assert_eq!(code(&facts("da3-nano", bundled::LICENCE, own)), None);
        assert_eq!(code(&facts("da3-nano", "CC-BY-NC-4.0", own)), Some("E0410"));
        let other = "0".repeat(64);
        assert_eq!(code(&facts("da3-nano", bundled::LICENCE, Some(&other))), Some("E0410"));
        assert_eq!(code(&facts("da3-small", "Apache-2.0", Some(&other))), Some("E0410"));
        assert_eq!(code(&facts("our own", "MIT", Some(&other))), None);
        let official = catalogue::CHECKPOINTS.iter().find(|c| c.weights().sha256.is_some()).unwrap();
        let lied = facts(official.name, "WTFPL", official.weights().sha256);
        assert_eq!(code(&lied), Some("E0410"));
    }

    #[test]
    fn the_name_of_a_model_says_which_weights_it_has() {
        assert_eq!(expected("").unwrap(), Expected::default());
        assert_eq!(expected("da3-nano").unwrap().weights_sha256.as_deref(), Some(bundled::sha256()));
        assert_eq!(expected("no such").unwrap_err().code(), "E0105");
    }
}
