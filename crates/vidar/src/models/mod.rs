//! Choice of the network, its weights and their licence: the only interface to `vidar-hub` and `vidar-da3`.
//!
//! A model is an official one (`da3-small`), the built-in one (`da3-nano`), a folder with custom weights (`--model-dir`), or
//! *untrained* (`da3-small-untrained`): the official architecture with synthetic weights. Its geometry is meaningless; it
//! serves to test the pipeline and to measure time and memory without downloads.

pub mod bundled;
pub mod geometry;
mod memory;
pub mod salad;

pub use memory::{MemoryPlan, device_memory, planned_memory};

use crate::error::Error;
use crate::run::bytes;
use serde::Serialize;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use vidar_core::Warning;
use vidar_da3::preprocess::PreprocessConfig;
use vidar_da3::{Da3, Da3Config, Da3Options, Variant};
use vidar_hub::catalogue::{self, CHECKPOINTS, WEIGHTS};
use vidar_hub::{
    Acceptance, Checkpoint, HubError, HubSettings, InstalledCheckpoint, PullOptions, Store, TransferCallbacks,
};

/// Length of the part of a model card that is read.
const CARD_HEAD_BYTES: u64 = 64 << 10;
/// The suffix of names with synthetic weights.
const UNTRAINED: &str = "-untrained";

/// Which network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelChoice {
    /// An official checkpoint.
    Official(&'static Checkpoint),
    /// The built-in network.
    Bundled,
    /// A folder with `model.safetensors` and `config.json`, or a safetensors file.
    Folder(PathBuf),
    /// An official architecture with synthetic weights.
    Untrained(Variant),
}

impl ModelChoice {
    /// The checkpoint of a name.
    pub fn named(name: &str) -> Result<Self, Error> {
        if name == bundled::NAME {
            return Ok(Self::Bundled);
        }
        if let Some(architecture) = name.strip_suffix(UNTRAINED) {
            let checkpoint = catalogue::find(architecture)?;
            return match Variant::from_name(checkpoint.architecture) {
                Some(variant) => Ok(Self::Untrained(variant)),
                None => Err(HubError::UnknownModel { name: name.to_owned(), known: names() }.into()),
            };
        }
        Ok(Self::Official(catalogue::find(name)?))
    }

    /// Its name on the command line.
    pub fn name(&self) -> String {
        match self {
            Self::Official(checkpoint) => checkpoint.name.to_owned(),
            Self::Bundled => bundled::NAME.to_owned(),
            Self::Folder(path) => path.display().to_string(),
            Self::Untrained(variant) => format!("{}{UNTRAINED}", variant.name()),
        }
    }
}

/// Acceptance of a licence by the user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LicenceAccepted {
    /// The licence as given by the user.
    pub licence: String,
    /// Who.
    pub by: String,
}

/// A model that is available and may be used.
#[derive(Clone, Debug)]
pub struct LocatedModel {
    /// Which one.
    pub choice: ModelChoice,
    /// Its weights; `None` for built-in and synthetic ones.
    pub path: Option<PathBuf>,
    /// Its identity in manifests.
    pub identity: ModelIdentity,
}

/// Identity of a model in a manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ModelIdentity {
    /// Name as the user chose it.
    pub name: String,
    /// The official checkpoint, if the weights are those of one.
    pub official: Option<&'static str>,
    /// SPDX licence of the weights; for custom weights that of the card next to them, else `unknown`.
    pub licence: String,
    /// SHA-256 of the weights; none for synthetic weights.
    pub weights_sha256: Option<String>,
    /// Length of the weights.
    pub weights_bytes: u64,
    /// Their source.
    pub source: Option<String>,
    /// Who accepted the licence, if it requires acceptance.
    pub acceptance: Option<Acceptance>,
    /// Whether the weights are trained: not for synthetic ones.
    pub is_trained: bool,
}

/// The store set by the environment; `offline` additionally disables network use.
pub fn store(offline: bool) -> Result<Store, Error> {
    let mut settings = HubSettings::from_environment(|name| std::env::var(name).ok())?;
    settings.offline |= offline;
    Ok(Store::new(settings))
}

/// Finds the model's weights and checks that they may be used. Nothing is downloaded.
pub fn locate(
    choice: &ModelChoice,
    accepted: Option<&LicenceAccepted>,
    store: &Store,
) -> Result<LocatedModel, Error> {
    match choice {
        ModelChoice::Official(checkpoint) => official(checkpoint, accepted, store),
        ModelChoice::Bundled => {
            Ok(LocatedModel { choice: choice.clone(), path: None, identity: bundled::identity() })
        }
        ModelChoice::Folder(path) => folder(path, accepted, store),
        ModelChoice::Untrained(_) => Ok(LocatedModel {
            choice: choice.clone(),
            path: None,
            identity: ModelIdentity {
                name: choice.name(),
                official: None,
                licence: "MIT OR Apache-2.0".to_owned(),
                weights_sha256: None,
                weights_bytes: 0,
                source: Some("synthetic weights".to_owned()),
                acceptance: None,
                is_trained: false,
            },
        }),
    }
}

/// Hash of the weights that go by a name; none where it is not known.
///
/// # Errors
/// A name that no network has.
pub fn known_hash(name: &str) -> Result<Option<&'static str>, Error> {
    Ok(match ModelChoice::named(name)? {
        ModelChoice::Bundled => Some(bundled::sha256()),
        ModelChoice::Official(checkpoint) => checkpoint.weights().sha256,
        ModelChoice::Folder(_) | ModelChoice::Untrained(_) => None,
    })
}

/// Records the acceptance of a licence for weights that need not be here: those of workers elsewhere.
///
/// # Errors
/// A name that no network has, another licence, or a record that cannot be written.
pub fn accept(name: &str, accepted: &LicenceAccepted) -> Result<(), Error> {
    let ModelChoice::Official(checkpoint) = ModelChoice::named(name)? else { return Ok(()) };
    match acceptance_of(checkpoint, Some(accepted))? {
        Some(acceptance) => Ok(store(true)?.accept(checkpoint, &acceptance)?),
        None => Ok(()),
    }
}

/// The record of the acceptance given with this command.
pub fn acceptance_of(
    checkpoint: &'static Checkpoint,
    accepted: Option<&LicenceAccepted>,
) -> Result<Option<Acceptance>, Error> {
    // A licence that allows every use needs no record.
    let needed = accepted.filter(|_| !checkpoint.licence.allows_commercial_use());
    let now = crate::run_folder::now_rfc3339();
    Ok(needed.map(|a| Acceptance::new(checkpoint, &a.licence, &a.by, &now)).transpose()?)
}

/// Options of a pull or an import at this moment.
pub fn pull_options(acceptance: Option<Acceptance>) -> PullOptions {
    PullOptions { acceptance, now: crate::run_folder::now_rfc3339(), ..PullOptions::default() }
}

fn official(
    checkpoint: &'static Checkpoint,
    accepted: Option<&LicenceAccepted>,
    store: &Store,
) -> Result<LocatedModel, Error> {
    // A missing checkpoint is reported before a missing acceptance.
    if store.find(checkpoint)?.is_none() {
        store.require(checkpoint).map_err(Error::WeightsMissing)?;
    }
    if let Some(acceptance) = acceptance_of(checkpoint, accepted)? {
        store.accept(checkpoint, &acceptance)?;
    }
    let installed = store.require(checkpoint)?;
    let sha256 = match installed.recorded_sha256() {
        Some(recorded) => recorded.to_owned(),
        None => hash(&installed.weights())?,
    };
    Ok(LocatedModel {
        choice: ModelChoice::Official(checkpoint),
        path: Some(installed.folder.clone()),
        identity: ModelIdentity {
            name: checkpoint.name.to_owned(),
            official: Some(checkpoint.name),
            licence: checkpoint.licence.spdx().to_owned(),
            weights_sha256: Some(sha256),
            weights_bytes: length(&installed.weights())?,
            source: source(&installed),
            acceptance: installed.acceptance,
            is_trained: true,
        },
    })
}

fn source(installed: &InstalledCheckpoint) -> Option<String> {
    let record = installed.record.as_ref();
    record.map(|r| r.source.clone()).or_else(|| Some(installed.folder.display().to_string()))
}

/// Custom weights. Those with the length of official ones keep their licence.
fn folder(path: &Path, accepted: Option<&LicenceAccepted>, store: &Store) -> Result<LocatedModel, Error> {
    let weights = if path.is_dir() { path.join(WEIGHTS) } else { path.to_owned() };
    let bytes = length(&weights)?;
    let sha256 = hash(&weights)?;
    let official = catalogue::of_hash(&sha256).or_else(|| catalogue::of_size(bytes).next());
    let mut acceptance = None;
    if let Some(checkpoint) = official.filter(|c| !c.licence.allows_commercial_use()) {
        if let Some(given) = acceptance_of(checkpoint, accepted)? {
            store.accept(checkpoint, &given)?;
        }
        acceptance = store.require_acceptance(checkpoint)?;
    }
    Ok(LocatedModel {
        choice: ModelChoice::Folder(path.to_owned()),
        path: Some(path.to_owned()),
        identity: ModelIdentity {
            name: path.display().to_string(),
            official: catalogue::of_hash(&sha256).map(|c| c.name),
            licence: match official {
                Some(checkpoint) => checkpoint.licence.spdx().to_owned(),
                None => weights.parent().and_then(card_licence).unwrap_or_else(|| "unknown".to_owned()),
            },
            weights_sha256: Some(sha256),
            weights_bytes: bytes,
            source: Some(path.display().to_string()),
            acceptance,
            is_trained: true,
        },
    })
}

/// The `license:` in the head of `README.md` next to the weights, as in model cards on the hub.
fn card_licence(folder: &Path) -> Option<String> {
    let mut head = Vec::new();
    File::open(folder.join("README.md")).ok()?.take(CARD_HEAD_BYTES).read_to_end(&mut head).ok()?;
    let text = String::from_utf8_lossy(&head);
    let front = text.strip_prefix("---")?.split("\n---").next()?;
    let named = front.lines().find_map(|line| line.strip_prefix("license:"))?.trim();
    let named = named.trim_matches(['"', '\'']);
    let is_plain = |c: char| c.is_ascii_alphanumeric() || " .+-()".contains(c);
    ((1..=64).contains(&named.len()) && named.chars().all(is_plain)).then(|| named.to_owned())
}

fn length(weights: &Path) -> Result<u64, Error> {
    std::fs::metadata(weights).map(|m| m.len()).map_err(|e| Error::io("read", weights, e))
}

fn hash(weights: &Path) -> Result<String, Error> {
    let callbacks = TransferCallbacks { progress: &|_| {}, cancel: &|| false };
    Ok(vidar_hub::sha256_of(weights, &callbacks)?.1)
}

impl LocatedModel {
    /// Opens the network. Weights are mapped, not copied.
    pub fn open(&self, options: &Da3Options) -> Result<Da3, Error> {
        match (&self.choice, &self.path) {
            (ModelChoice::Untrained(variant), _) => Ok(Da3::synthetic(*variant, options)?),
            (ModelChoice::Bundled, _) => bundled::open(options),
            (_, Some(path)) => Ok(Da3::open(path, options)?),
            (_, None) => {
                Err(HubError::NotInstalled { name: self.identity.name.clone(), looked: PathBuf::new() }
                    .into())
            }
        }
    }
}

/// The architecture, if it is known without weights.
pub fn architecture(choice: &ModelChoice) -> Option<Da3Config> {
    match choice {
        ModelChoice::Official(checkpoint) => Variant::from_name(checkpoint.architecture).map(Variant::config),
        ModelChoice::Untrained(variant) => Some(variant.config()),
        ModelChoice::Bundled => bundled::config().ok(),
        ModelChoice::Folder(_) => None,
    }
}

/// Recommended length of the bounding side of the input, px.
pub fn process_size_px(choice: &ModelChoice) -> usize {
    match choice {
        ModelChoice::Bundled => bundled::PROCESS_SIZE_PX,
        _ => PreprocessConfig::default().process_size_px,
    }
}

/// A warning if the plan exceeds the memory of this machine.
pub(crate) fn memory_warning(plan: &MemoryPlan) -> Option<Warning> {
    let there = crate::system::hardware().memory_bytes?;
    (plan.total() > there).then(|| {
        let message = format!("planned memory {}, this machine has {}", bytes(plan.total()), bytes(there));
        Warning::new("memory", message).hint("fewer images at once, a smaller size, or a smaller model")
    })
}

/// A warning if the weights are synthetic.
pub(crate) fn untrained_warning(identity: &ModelIdentity) -> Option<Warning> {
    (!identity.is_trained).then(|| {
        let message = "the weights are synthetic: this geometry is meaningless";
        Warning::new("untrained", message).hint("`vidar model pull da3-small` fetches trained weights")
    })
}

/// Names of all available networks.
pub fn names() -> String {
    std::iter::once(bundled::NAME).chain(CHECKPOINTS.iter().map(|c| c.name)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_official_or_untrained_or_refused() {
        assert_eq!(ModelChoice::named("da3-base").unwrap().name(), "da3-base");
        let untrained = ModelChoice::named("da3-metric-large-untrained").unwrap();
        assert_eq!(untrained, ModelChoice::Untrained(Variant::MetricLarge));
        assert!(ModelChoice::named("da3-enormous").is_err());
        assert!(ModelChoice::named("da3-enormous-untrained").is_err());
    }

    #[test]
    fn every_checkpoint_has_an_architecture_and_one_licence() {
        for checkpoint in CHECKPOINTS {
            let variant = Variant::from_name(checkpoint.architecture).unwrap();
            assert_eq!(variant.licence(), checkpoint.licence.spdx(), "{}", checkpoint.name);
        }
    }

    #[test]
    fn the_licence_of_custom_weights_is_that_of_their_card() {
        let folder = tempfile::tempdir().unwrap();
        let says = |text: &str| {
            std::fs::write(folder.path().join("README.md"), text).unwrap();
            card_licence(folder.path())
        };
        assert_eq!(says("---\ntags: [x]\nlicense: 'cc-by-4.0'\n---\n# Card\n").as_deref(), Some("cc-by-4.0"));
        assert_eq!(says("# Card\nlicense: mit\n"), None, "only the head counts");
        assert_eq!(says("---\nlicense: \u{1b}[31m\n---\n"), None);
        assert_eq!(says(&format!("---\nlicense: {}\n---\n", "x".repeat(65))), None);
        assert_eq!(card_licence(&folder.path().join("nowhere")), None);
    }

    #[test]
    fn synthetic_weights_are_marked_as_untrained() {
        let store = Store::new(HubSettings::new("/no/such".into()));
        let located = locate(&ModelChoice::named("da3-small-untrained").unwrap(), None, &store).unwrap();
        assert!(!located.identity.is_trained && located.identity.weights_sha256.is_none());
        let missing = locate(&ModelChoice::named("da3-small").unwrap(), None, &store).unwrap_err();
        assert_eq!(missing.code(), "E0403");
    }
}
