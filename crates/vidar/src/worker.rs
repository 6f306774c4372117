//! A geometry worker: a network that answers the runs of other machines.

use crate::config::Config;
use crate::error::Error;
use crate::events::CancelToken;
use crate::models::geometry::chosen;
use crate::models::{LocatedModel, locate, store};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use vidar_core::{ChunkViews, GeometryModel, Watch};
use vidar_da3::{Da3, Da3Model, Da3ModelConfig, Da3Options, Precision};
use vidar_link::geometry::{ModelFacts, Predicted, Served};
use vidar_link::{Link, Role, Serving};

/// A network that is open.
pub struct Worker {
    network: Arc<Da3>,
    located: LocatedModel,
    /// What the network is with these settings; they are few.
    facts: Mutex<BTreeMap<String, ModelFacts>>,
}

/// Settings whose facts are remembered; who sends others all the time only makes them be found anew.
const MOST_SETTINGS: usize = 64;

impl Worker {
    /// Opens the network that the configuration names (`geometry.source`, `model`). Nothing is downloaded.
    ///
    /// # Errors
    /// A source that is no network; weights that are missing, or whose licence is not accepted.
    pub fn open(config: &Config) -> Result<Self, Error> {
        let Some(choice) = chosen(config)? else {
            let source = &config.geometry.source;
            return Err(Error::Usage {
                what: format!("a worker serves a network, and {source:?} is none"),
                hint: "give --model da3-small, or another of `vidar model list`".into(),
            });
        };
        let located = locate(&choice, None, &store(true)?)?;
        // As a run opens it, so that both compute the same bits.
        let options = Da3Options {
            precision: config.model.precision,
            head_precision: Some(Precision::F32),
            device: config.model.device,
            ..Da3Options::default()
        };
        let network = Arc::new(located.open(&options)?);
        Ok(Self { network, located, facts: Mutex::default() })
    }

    /// Name, licence and arithmetic, in words.
    pub fn words(&self) -> String {
        let identity = &self.located.identity;
        format!("{} ({}), {}", identity.name, identity.licence, self.network.describe_compute())
    }

    /// Answers requests under a key until it is cancelled; `told` hears of each.
    ///
    /// # Errors
    /// No link to other machines.
    pub fn serve(
        self,
        key: &str,
        config: &Config,
        told: &dyn Fn(Serving),
        cancel: &CancelToken,
    ) -> Result<(), Error> {
        let link = Link::open(&config.link.options(), Role::Server)?;
        Ok(link.serve(key, crate::VERSION, Arc::new(self), told, &|| cancel.is_cancelled())?)
    }

    fn model(&self, settings: &str) -> Result<Da3Model, String> {
        let config: Da3ModelConfig =
            serde_json::from_str(settings).map_err(|e| format!("its settings are not readable: {e}"))?;
        let sha256 = self.located.identity.weights_sha256.clone();
        Da3Model::new(self.network.clone(), config, sha256).map_err(|e| e.to_string())
    }
}

impl Served for Worker {
    fn facts(&self, settings: &str) -> Result<ModelFacts, String> {
        let mut known = self.facts.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(facts) = known.get(settings) {
            return Ok(facts.clone());
        }
        let model = self.model(settings)?;
        let facts = ModelFacts {
            model: self.located.identity.name.clone(),
            licence: self.located.identity.licence.clone(),
            info: model.info().clone(),
            token_channels: u32::try_from(model.token_channels()).ok(),
            arithmetic: self.network.describe_compute(),
        };
        if known.len() < MOST_SETTINGS {
            known.insert(settings.to_owned(), facts.clone());
        }
        Ok(facts)
    }

    fn predict(
        &self,
        settings: &str,
        wants_tokens: bool,
        views: &ChunkViews,
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<Predicted, String> {
        let mut model = self.model(settings)?;
        if wants_tokens {
            model.keep_place_tokens();
        }
        let geometry = model.predict_views(views, wanted, watch).map_err(|e| e.to_string())?;
        Ok(Predicted { geometry, tokens: model.take_place_tokens() })
    }
}
