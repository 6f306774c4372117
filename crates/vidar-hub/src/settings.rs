//! Where checkpoints are stored and fetched from.
//!
//! | Variable | Meaning | Default |
//! |---|---|---|
//! | `VIDAR_MODELS` | folder of the checkpoints | `vidar/models` in the user's data folder |
//! | `HF_ENDPOINT` | the hub, or a mirror of it | `https://huggingface.co` |
//! | `HF_TOKEN` | token of a user of the hub | none |
//! | `VIDAR_OFFLINE`, `HF_HUB_OFFLINE` | `1`: never use the network | use it |
//! | `HF_HUB_CACHE`, `HF_HOME` | cache of other programs, read only | `~/.cache/huggingface/hub` |
//! | `HTTPS_PROXY`, `NO_PROXY`, … | the usual proxy settings | none |

use crate::error::HubError;
use std::path::PathBuf;
use std::time::Duration;

/// The official hub.
pub const ENDPOINT: &str = "https://huggingface.co";

/// Where checkpoints are stored and how they are fetched.
#[derive(Clone, PartialEq, Eq)]
pub struct HubSettings {
    /// Folder of the checkpoints, one folder for each.
    pub root: PathBuf,
    /// Cache of the hub's official programs, read only.
    pub hub_cache: Option<PathBuf>,
    /// The hub or a mirror, without a slash at the end.
    pub endpoint: String,
    /// Token of a user of the hub; sent to the endpoint only.
    pub token: Option<String>,
    /// Never use the network.
    pub offline: bool,
    /// Whether proxy variables of the environment are used.
    pub proxy_from_environment: bool,
    /// Time without data after which a connection is closed.
    pub silence: Duration,
    /// Slowest transfer that goes on, bytes per second on average over [`Self::rate_window`]. A server that sends a byte now and
    /// then is not silent, and would never end.
    pub min_bytes_per_sec: u64,
    /// Time over which the rate is taken.
    pub rate_window: Duration,
    /// Longest time for one file, tries and waits included.
    pub longest_transfer: Duration,
    /// Tries without progress before a transfer fails.
    pub tries: u32,
    /// First wait between two tries; doubled each time.
    pub backoff: Duration,
    /// Longest wait that a server may request.
    pub longest_wait: Duration,
}

impl std::fmt::Debug for HubSettings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // A token must not appear in a log.
        f.debug_struct("HubSettings")
            .field("root", &self.root)
            .field("hub_cache", &self.hub_cache)
            .field("endpoint", &self.endpoint)
            .field("token", &self.token.as_ref().map(|_| "…"))
            .field("offline", &self.offline)
            .finish_non_exhaustive()
    }
}

impl HubSettings {
    /// Default settings with checkpoints stored in `root`.
    pub fn new(root: PathBuf) -> Self {
        Self {
            root,
            hub_cache: None,
            endpoint: ENDPOINT.to_owned(),
            token: None,
            offline: false,
            proxy_from_environment: true,
            silence: Duration::from_secs(30),
            min_bytes_per_sec: 1 << 10,
            rate_window: Duration::from_secs(60),
            longest_transfer: Duration::from_secs(24 * 3600),
            tries: 5,
            backoff: Duration::from_secs(1),
            longest_wait: Duration::from_secs(120),
        }
    }

    /// Settings from environment variables; `variable` looks one up.
    pub fn from_environment(variable: impl Fn(&str) -> Option<String>) -> Result<Self, HubError> {
        let set = |name: &str| variable(name).filter(|value| !value.is_empty());
        let mut settings = Self::new(root(&set)?);
        settings.hub_cache = hub_cache(&set);
        if let Some(endpoint) = set("HF_ENDPOINT") {
            settings.endpoint = checked_endpoint(endpoint)?;
        }
        settings.token = token(&set)?;
        settings.offline = is_on("VIDAR_OFFLINE", &set)? || is_on("HF_HUB_OFFLINE", &set)?;
        Ok(settings)
    }
}

fn root(set: &impl Fn(&str) -> Option<String>) -> Result<PathBuf, HubError> {
    if let Some(path) = set("VIDAR_MODELS") {
        return Ok(path.into());
    }
    let data = match (set("XDG_DATA_HOME"), set("LOCALAPPDATA"), home(set)) {
        (Some(data), _, _) => PathBuf::from(data),
        (None, Some(data), _) if cfg!(windows) => data.into(),
        (None, _, Some(home)) if cfg!(target_os = "macos") => home.join("Library/Application Support"),
        (None, _, Some(home)) => home.join(".local/share"),
        (None, _, None) => {
            let expected = "a folder: there is neither VIDAR_MODELS nor a home folder";
            return Err(HubError::BadSetting { name: "VIDAR_MODELS", found: String::new(), expected });
        }
    };
    Ok(data.join("vidar").join("models"))
}

fn home(set: &impl Fn(&str) -> Option<String>) -> Option<PathBuf> {
    set("HOME").or_else(|| set("USERPROFILE")).map(PathBuf::from)
}

fn hub_cache(set: &impl Fn(&str) -> Option<String>) -> Option<PathBuf> {
    if let Some(cache) = set("HF_HUB_CACHE") {
        return Some(cache.into());
    }
    let home_of_hub = set("HF_HOME").map(PathBuf::from).or_else(|| {
        let cache = set("XDG_CACHE_HOME").map(PathBuf::from).or_else(|| Some(home(set)?.join(".cache")));
        Some(cache?.join("huggingface"))
    });
    Some(home_of_hub?.join("hub"))
}

fn checked_endpoint(endpoint: String) -> Result<String, HubError> {
    let rest = endpoint.strip_prefix("https://").or_else(|| endpoint.strip_prefix("http://"));
    let valid = rest.is_some_and(|r| {
        !r.is_empty()
            && !r.starts_with('/')
            && r.chars().all(|c| c.is_ascii_graphic() && !"?#@\\".contains(c))
    });
    if valid {
        return Ok(endpoint.trim_end_matches('/').to_owned());
    }
    let expected = "an address such as https://huggingface.co, without user, query or blanks";
    Err(HubError::BadSetting { name: "HF_ENDPOINT", found: endpoint, expected })
}

fn token(set: &impl Fn(&str) -> Option<String>) -> Result<Option<String>, HubError> {
    let Some(token) = set("HF_TOKEN").map(|t| t.trim().to_owned()) else { return Ok(None) };
    if token.chars().all(|c| c.is_ascii_graphic()) {
        return Ok(Some(token).filter(|t| !t.is_empty()));
    }
    // The message does not contain the token.
    let (found, expected) = ("…".to_owned(), "printable characters only");
    Err(HubError::BadSetting { name: "HF_TOKEN", found, expected })
}

fn is_on(name: &'static str, set: &impl Fn(&str) -> Option<String>) -> Result<bool, HubError> {
    match set(name).as_deref().map(str::to_lowercase).as_deref() {
        None | Some("0" | "false" | "no" | "off") => Ok(false),
        Some("1" | "true" | "yes" | "on") => Ok(true),
        Some(other) => Err(HubError::BadSetting { name, found: other.to_owned(), expected: "0 or 1" }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    fn settings(pairs: &[(&str, &str)]) -> Result<HubSettings, HubError> {
        let map: HashMap<&str, &str> = pairs.iter().copied().collect();
        HubSettings::from_environment(|name| map.get(name).map(|v| (*v).to_owned()))
    }

    #[test]
    fn settings_are_read_from_the_environment() {
        let s = settings(&[("HOME", "/h")]).unwrap();
        if cfg!(target_os = "linux") {
            assert_eq!(s.root, PathBuf::from("/h/.local/share/vidar/models"));
        }
        assert_eq!(s.hub_cache, Some("/h/.cache/huggingface/hub".into()));
        assert_eq!((s.endpoint.as_str(), s.token, s.offline), (ENDPOINT, None, false));
        let s = settings(&[
            ("HOME", "/h"),
            ("VIDAR_MODELS", "/m"),
            ("HF_HOME", "/hf"),
            ("HF_ENDPOINT", "http://mirror:8080/hub/"),
            ("HF_TOKEN", " hf_abc\n"),
            ("HF_HUB_OFFLINE", "1"),
        ])
        .unwrap();
        assert_eq!((s.root, s.hub_cache), ("/m".into(), Some("/hf/hub".into())));
        assert_eq!((s.endpoint.as_str(), s.token.as_deref()), ("http://mirror:8080/hub", Some("hf_abc")));
        assert!(s.offline);
    }

    #[test]
    fn invalid_settings_are_refused_and_a_token_is_never_shown() {
        for endpoint in ["huggingface.co", "ftp://x", "https://", "https:///x", "https://a b", "https://u@h"]
        {
            assert!(settings(&[("HOME", "/h"), ("HF_ENDPOINT", endpoint)]).is_err(), "{endpoint}");
        }
        assert!(settings(&[]).unwrap_err().to_string().contains("VIDAR_MODELS"));
        assert!(settings(&[("HOME", "/h"), ("VIDAR_OFFLINE", "maybe")]).is_err());
        let refused = settings(&[("HOME", "/h"), ("HF_TOKEN", "se cret")]).unwrap_err();
        assert!(!format!("{refused} {refused:?}").contains("cret"));
        let shown = format!("{:?}", settings(&[("HOME", "/h"), ("HF_TOKEN", "secret")]).unwrap());
        assert!(!shown.contains("secret"), "{shown}");
    }
}
