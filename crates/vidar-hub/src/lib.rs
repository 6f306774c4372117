//! Checkpoints of Depth Anything 3: the list of official ones, and finding, fetching, resuming and verifying them.
//!
//! - [`catalogue`]: which checkpoints there are, under which licence, how large, with which SHA-256.
//! - [`HubSettings`]: where they are stored and fetched from, set by environment variables.
//! - [`Store`]: those on this machine: `find`, `require`, `list`, `verify`, `pull`, `import`.
//!
//! Every file is verified: it gets its final name only if its length and SHA-256 are the official ones. Nothing is fetched unless [`Store::pull`] is called, and then from one hub only
//! (`{endpoint}/{repo}/resolve/{revision}/{file}`, and wherever it redirects to). Weights whose licence forbids commercial
//! use are neither fetched nor handed out before an [`Acceptance`] is recorded next to them.
//!
//! ```
//! use vidar_hub::{HubSettings, Store, catalogue};
//! # fn main() -> Result<(), vidar_hub::HubError> {
//! let store = Store::new(HubSettings::new("/no/such/folder".into()));
//! let small = catalogue::find("da3-small")?;
//! assert!(store.find(small)?.is_none());
//! let missing = store.require(small).unwrap_err();
//! assert!(missing.hint().unwrap().contains("vidar model pull da3-small"));
//! # Ok(())
//! # }
//! ```

mod address;
pub mod catalogue;
mod client;
mod digest;
mod disk;
mod download;
mod error;
mod header;
mod licence;
mod lock;
mod progress;
mod pull;
mod record;
mod settings;
mod store;

pub use catalogue::{Ability, Checkpoint, OfficialFile};
pub use digest::{hex, sha256_hex, sha256_of};
pub use error::HubError;
pub use licence::Licence;
pub use progress::{Progress, TransferCallbacks};
pub use pull::PullOptions;
pub use record::{Acceptance, IdentifiedBy, Record, RecordedFile};
pub use settings::{ENDPOINT, HubSettings};
pub use store::{CheckpointLocation, InstalledCheckpoint, Store, VerifiedFile, official_licence};
