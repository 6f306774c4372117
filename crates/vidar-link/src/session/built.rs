//! Sessions by Zenoh, with plain calls.

use super::waiting::Waiting;
use super::{Delivery, LinkOptions, Role, Sample, Serving, settings};
use crate::error::LinkError;
use crate::geometry::{AskError, Reach, Served, answer_hello, answer_predict, busy, patience_of};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, TrySendError, sync_channel};
use std::time::{Duration, Instant};
use zenoh::handlers::FifoChannel;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};
use zenoh::{Session, Wait};

/// Requests that wait at a worker; further ones are told that it is busy.
const QUEUE: usize = 4;
/// How often waits look whether they should go on.
const STEP: Duration = Duration::from_millis(50);
/// A session.
pub struct Link {
    session: Session,
    /// Where it listens.
    endpoints: Vec<String>,
}

fn transport(action: impl Into<String>) -> impl FnOnce(zenoh::Error) -> LinkError {
    let action = action.into();
    move |e| LinkError::Transport { action, reason: e.to_string() }
}

impl Link {
    /// Opens a session. Connections are made, and made again when they break, in the background.
    ///
    /// # Errors
    /// A setting that cannot be used, or an endpoint that cannot be listened at.
    pub fn open(options: &LinkOptions, role: Role) -> Result<Self, LinkError> {
        let (config, endpoints) = settings::config(options, role)?;
        let session = zenoh::open(config).wait().map_err(transport("cannot open the link"))?;
        Ok(Self { session, endpoints })
    }

    /// The session's identity.
    pub fn id(&self) -> [u8; 16] {
        self.session.zid().to_le_bytes()
    }

    /// The way to the workers under a key; it keeps the session.
    ///
    /// # Errors
    /// A key that is none.
    pub fn reach(self, key: &str) -> Result<Box<dyn Reach>, LinkError> {
        plain(key)?;
        Ok(Box::new(Workers { session: self.session, key: key.to_owned() }))
    }

    /// Answers requests under a key until `stop`, one after the other on this thread; `told` hears of each.
    ///
    /// # Errors
    /// A key that is none, or the session failed.
    pub fn serve(
        &self,
        key: &str,
        program: &str,
        served: Arc<dyn Served>,
        told: &dyn Fn(Serving),
        stop: &(dyn Fn() -> bool + Sync),
    ) -> Result<(), LinkError> {
        plain(key)?;
        let worker = self.session.zid().to_string();
        let queue = Arc::new(AtomicUsize::new(0));
        let hello_key = format!("{key}/{worker}/hello");
        let hello = {
            let (served, queue) = (served.clone(), queue.clone());
            let (worker, program, own) = (worker.clone(), program.to_owned(), hello_key.clone());
            move |query: Query| {
                let question = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
                let waiting = queue.load(Ordering::Relaxed);
                // What is no question of ours gets no answer.
                if let Ok(answer) = answer_hello(&question, served.as_ref(), (&worker, &program), waiting) {
                    let _ = query.reply(own.clone(), answer).wait();
                }
            }
        };
        let (sender, requests) = sync_channel::<(Query, Instant)>(QUEUE);
        let predict_key = format!("{key}/{worker}/predict");
        let predict = {
            let (queue, own) = (queue.clone(), predict_key.clone());
            move |query: Query| {
                queue.fetch_add(1, Ordering::Relaxed);
                if let Err(TrySendError::Full((query, _)) | TrySendError::Disconnected((query, _))) =
                    sender.try_send((query, Instant::now()))
                {
                    let waiting = queue.fetch_sub(1, Ordering::Relaxed);
                    let request = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
                    let _ = query.reply(own.clone(), busy(&request, waiting)).wait();
                }
            }
        };
        let declare = || format!("cannot answer under {key}");
        let declared = self.session.declare_queryable(predict_key.clone()).callback(predict).wait();
        let _predict = declared.map_err(transport(declare()))?;
        let declared = self.session.declare_queryable(hello_key).callback(hello).wait();
        let _hello = declared.map_err(transport(declare()))?;
        told(Serving::Ready { worker, endpoints: self.endpoints.clone() });
        while !stop() {
            let (query, arrived) = match requests.recv_timeout(STEP) {
                Ok(request) => request,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            let request = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            if arrived.elapsed() > patience_of(&request) {
                queue.fetch_sub(1, Ordering::Relaxed);
                told(Serving::TooLate);
                continue;
            }
            let clock = Instant::now();
            let waiting = queue.load(Ordering::Relaxed).saturating_sub(1);
            let answer = answer_predict(&request, served.as_ref(), waiting, &|_| stop());
            queue.fetch_sub(1, Ordering::Relaxed);
            let (sent, received) = (answer.bytes.len(), request.len());
            if !stop() {
                // A sender that has gone does not hear it; another worker serves it by now.
                let _ = query.reply(predict_key.clone(), answer.bytes).wait();
            }
            let (keyframes, problem) = (answer.keyframes, answer.problem);
            told(Serving::Answered { keyframes, took: clock.elapsed(), received, sent, problem });
        }
        Ok(())
    }

    /// Messages under a key expression, in the order in which they come.
    ///
    /// # Errors
    /// An expression that is none.
    pub fn subscribe(&self, expression: &str) -> Result<Subscription, LinkError> {
        checked(expression)?;
        let waiting = Arc::new(Waiting::default());
        let taken = waiting.clone();
        let subscriber = self
            .session
            .declare_subscriber(expression.to_owned())
            .callback(move |sample| {
                taken.add(Sample {
                    key: sample.key_expr().to_string(),
                    payload: sample.payload().to_bytes().into_owned(),
                    attachment: sample.attachment().map(|a| a.to_bytes().into_owned()),
                });
            })
            .wait()
            .map_err(transport(format!("cannot subscribe to {expression}")))?;
        Ok(Subscription { waiting, _subscriber: subscriber, _session: self.session.clone() })
    }

    /// Messages to a key, and the token by which others see that there is a publisher.
    ///
    /// # Errors
    /// A key that is none.
    pub fn publisher(
        &self,
        key: &str,
        token: Option<&str>,
        delivery: Delivery,
    ) -> Result<Publisher, LinkError> {
        checked(key)?;
        let failed = || format!("cannot publish to {key}");
        let publisher = self.session.declare_publisher(key.to_owned());
        let control = match delivery {
            Delivery::Drop => CongestionControl::Drop,
            Delivery::Wait => CongestionControl::Block,
        };
        let publisher = publisher.congestion_control(control).express(true).wait();
        let publisher = publisher.map_err(transport(failed()))?;
        let token = token.map(|t| self.session.liveliness().declare_token(t.to_owned()).wait());
        let _token = token.transpose().map_err(transport(failed()))?;
        Ok(Publisher { publisher, _token })
    }
}

/// A key that is no expression: it is one place.
fn plain(key: &str) -> Result<(), LinkError> {
    checked(key)?;
    match key.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c)) {
        true => Ok(()),
        false => {
            let reason = "letters, digits, `_`, `-`, `.` and `/` expected".into();
            Err(LinkError::BadSetting { what: format!("key {key:?}"), reason })
        }
    }
}

fn checked(key: &str) -> Result<(), LinkError> {
    let found = zenoh::key_expr::KeyExpr::try_from(key.to_owned());
    found
        .map(|_| ())
        .map_err(|e| LinkError::BadSetting { what: format!("key {key:?}"), reason: e.to_string() })
}

struct Workers {
    session: Session,
    key: String,
}

impl Reach for Workers {
    fn key(&self) -> &str {
        &self.key
    }

    fn greet(&mut self, question: &[u8], within: Duration) -> Result<Vec<Vec<u8>>, LinkError> {
        let asked = self.session.get(format!("{}/*/hello", self.key)).payload(question.to_vec());
        let asked = asked.target(QueryTarget::All).consolidation(ConsolidationMode::None).timeout(within);
        let asked = asked.with(FifoChannel::new(256)).wait();
        let answers = asked.map_err(transport(format!("cannot ask under {}", self.key)))?;
        let end = Instant::now() + within;
        let mut found = Vec::new();
        while let Ok(Some(reply)) = answers.recv_deadline(end) {
            found.extend(reply.result().ok().map(|s| s.payload().to_bytes().into_owned()));
        }
        Ok(found)
    }

    fn ask(
        &mut self,
        worker: &str,
        request: &[u8],
        within: Duration,
        stop: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, AskError> {
        let asked = self.session.get(format!("{}/{worker}/predict", self.key)).payload(request.to_vec());
        let asked = asked.target(QueryTarget::All).consolidation(ConsolidationMode::None).timeout(within);
        let answers = asked.with(FifoChannel::new(8)).wait().map_err(|_| AskError::Gone)?;
        let clock = Instant::now();
        loop {
            match answers.recv_timeout(STEP) {
                Ok(Some(reply)) => match reply.result() {
                    Ok(sample) => return Ok(sample.payload().to_bytes().into_owned()),
                    Err(_) => return Err(AskError::Late),
                },
                Ok(None) if stop() => return Err(AskError::Cancelled),
                Ok(None) if clock.elapsed() > within => return Err(AskError::Late),
                Ok(None) => {}
                // All that could have answered have said that they do not.
                Err(_) => return Err(AskError::Gone),
            }
        }
    }
}

/// Messages to a key.
pub struct Publisher {
    publisher: zenoh::pubsub::Publisher<'static>,
    _token: Option<LivelinessToken>,
}

impl Publisher {
    /// Sends a message, or drops it where nobody keeps up.
    ///
    /// # Errors
    /// The session is closed.
    pub fn put(&self, payload: Vec<u8>, attachment: Vec<u8>) -> Result<(), LinkError> {
        let sent = self.publisher.put(payload).attachment(attachment).wait();
        sent.map_err(transport("cannot publish"))
    }
}

/// Messages under a key expression.
pub struct Subscription {
    waiting: Arc<Waiting>,
    _subscriber: Subscriber<()>,
    _session: Session,
}

impl Subscription {
    /// The next message, waited for up to a time.
    pub fn next(&self, within: Duration) -> Option<Sample> {
        self.waiting.take(within)
    }

    /// Messages left out because nobody took them in time.
    pub fn dropped(&self) -> u64 {
        self.waiting.dropped()
    }
}
