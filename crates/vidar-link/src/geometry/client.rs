//! The engine's side: one model, though several workers answer for it.

use super::message::{Hello, HelloRequest, ModelFacts, Outcome, PredictReply, PredictRequest};
use super::pixels::{DepthFormat, ImageFormat};
use super::reach::{AskError, Reach};
use super::report::RemoteReport;
use super::server::Predicted;
use crate::envelope::PROTOCOL;
use crate::error::LinkError;
use std::collections::BTreeMap;
use std::ops::Range;
use std::time::{Duration, Instant};
use vidar_core::{ChunkViews, ModelError, Watch};

/// How long workers are waited for at the start, and while none answers.
const GREETING: Duration = Duration::from_secs(2);
/// How often all workers may fail at one chunk before the run is told.
const MOST_ROUNDS: usize = 3;
/// Pause before workers that were busy, or all failed, are asked again.
const PAUSE: Duration = Duration::from_millis(200);
/// What is known of the workers is asked again when it is older than this.
const NEWS: Duration = Duration::from_secs(5);
/// The most workers that are known at a time.
const MOST_WORKERS: usize = 256;

/// The model that is asked for; what is empty may be anything that all workers agree on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Expected {
    /// Its name.
    pub name: Option<String>,
    /// Hash of its weights.
    pub weights_sha256: Option<String>,
}

/// How workers are asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteOptions {
    /// How the model is to be used (JSON).
    pub settings: String,
    /// The model that is asked for.
    pub expected: Expected,
    /// How images travel.
    pub images: ImageFormat,
    /// How depth travels.
    pub depth: DepthFormat,
    /// After this time a worker counts as slow, and another is asked.
    pub timeout: Duration,
    /// How long at least one worker is waited for, at the start and when all are gone.
    pub patience: Duration,
    /// A random number that tells this run's requests from those of others.
    pub run: u64,
    /// Of equally busy workers the one of this number is asked first: several links of one run begin with different ones.
    pub rank: usize,
}

struct Known {
    name: String,
    queue: u32,
    /// Number of the request that it was last asked.
    last: u64,
}

/// Workers that answered, with their model or why they cannot use it so.
type Found = Vec<(Known, Result<ModelFacts, String>)>;

/// A model whose predictions are made elsewhere.
pub struct RemoteModel {
    reach: Box<dyn Reach>,
    options: RemoteOptions,
    facts: ModelFacts,
    workers: Vec<Known>,
    number: u64,
    /// When all were last asked who is there.
    greeted: Instant,
    report: RemoteReport,
}

impl RemoteModel {
    /// Finds workers, and checks protocol, model, hash and licence of each before the first prediction.
    ///
    /// # Errors
    /// [`LinkError::NoWorker`] where none answers within the patience; [`LinkError::OtherModel`] where none has the model that is
    /// asked for, or they differ and nothing is asked for.
    pub fn open(
        reach: Box<dyn Reach>,
        options: RemoteOptions,
        stop: &dyn Fn() -> bool,
    ) -> Result<Self, LinkError> {
        let key = reach.key().to_owned();
        let report =
            RemoteReport { key, images: options.images, depth: options.depth, ..RemoteReport::default() };
        let mut this = Self {
            reach,
            options,
            facts: unknown(),
            workers: Vec::new(),
            number: 0,
            greeted: Instant::now(),
            report,
        };
        let found = this.wait_for(stop)?;
        let (usable, others): (Vec<_>, Vec<_>) =
            found.into_iter().partition(|(_, facts)| facts.as_ref().is_ok_and(|f| this.is_expected(f)));
        let words = |(worker, facts): &(Known, Result<ModelFacts, String>)| match facts {
            Ok(f) => format!(
                "{} has {} ({}, weights {})",
                worker.name,
                vidar_core::printable(&f.model),
                vidar_core::printable(&f.licence),
                f.info.weights_sha256.as_deref().unwrap_or("none")
            ),
            Err(why) => format!("{}: {}", worker.name, vidar_core::printable(why)),
        };
        let other = |reason: String| LinkError::OtherModel { key: this.report.key.clone(), reason };
        let Some((_, Ok(first))) = usable.first() else {
            let listed: Vec<String> = others.iter().map(words).collect();
            let Expected { name, weights_sha256 } = &this.options.expected;
            let asked = name.as_deref().or(weights_sha256.as_deref()).unwrap_or("any model");
            return Err(other(format!("asked for was {asked}; {}", listed.join("; "))));
        };
        let facts = first.clone();
        if let Some(differs) = usable.iter().find(|(_, f)| f.as_ref().is_ok_and(|f| *f != facts)) {
            return Err(other(format!("they differ: {}; {}", words(&usable[0]), words(differs))));
        }
        this.facts = facts;
        this.workers = usable.into_iter().map(|(known, _)| known).collect();
        Ok(this)
    }

    /// The model, as all its workers state it.
    pub fn facts(&self) -> &ModelFacts {
        &self.facts
    }

    /// Workers that are known now.
    pub fn workers(&self) -> usize {
        self.workers.len()
    }

    /// What went over the link so far.
    pub fn report(&self) -> RemoteReport {
        self.report.clone().and(&RemoteReport::default())
    }

    fn is_expected(&self, facts: &ModelFacts) -> bool {
        let Expected { name, weights_sha256 } = &self.options.expected;
        name.as_ref().is_none_or(|n| *n == facts.model)
            && (weights_sha256.is_none() || *weights_sha256 == facts.info.weights_sha256)
    }

    /// All workers that answer now. What is no answer of this protocol counts as none.
    fn greet(&mut self) -> Result<Found, LinkError> {
        let question = HelloRequest { protocol: PROTOCOL, settings: self.options.settings.clone() };
        let bad = |e: crate::WireError| LinkError::BadSetting {
            what: "the model's settings".into(),
            reason: e.to_string(),
        };
        let answers = self.reach.greet(&question.encode().map_err(bad)?, GREETING)?;
        let mut found: BTreeMap<String, (Known, Result<ModelFacts, String>)> = BTreeMap::new();
        for hello in answers.iter().take(MOST_WORKERS).filter_map(|bytes| Hello::decode(bytes).ok()) {
            let last = self.workers.iter().find(|w| w.name == hello.worker).map_or(0, |w| w.last);
            let known = Known { name: hello.worker.clone(), queue: hello.queue, last };
            found.insert(hello.worker, (known, hello.model));
        }
        self.greeted = Instant::now();
        Ok(found.into_values().collect())
    }

    /// As [`Self::greet`], for as long as the patience lasts.
    fn wait_for(&mut self, stop: &dyn Fn() -> bool) -> Result<Found, LinkError> {
        let clock = Instant::now();
        loop {
            let found = self.greet()?;
            if !found.is_empty() {
                return Ok(found);
            }
            if stop() {
                return Err(LinkError::Cancelled);
            }
            if clock.elapsed() >= self.options.patience {
                let reason = format!("nobody said a word for {} s", self.options.patience.as_secs());
                return Err(LinkError::NoWorker { key: self.report.key.clone(), reason });
            }
            std::thread::sleep(PAUSE);
        }
    }

    /// Looks again who is there; a worker with another model is not one of ours.
    fn refresh(&mut self, stop: &dyn Fn() -> bool) -> Result<(), ModelError> {
        let found = self.wait_for(stop).map_err(|error| match error {
            LinkError::Cancelled => ModelError::Cancelled,
            other => ModelError::OutOfReach(other.to_string()),
        })?;
        self.keep_ours(found);
        Ok(())
    }

    fn keep_ours(&mut self, found: Found) {
        let ours = |(known, facts): (Known, Result<ModelFacts, String>)| {
            facts.is_ok_and(|f| f == self.facts).then_some(known)
        };
        self.workers = found.into_iter().filter_map(ours).collect();
    }

    /// Predicts the views `wanted` at one worker, at another one where that fails.
    ///
    /// # Errors
    /// [`ModelError::OutOfReach`] where no worker answers any more; the model's own error where every worker that answers has one;
    /// [`ModelError::Cancelled`].
    pub fn predict(
        &mut self,
        views: &ChunkViews,
        wanted: Range<usize>,
        wants_tokens: bool,
        watch: Watch<'_>,
    ) -> Result<Predicted, ModelError> {
        let stop = || watch(0.0);
        self.number += 1;
        let request = PredictRequest {
            run: self.options.run,
            number: self.number,
            patience_ms: self.options.timeout.as_millis() as u64,
            settings: self.options.settings.clone(),
            weights_sha256: self.facts.info.weights_sha256.clone(),
            wants_tokens,
            depth: self.options.depth,
            views: views.clone(),
            wanted,
        };
        let bytes =
            request.encode(self.options.images).map_err(|error| ModelError::Other(error.to_string()))?;
        if self.greeted.elapsed() > NEWS
            && let Ok(found) = self.greet()
            && !found.is_empty()
        {
            // Workers that came since, and how busy each is.
            self.keep_ours(found);
        }
        let clock = Instant::now();
        let (mut rounds, mut reasons) = (0, Vec::new());
        loop {
            let (mut tried, mut is_busy): (Vec<String>, bool) = (Vec::new(), false);
            let mut model_error = None;
            while let Some(worker) = self.next(&tried) {
                tried.push(worker.clone());
                match self.ask(&worker, &bytes, &request, &stop)? {
                    Tried::Predicted(predicted) => return Ok(predicted),
                    Tried::Failed(why) => {
                        self.report.retries += 1;
                        reasons.push(format!("{worker} {why}"));
                    }
                    Tried::Busy => is_busy = true,
                    Tried::ModelFailed(why) => model_error = Some(why),
                }
            }
            // One device may be out of memory where another is not; what fails everywhere is the model's own error.
            if let Some(why) = model_error.filter(|_| !is_busy) {
                return Err(ModelError::Other(why));
            }
            // Where all are only busy, they are there, and their queues get shorter.
            let waits = is_busy && clock.elapsed() < self.options.timeout * 10;
            rounds += usize::from(!tried.is_empty() && !waits);
            if rounds >= MOST_ROUNDS {
                reasons.drain(..reasons.len().saturating_sub(8));
                return Err(ModelError::OutOfReach(format!(
                    "no worker under {} answered in {MOST_ROUNDS} rounds: {}",
                    self.report.key,
                    reasons.join(", ")
                )));
            }
            if watch(0.0) {
                return Err(ModelError::Cancelled);
            }
            if rounds > 0 || waits || self.workers.is_empty() {
                std::thread::sleep(PAUSE);
            }
            self.refresh(&stop)?;
            if self.workers.is_empty() && clock.elapsed() > self.options.patience {
                let key = &self.report.key;
                let reason = format!("the workers under {key} now have another model than before");
                return Err(ModelError::OutOfReach(reason));
            }
        }
    }

    /// The worker with the fewest requests, of several the one that was asked longest ago.
    fn next(&self, tried: &[String]) -> Option<String> {
        let count = self.workers.len();
        let turn = |number: usize| (number + count - self.options.rank % count.max(1)) % count.max(1);
        let free = self.workers.iter().enumerate().filter(|(_, w)| !tried.contains(&w.name));
        free.min_by_key(|(number, w)| (w.queue, w.last, turn(*number))).map(|(_, w)| w.name.clone())
    }

    fn ask(
        &mut self,
        worker: &str,
        bytes: &[u8],
        request: &PredictRequest,
        stop: &dyn Fn() -> bool,
    ) -> Result<Tried, ModelError> {
        self.report.bytes_sent += bytes.len() as u64;
        let answer = self.reach.ask(worker, bytes, self.options.timeout, stop);
        let mut queue = u32::MAX;
        let tried = match answer {
            Err(AskError::Cancelled) => return Err(ModelError::Cancelled),
            Err(AskError::Gone) => Tried::Failed("is gone".into()),
            Err(AskError::Late) => {
                Tried::Failed(format!("took more than {:.1} s", self.options.timeout.as_secs_f64()))
            }
            Ok(answer) => {
                self.report.bytes_received += answer.len() as u64;
                match PredictReply::decode(&answer, request) {
                    Err(error) => {
                        self.report.invalid_replies += 1;
                        Tried::Failed(format!("gave no valid answer: {error}"))
                    }
                    Ok(reply) => {
                        queue = reply.queue;
                        match reply.outcome {
                            Outcome::Predicted(geometry, tokens) => {
                                self.report.chunks += 1;
                                self.report.keyframes += geometry.views.len();
                                *self.report.workers.entry(worker.to_owned()).or_default() += 1;
                                Tried::Predicted(Predicted { geometry, tokens })
                            }
                            Outcome::ModelFailed(why) => Tried::ModelFailed(why),
                            Outcome::Refused(why) => Tried::Failed(format!("refused: {why}")),
                            Outcome::Busy => Tried::Busy,
                        }
                    }
                }
            }
        };
        let number = self.number;
        for known in self.workers.iter_mut().filter(|w| w.name == worker) {
            (known.queue, known.last) = (queue, number);
        }
        Ok(tried)
    }
}

/// Before anybody has answered.
fn unknown() -> ModelFacts {
    let (name, licence) = Default::default();
    let info =
        vidar_core::ModelInfo { name, licence, weights_sha256: None, needs_poses: false, min_views: 1 };
    let (model, licence, arithmetic) = Default::default();
    ModelFacts { model, licence, info, token_channels: None, arithmetic }
}

enum Tried {
    Predicted(Predicted),
    Failed(String),
    Busy,
    /// The model there gave an error.
    ModelFailed(String),
}
