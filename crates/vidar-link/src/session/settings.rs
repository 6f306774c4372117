//! Settings of a session: loopback, no scouting, bounded messages; what the user's file says comes over them.

use super::{DEFAULT_ENDPOINT, LinkOptions, Role};
use crate::envelope::MAX_MESSAGE_BYTES;
use crate::error::LinkError;
use serde_json::{Value, json};

/// The longest file of settings, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Zenoh's configuration, and the endpoints that it listens at.
pub(super) fn config(options: &LinkOptions, role: Role) -> Result<(zenoh::Config, Vec<String>), LinkError> {
    let made = settings(options, role)?;
    let listed = made["listen"]["endpoints"].as_array().into_iter().flatten();
    let endpoints = listed.filter_map(|e| e.as_str().map(str::to_owned)).collect();
    let config = zenoh::Config::from_json5(&made.to_string()).map_err(|e| LinkError::BadSetting {
        what: options.config.as_ref().map_or_else(|| "endpoints".into(), |p| p.display().to_string()),
        reason: e.to_string(),
    })?;
    Ok((config, endpoints))
}

fn settings(options: &LinkOptions, role: Role) -> Result<Value, LinkError> {
    let mut base = json!({
        "mode": "peer",
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "listen": { "endpoints": [] },
        "connect": {
            "endpoints": [], "timeout_ms": -1, "exit_on_failure": false,
            "retry": { "period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2 },
        },
        "transport": { "link": { "rx": { "max_message_size": MAX_MESSAGE_BYTES + (1 << 20) } } },
    });
    let mut names_endpoints = !(options.listen.is_empty() && options.connect.is_empty());
    if let Some(path) = &options.config {
        let io = |source| LinkError::File { path: path.clone(), source };
        let length = std::fs::metadata(path).map_err(io)?.len();
        let bad = |reason: String| LinkError::BadSetting { what: path.display().to_string(), reason };
        if length > MAX_FILE_BYTES {
            return Err(bad(format!("{length} bytes, at most {MAX_FILE_BYTES} are read")));
        }
        let text = std::fs::read_to_string(path).map_err(io)?;
        let given: Value = json5::from_str(&text).map_err(|e| bad(e.to_string()))?;
        if !given.is_object() {
            return Err(bad("an object expected, as in Zenoh's DEFAULT_CONFIG.json5".into()));
        }
        names_endpoints |= ["listen", "connect"].iter().any(|k| given.get(k).is_some());
        merge(&mut base, given);
    }
    for (key, given) in [("listen", &options.listen), ("connect", &options.connect)] {
        if !given.is_empty() {
            base[key]["endpoints"] = json!(given);
        }
    }
    if !names_endpoints {
        let key = if role == Role::Server { "listen" } else { "connect" };
        base[key]["endpoints"] = json!([DEFAULT_ENDPOINT]);
    }
    Ok(base)
}

/// Objects are merged, everything else is replaced.
fn merge(base: &mut Value, over: Value) {
    match (base, over) {
        (Value::Object(base), Value::Object(over)) => {
            for (key, value) in over {
                merge(base.entry(key).or_insert(Value::Null), value);
            }
        }
        (base, over) => *base = over,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_but_this_computer_unless_told_otherwise() {
        let server = settings(&LinkOptions::default(), Role::Server).unwrap();
        assert_eq!(server["listen"]["endpoints"], json!([DEFAULT_ENDPOINT]));
        assert_eq!(server["connect"]["endpoints"], json!([]));
        let client = settings(&LinkOptions::default(), Role::Client).unwrap();
        assert_eq!(client["listen"]["endpoints"], json!([]));
        assert_eq!(client["connect"]["endpoints"], json!([DEFAULT_ENDPOINT]));
        let given = LinkOptions { listen: vec!["tcp/0.0.0.0:7".into()], ..LinkOptions::default() };
        let told = settings(&given, Role::Client).unwrap();
        assert_eq!(told["listen"]["endpoints"], json!(["tcp/0.0.0.0:7"]));
        assert_eq!(told["connect"]["endpoints"], json!([]));
        for made in [&server, &client, &told] {
            for kind in ["multicast", "gossip"] {
                assert_eq!(made["scouting"][kind]["enabled"], false);
            }
            zenoh::Config::from_json5(&made.to_string()).unwrap();
        }
    }

    #[test]
    fn a_file_comes_over_the_defaults_and_leaves_the_others() {
        let path = std::env::temp_dir().join(format!("vidar-link-{}.json5", std::process::id()));
        let options = LinkOptions { config: Some(path.clone()), ..LinkOptions::default() };
        std::fs::write(&path, "{ /* x */ connect: { endpoints: ['tls/host:7447'] }, mode: 'client' }")
            .unwrap();
        let made = settings(&options, Role::Client).unwrap();
        assert_eq!(made["connect"]["endpoints"], json!(["tls/host:7447"]));
        assert_eq!((&made["mode"], &made["connect"]["timeout_ms"]), (&json!("client"), &json!(-1)));
        assert_eq!(made["scouting"]["multicast"]["enabled"], false);
        std::fs::write(&path, "{ no_such_key: 1 }").unwrap();
        assert!(matches!(config(&options, Role::Client), Err(LinkError::BadSetting { .. })));
        std::fs::write(&path, "[]").unwrap();
        assert!(matches!(config(&options, Role::Client), Err(LinkError::BadSetting { .. })));
        std::fs::remove_file(&path).unwrap();
        assert!(matches!(config(&options, Role::Client), Err(LinkError::File { .. })));
    }
}
