//! What went over the link.

use super::pixels::{DepthFormat, ImageFormat};
use serde::Serialize;
use std::collections::BTreeMap;

/// What went over the link.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RemoteReport {
    /// The key.
    pub key: String,
    /// How the images travelled.
    pub images: ImageFormat,
    /// How depth travelled.
    pub depth: DepthFormat,
    /// Requests that were answered with geometry.
    pub chunks: usize,
    /// Keyframes that came back with geometry.
    pub keyframes: usize,
    /// Requests that another worker had to be asked for: gone, slow, or without a usable answer.
    pub retries: usize,
    /// Of those, answers that were no valid answers.
    pub invalid_replies: usize,
    /// To workers, bytes, retries included.
    pub bytes_sent: u64,
    /// From workers, bytes.
    pub bytes_received: u64,
    /// Both over the keyframes.
    pub bytes_per_keyframe: u64,
    /// Chunks that each worker answered.
    pub workers: BTreeMap<String, usize>,
}

impl RemoteReport {
    /// With what went over another link to the same workers.
    pub fn and(mut self, other: &Self) -> Self {
        self.chunks += other.chunks;
        self.keyframes += other.keyframes;
        self.retries += other.retries;
        self.invalid_replies += other.invalid_replies;
        self.bytes_sent += other.bytes_sent;
        self.bytes_received += other.bytes_received;
        for (worker, chunks) in &other.workers {
            *self.workers.entry(worker.clone()).or_default() += chunks;
        }
        self.bytes_per_keyframe = (self.bytes_sent + self.bytes_received) / (self.keyframes.max(1) as u64);
        self
    }

    /// In words.
    pub fn words(&self) -> String {
        format!(
            "{} chunks from {} workers under {}, {} retries, {} kB per keyframe",
            self.chunks,
            self.workers.len(),
            self.key,
            self.retries,
            self.bytes_per_keyframe / 1000
        )
    }
}
