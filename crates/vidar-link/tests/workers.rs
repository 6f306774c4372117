//! The engine's side among workers that are gone, slow, busy, wrong or malicious: no chunk is lost while one lives, and nothing but the
//! right answer to the right question gets through.
#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use common::{Brightness, HEIGHT, WIDTH, chunk, facts, local, same_bits};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use vidar_core::{ChunkViews, ModelError, Se3};
use vidar_link::LinkError;
use vidar_link::geometry::{
    AskError, DepthFormat, Expected, Hello, HelloRequest, ImageFormat, ModelFacts, Outcome, PredictReply,
    PredictRequest, Reach, RemoteModel, RemoteOptions, answer_hello, answer_predict,
};

/// What happens to a request.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    None,
    Gone,
    Late,
    Busy,
    /// The model gives an error, as where a device is out of memory.
    ModelError,
    Garbage,
    Cut,
    Bit(usize),
    /// The answer to the request before.
    Replayed,
    /// Another chunk's answer under this one's numbers.
    Reordered,
}

/// Workers that all serve the same model, with faults in the order in which they are to happen.
struct Fake {
    served: Arc<Brightness>,
    workers: Vec<(String, ModelFacts)>,
    faults: Arc<Mutex<VecDeque<Fault>>>,
    last: Option<Vec<u8>>,
    asked: Arc<Mutex<Vec<String>>>,
}

impl Reach for Fake {
    fn key(&self) -> &str {
        "lab/depth"
    }

    fn greet(&mut self, question: &[u8], _: Duration) -> Result<Vec<Vec<u8>>, LinkError> {
        let hello = |(name, facts): &(String, ModelFacts)| {
            let served = Brightness(facts.clone());
            answer_hello(question, &served, (name, "test"), 0).unwrap()
        };
        // Somebody else answers under the key, too.
        Ok(self.workers.iter().map(hello).chain([b"hello?".to_vec(), Vec::new()]).collect())
    }

    fn ask(
        &mut self,
        worker: &str,
        request: &[u8],
        _: Duration,
        stop: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, AskError> {
        if stop() {
            return Err(AskError::Cancelled);
        }
        self.asked.lock().unwrap().push(worker.to_owned());
        let answer = answer_predict(request, self.served.as_ref(), 0, &|_| false).bytes;
        let fault = self.faults.lock().unwrap().pop_front().unwrap_or(Fault::None);
        let before = self.last.replace(answer.clone());
        match fault {
            Fault::None => Ok(answer),
            Fault::Gone => Err(AskError::Gone),
            Fault::Late => Err(AskError::Late),
            Fault::Busy => {
                let asked = PredictRequest::decode(request).unwrap();
                let outcome = Outcome::Busy;
                let busy = PredictReply { run: asked.run, number: asked.number, queue: 9, outcome };
                Ok(busy.encode(DepthFormat::F32).unwrap())
            }
            Fault::ModelError => {
                let asked = PredictRequest::decode(request).unwrap();
                let outcome = Outcome::ModelFailed("out of memory".into());
                let failed = PredictReply { run: asked.run, number: asked.number, queue: 0, outcome };
                Ok(failed.encode(DepthFormat::F32).unwrap())
            }
            Fault::Garbage => Ok(vec![0xa5; 999]),
            Fault::Cut => Ok(answer[..answer.len() / 2].to_vec()),
            Fault::Bit(at) => {
                let mut answer = answer;
                // In magic, lengths or numbers of the header: what a checksum of the transport would find.
                let at = at % 40;
                answer[at] ^= 0x40;
                Ok(answer)
            }
            Fault::Replayed => Ok(before.unwrap_or_default()),
            Fault::Reordered => {
                let mut asked = PredictRequest::decode(request).unwrap();
                asked.views.views.iter_mut().for_each(|v| v.frame_id.0 += 1000);
                let other = asked.encode(ImageFormat::Raw).unwrap();
                Ok(answer_predict(&other, self.served.as_ref(), 0, &|_| false).bytes)
            }
        }
    }
}

struct Setup {
    model: RemoteModel,
    faults: Arc<Mutex<VecDeque<Fault>>>,
    asked: Arc<Mutex<Vec<String>>>,
}

fn open(workers: &[(&str, &str)], expected: Expected, depth: DepthFormat) -> Result<Setup, LinkError> {
    let (faults, asked) = Default::default();
    let fake = Fake {
        served: Arc::new(Brightness(facts("bright"))),
        workers: workers.iter().map(|(name, model)| ((*name).into(), facts(model))).collect(),
        faults: Arc::clone(&faults),
        last: None,
        asked: Arc::clone(&asked),
    };
    let options = RemoteOptions {
        settings: "{}".into(),
        expected,
        images: ImageFormat::Raw,
        depth,
        timeout: Duration::from_secs(5),
        patience: Duration::from_millis(10),
        run: 77,
        rank: 0,
    };
    let model = RemoteModel::open(Box::new(fake), options, &|| false)?;
    Ok(Setup { model, faults, asked })
}

fn three() -> Setup {
    open(&[("a", "bright"), ("b", "bright"), ("c", "bright")], Expected::default(), DepthFormat::F32).unwrap()
}

#[test]
fn what_comes_back_has_the_bits_of_the_model_and_load_is_shared() {
    let Setup { mut model, asked, .. } = three();
    for id in 0..9 {
        let views = chunk(id);
        let found = model.predict(&views, 1..4, true, &|_| false).unwrap();
        assert!(same_bits(&found, &local(&views, 1..4)), "chunk {id}");
    }
    let report = model.report();
    assert_eq!((report.chunks, report.keyframes, report.retries), (9, 27, 0));
    assert_eq!(report.workers.values().copied().collect::<Vec<_>>(), [3, 3, 3]);
    assert_eq!(asked.lock().unwrap().len(), 9);
    let planes = 4 * (2 * WIDTH * HEIGHT + 6) * 27;
    assert!(report.bytes_received as usize > planes && (report.bytes_received as usize) < planes + 9 * 4096);
    assert_eq!(report.bytes_per_keyframe, (report.bytes_sent + report.bytes_received) / 27);
}

#[test]
fn sixteen_bits_and_jpeg_are_close_and_smaller() {
    let views = chunk(3);
    let mut half = open(&[("a", "bright")], Expected::default(), DepthFormat::F16).unwrap().model;
    let found = half.predict(&views, 0..4, true, &|_| false).unwrap();
    for (a, b) in found.geometry.views.iter().zip(&local(&views, 0..4).geometry.views) {
        for (x, y) in a.depth.image().data().iter().zip(b.depth.image().data()) {
            assert!(x.is_nan() == y.is_nan() && (x.is_nan() || (x - y).abs() <= 5e-4 * y), "{x} {y}");
        }
    }
    let mut full = open(&[("a", "bright")], Expected::default(), DepthFormat::F32).unwrap().model;
    full.predict(&views, 0..4, true, &|_| false).unwrap();
    assert!(half.report().bytes_received < 6 * full.report().bytes_received / 10);
}

#[test]
fn faults_cost_a_retry_and_never_a_chunk_or_a_bit() {
    for fault in [
        Fault::Gone,
        Fault::Late,
        Fault::Garbage,
        Fault::Cut,
        Fault::Bit(2),
        Fault::Bit(9),
        Fault::Replayed,
        Fault::Reordered,
    ] {
        let Setup { mut model, faults, asked } = three();
        model.predict(&chunk(0), 0..4, true, &|_| false).unwrap();
        // What is replayed the second time would be this chunk's own answer.
        let next = if fault == Fault::Replayed { Fault::Gone } else { fault };
        faults.lock().unwrap().extend([fault, next]);
        let views = chunk(1);
        let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&found, &local(&views, 0..4)), "{fault:?}");
        assert_eq!(model.report().retries, 2, "{fault:?}");
        let asked = asked.lock().unwrap();
        assert_eq!(
            asked[1..].iter().collect::<std::collections::BTreeSet<_>>().len(),
            3,
            "each once: {asked:?}"
        );
    }
}

#[test]
fn busy_workers_are_waited_for_and_dead_ones_end_the_run() {
    let Setup { mut model, faults, .. } = three();
    faults.lock().unwrap().extend([Fault::Busy; 3]);
    model.predict(&chunk(1), 0..4, false, &|_| false).unwrap();
    assert_eq!(model.report().retries, 0, "who is busy has not failed");
    faults.lock().unwrap().extend([Fault::Gone; 100]);
    let error = model.predict(&chunk(2), 0..4, false, &|_| false).unwrap_err();
    let ModelError::OutOfReach(why) = error else { panic!("{error}") };
    assert!(why.contains("no worker under lab/depth answered") && why.contains("is gone"), "{why}");
    let cancelled = model.predict(&chunk(3), 0..4, false, &|_| true).unwrap_err();
    assert!(matches!(cancelled, ModelError::Cancelled));
}

#[test]
fn an_error_of_one_device_costs_no_chunk_and_one_of_all_is_told() {
    let Setup { mut model, faults, asked } = three();
    faults.lock().unwrap().extend([Fault::ModelError; 2]);
    let views = chunk(1);
    let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
    assert!(same_bits(&found, &local(&views, 0..4)));
    faults.lock().unwrap().extend([Fault::ModelError, Fault::Gone, Fault::ModelError]);
    let error = model.predict(&chunk(2), 0..4, false, &|_| false).unwrap_err();
    assert!(matches!(&error, ModelError::Other(why) if why == "out of memory"), "{error}");
    assert_eq!(asked.lock().unwrap().len(), 6, "each once for each chunk");
}

#[test]
fn a_bug_of_the_model_is_an_answer_and_the_worker_lives() {
    let Setup { mut model, .. } = three();
    std::panic::set_hook(Box::new(|_| {}));
    let error = model.predict(&chunk(666), 0..4, false, &|_| false).unwrap_err();
    let _ = std::panic::take_hook();
    assert!(error.to_string().contains("refused: the model stopped at a bug"), "{error}");
    model.predict(&chunk(1), 0..4, false, &|_| false).unwrap();
}

#[test]
fn only_the_model_that_is_asked_for_is_used() {
    let named = |name: &str| Expected { name: Some(name.into()), weights_sha256: None };
    let mixed = [("a", "other"), ("b", "bright"), ("c", "other")];
    let Setup { mut model, asked, .. } = open(&mixed, named("bright"), DepthFormat::F32).unwrap();
    (0..4).for_each(|id| drop(model.predict(&chunk(id), 0..1, false, &|_| false).unwrap()));
    assert!(asked.lock().unwrap().iter().all(|w| w == "b"));
    let reason = |result: Result<Setup, LinkError>| match result {
        Err(LinkError::OtherModel { reason, .. }) => reason,
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("opened"),
    };
    assert!(reason(open(&mixed, Expected::default(), DepthFormat::F32)).contains("they differ"));
    let none = reason(open(&mixed, named("da3-nano"), DepthFormat::F32));
    assert!(none.contains("da3-nano") && none.contains("a has other (MIT"), "{none}");
    let hash = Expected { name: None, weights_sha256: Some("f".repeat(64)) };
    assert!(reason(open(&mixed, hash, DepthFormat::F32)).contains("ffff"));
    let nobody = open(&[], Expected::default(), DepthFormat::F32);
    assert!(matches!(nobody, Err(LinkError::NoWorker { .. })));
}

#[test]
fn a_request_for_other_weights_is_refused_by_the_worker_itself() {
    let served = Brightness(facts("bright"));
    let mut request = request(&chunk(1));
    request.weights_sha256 = Some("e".repeat(64));
    let answer = answer_predict(&request.encode(ImageFormat::Raw).unwrap(), &served, 0, &|_| false);
    assert!(answer.problem.unwrap().contains("asked for was eeee"));
    request.weights_sha256 = facts("bright").info.weights_sha256;
    let answer = answer_predict(&request.encode(ImageFormat::Raw).unwrap(), &served, 0, &|_| false);
    assert_eq!((answer.keyframes, answer.problem), (4, None));
}

fn request(views: &ChunkViews) -> PredictRequest {
    PredictRequest {
        run: 1,
        number: 2,
        patience_ms: 1000,
        settings: "{}".into(),
        weights_sha256: facts("bright").info.weights_sha256,
        wants_tokens: true,
        depth: DepthFormat::F32,
        views: views.clone(),
        wanted: 0..4,
    }
}

/// A message whose header says what it is told, with the bytes of planes behind it.
fn forged(message: &[u8], find: &str, replace: &[u8]) -> Vec<u8> {
    let at = message.windows(find.len()).position(|w| w == find.as_bytes()).unwrap() + find.len();
    let mut forged = message.to_vec();
    forged.splice(at..at + replace.len(), replace.iter().copied());
    forged
}

#[test]
fn announced_sizes_are_believed_only_within_bounds() {
    let good = request(&chunk(1)).encode(ImageFormat::Jpeg).unwrap();
    PredictRequest::decode(&good).unwrap();
    let text = |bytes: &[u8]| PredictRequest::decode(bytes).unwrap_err().to_string();
    // CBOR: numbers below 24 are one byte, 24 takes two; here a width of 24 becomes one of 25.
    assert!(
        text(&forged(&good, "width", &[0x18, 25])).contains("size"),
        "{}",
        text(&forged(&good, "width", &[0x18, 25]))
    );
    // And the first four of four views become those from the fourth to the third.
    assert!(text(&forged(&good, "wanted", &[0x82, 4, 3])).contains("wanted views"));
    let header = u32::from_le_bytes(good[8..12].try_into().unwrap());
    let mut long = good.clone();
    long[8..12].copy_from_slice(&(header + (1 << 24)).to_le_bytes());
    assert!(text(&long).contains("at most"), "{}", text(&long));
    let mut other = good.clone();
    other[7] = 9;
    assert!(text(&other).contains("no message of this protocol"));
    assert!(text(&good[..good.len() - 1]).contains("expected"));
    assert!(text(&[good.clone(), vec![0]].concat()).contains("expected"));
    let mut views = chunk(1);
    views.views[0].intrinsics.fx = f64::NAN;
    assert!(text(&request(&views).encode(ImageFormat::Raw).unwrap()).contains("fx"));
    let mut views = chunk(1);
    views.views[0].world_from_camera = Some(Se3::from_translation([f64::INFINITY, 0.0, 0.0].into()));
    assert!(text(&request(&views).encode(ImageFormat::Raw).unwrap()).contains("pose"));
    let mut backwards = request(&chunk(1));
    backwards.wanted = 3..9;
    assert!(text(&backwards.encode(ImageFormat::Raw).unwrap()).contains("3..9 of 4"));
}

/// Garbage, cuts and changed bytes are an error or another valid message, never a panic; an answer has bounded size.
#[test]
fn nothing_that_comes_can_hurt() {
    let mut random = ChaCha8Rng::seed_from_u64(27);
    let served = Brightness(facts("bright"));
    let asked = request(&chunk(2));
    let question = HelloRequest { protocol: 1, settings: "{}".into() }.encode().unwrap();
    let hello = answer_hello(&question, &served, ("a", "t"), 3).unwrap();
    let good = [ImageFormat::Raw, ImageFormat::Jpeg].map(|images| asked.encode(images).unwrap());
    let reply = answer_predict(&good[0], &served, 0, &|_| false).bytes;
    std::panic::set_hook(Box::new(|_| {}));
    for case in 0..3000 {
        let garbage: Vec<u8> = (0..random.random_range(0..200)).map(|_| random.random()).collect();
        let mut bytes = [&good[0], &good[1], &reply, &hello, &garbage][case % 5].clone();
        for _ in 0..random.random_range(0..6) {
            if !bytes.is_empty() {
                // Most of what can be wrong is in the header.
                let end = if random.random() { bytes.len() } else { bytes.len().min(600) };
                let at = random.random_range(0..end);
                bytes[at] = random.random();
            }
        }
        if random.random_ratio(1, 3) {
            bytes.truncate(random.random_range(0..=bytes.len()));
        }
        let _ = (Hello::decode(&bytes), HelloRequest::decode(&bytes));
        let answer = answer_predict(&bytes, &served, 0, &|_| false);
        assert!(answer.bytes.len() <= reply.len() + 4096, "case {case}: {}", answer.bytes.len());
        if let Ok(read) = PredictReply::decode(&bytes, &asked)
            && let Outcome::Predicted(geometry, _) = read.outcome
        {
            for view in geometry.views {
                assert!(view.chunk_from_camera.is_finite());
                assert!(view.confidence.image().data().iter().all(|c| (0.0..=1.0).contains(c)));
            }
        }
    }
    let _ = std::panic::take_hook();
}

/// Whatever faults come in whatever order: while a worker lives, every chunk comes back with its own bits.
#[test]
fn any_faults_in_any_order_end_with_the_same_bits() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    for _ in 0..12 {
        let Setup { mut model, faults, .. } = three();
        // All three workers fail at most twice at one chunk here; after three times a run ends.
        for _ in 0..random.random_range(0..8) {
            let fault = match random.random_range(0..9) {
                0 => Fault::Gone,
                1 => Fault::Late,
                2 => Fault::Garbage,
                3 => Fault::Cut,
                4 => Fault::Bit(random.random_range(0..40)),
                5 => Fault::Replayed,
                6 => Fault::Reordered,
                _ => Fault::None,
            };
            faults.lock().unwrap().push_back(fault);
        }
        for id in 0..3 {
            let views = chunk(id);
            let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
            assert!(same_bits(&found, &local(&views, 0..4)));
        }
    }
}
