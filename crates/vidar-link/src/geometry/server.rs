//! The worker's side: bytes in, bytes out.

use super::message::{Hello, HelloRequest, ModelFacts, Outcome, PredictReply, PredictRequest};
use crate::envelope::PROTOCOL;
use crate::error::WireError;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use vidar_core::{ChunkViews, GeometryPrediction, Watch};

/// What a worker serves. Both functions may be called at the same time.
pub trait Served: Send + Sync {
    /// Which model it is with these settings (JSON).
    ///
    /// # Errors
    /// Why it cannot be used with them, in words.
    fn facts(&self, settings: &str) -> Result<ModelFacts, String>;

    /// Predicts the views `wanted` of a chunk.
    ///
    /// # Errors
    /// What the model says; another worker would say the same.
    fn predict(
        &self,
        settings: &str,
        wants_tokens: bool,
        views: &ChunkViews,
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<Predicted, String>;
}

/// A prediction with the tokens of its views; none where they were not wanted.
#[derive(Clone, Debug)]
pub struct Predicted {
    /// The geometry.
    pub geometry: GeometryPrediction,
    /// As many numbers for each view.
    pub tokens: Vec<Vec<f32>>,
}

/// A reply, and how many keyframes were predicted for it.
#[derive(Clone, Debug)]
pub struct Answer {
    /// The reply.
    pub bytes: Vec<u8>,
    /// Keyframes with geometry.
    pub keyframes: usize,
    /// Why there is no geometry.
    pub problem: Option<String>,
}

/// Answers the first question; `queue` requests wait.
///
/// # Errors
/// The question is none of this protocol.
pub fn answer_hello(
    bytes: &[u8],
    served: &dyn Served,
    (worker, program): (&str, &str),
    queue: usize,
) -> Result<Vec<u8>, WireError> {
    let request = HelloRequest::decode(bytes)?;
    let hello = Hello {
        protocol: PROTOCOL,
        program: program.to_owned(),
        worker: worker.to_owned(),
        queue: queue as u32,
        model: served.facts(&request.settings),
    };
    hello.encode()
}

/// Answers a request. Whatever it is, there is an answer, and the worker goes on: a panic of the model or of a decoder is one of the
/// request.
pub fn answer_predict(bytes: &[u8], served: &dyn Served, queue: usize, watch: Watch<'_>) -> Answer {
    let request = match catch_unwind(AssertUnwindSafe(|| PredictRequest::decode(bytes))) {
        Ok(Ok(request)) => request,
        Ok(Err(error)) => return refusal((0, 0), queue, error.to_string()),
        Err(_) => return refusal((0, 0), queue, "an image cannot be decoded".into()),
    };
    let numbers = (request.run, request.number);
    let outcome = match catch_unwind(AssertUnwindSafe(|| work(&request, served, watch))) {
        Ok(outcome) => outcome,
        Err(_) => return refusal(numbers, queue, "the model stopped at a bug".into()),
    };
    let (keyframes, problem) = match &outcome {
        Outcome::Predicted(geometry, _) => (geometry.views.len(), None),
        Outcome::ModelFailed(why) | Outcome::Refused(why) => (0, Some(why.clone())),
        Outcome::Busy => (0, None),
    };
    let reply = PredictReply { run: numbers.0, number: numbers.1, queue: queue as u32, outcome };
    match reply.encode(request.depth) {
        Ok(bytes) => Answer { bytes, keyframes, problem },
        Err(error) => refusal(numbers, queue, error.to_string()),
    }
}

fn work(request: &PredictRequest, served: &dyn Served, watch: Watch<'_>) -> Outcome {
    let facts = match served.facts(&request.settings) {
        Ok(facts) => facts,
        Err(why) => return Outcome::Refused(why),
    };
    if facts.info.weights_sha256 != request.weights_sha256 {
        let words = |hash: &Option<String>| hash.clone().unwrap_or_else(|| "none".into());
        let (found, asked) = (words(&facts.info.weights_sha256), words(&request.weights_sha256));
        return Outcome::Refused(format!("the weights here have the hash {found}, asked for was {asked}"));
    }
    let (settings, wanted) = (&request.settings, request.wanted.clone());
    match served.predict(settings, request.wants_tokens, &request.views, wanted, watch) {
        Ok(Predicted { geometry, tokens }) => Outcome::Predicted(geometry, tokens),
        Err(why) => Outcome::ModelFailed(why),
    }
}

/// How long the sender of a request waits; what is no request is answered at once.
#[cfg(feature = "zenoh")]
pub(crate) fn patience_of(bytes: &[u8]) -> std::time::Duration {
    PredictRequest::decode_patience_ms(bytes)
        .map_or(std::time::Duration::MAX, std::time::Duration::from_millis)
}

/// The answer of a worker with too many requests.
#[cfg(feature = "zenoh")]
pub(crate) fn busy(bytes: &[u8], queue: usize) -> Vec<u8> {
    let numbers = PredictRequest::decode_numbers(bytes).unwrap_or((0, 0));
    let (run, number) = numbers;
    let reply = PredictReply { run, number, queue: queue as u32, outcome: Outcome::Busy };
    reply.encode(Default::default()).unwrap_or_default()
}

fn refusal((run, number): (u64, u64), queue: usize, why: String) -> Answer {
    let outcome = Outcome::Refused(why.clone());
    let reply = PredictReply { run, number, queue: queue as u32, outcome };
    Answer { bytes: reply.encode(Default::default()).unwrap_or_default(), keyframes: 0, problem: Some(why) }
}
