//! Settings of what goes between machines.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What goes between a run and the workers of `geometry.source = "remote:KEY"`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RemoteConfig {
    /// The model that the workers must have: one of `vidar model list`. Empty: any that all of them agree on, whose hash and licence are
    /// recorded. A name that is known must come with its known hash and licence.
    pub model: String,
    /// How images travel: `raw`, the worker sees the same bits, or `jpeg` (quality 92), about a tenth of the bytes and another map.
    #[schemars(with = "String")]
    pub images: vidar_link::geometry::ImageFormat,
    /// How depth and confidence travel: `f32`, the bits of the same model on this machine, or `f16`, half the bytes with a relative error of
    /// at most 5e-4.
    #[schemars(with = "String")]
    pub depth: vidar_link::geometry::DepthFormat,
}

/// How other machines are reached. Nothing here changes a result, and an interrupted run may be resumed with other values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinkConfig {
    /// Endpoints to connect to, separated by commas, such as `tls/server:7447`. Empty, with `listen` and `config` empty, too: this computer
    /// (`tcp/127.0.0.1:7447`).
    pub connect: String,
    /// Endpoints to listen at, separated by commas, such as `tcp/0.0.0.0:7447`.
    pub listen: String,
    /// A file of Zenoh's settings (JSON5): TLS, certificates, access control.
    pub config: String,
    /// Where `vidar live` publishes poses, keyframes, cloud, mesh and health as ROS 2 messages: domain and namespace, such as `0/vidar`. Empty:
    /// nowhere.
    pub publish: String,
    /// After this time (s) without an answer a worker counts as slow and another one is asked. Several times as long as a chunk takes there.
    pub timeout_secs: f64,
    /// How long (s) a worker is waited for at the start, and while none answers.
    pub patience_secs: f64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        let (connect, listen, config, publish) = Default::default();
        Self { connect, listen, config, publish, timeout_secs: 120.0, patience_secs: 10.0 }
    }
}

impl LinkConfig {
    /// As a session takes it.
    pub fn options(&self) -> vidar_link::LinkOptions {
        let list = |text: &str| {
            text.split(',').map(str::trim).filter(|t| !t.is_empty()).map(str::to_owned).collect()
        };
        vidar_link::LinkOptions {
            listen: list(&self.listen),
            connect: list(&self.connect),
            config: (!self.config.is_empty()).then(|| self.config.clone().into()),
        }
    }
}
