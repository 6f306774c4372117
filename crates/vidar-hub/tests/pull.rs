//! Fetching from a hub that responds correctly, fails, or sends wrong data. Nothing but 127.0.0.1 is contacted.
#![allow(clippy::unwrap_used, clippy::panic)] // Helpers of tests may stop at the first surprise, as tests may.

mod server;

use server::{Reply, Request, Server};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use vidar_hub::catalogue::{CONFIG, WEIGHTS};
use vidar_hub::{
    Acceptance, Checkpoint, CheckpointLocation, HubError, HubSettings, IdentifiedBy, Licence, OfficialFile,
    PullOptions, Store, TransferCallbacks,
};

const CONFIG_TEXT: &[u8] = b"{\"model_name\": \"da3-small\"}\n";

fn hex(bytes: &[u8]) -> String {
    vidar_hub::sha256_hex(bytes)
}

/// A whole safetensors file of one tensor and about 200 kB.
fn weights() -> Vec<u8> {
    let data: Vec<u8> = (0..200_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let header = format!(r#"{{"w":{{"dtype":"U8","shape":[{0}],"data_offsets":[0,{0}]}}}}"#, data.len());
    [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
}

/// An official checkpoint as far as this test's hub is concerned.
fn checkpoint(known_hash: bool, licence: Licence) -> &'static Checkpoint {
    let weights = weights();
    let hash: Option<&'static str> = known_hash.then(|| &*hex(&weights).leak());
    Box::leak(Box::new(Checkpoint {
        name: "tiny",
        repo: "maker/TINY",
        revision: "0123456789abcdef0123456789abcdef01234567",
        architecture: "da3-small",
        licence,
        parameters: 1,
        tensors: 1,
        files: [
            OfficialFile { name: CONFIG, bytes: None, sha256: None },
            OfficialFile { name: WEIGHTS, bytes: Some(weights.len() as u64), sha256: hash },
        ],
        abilities: &[],
        note: "",
    }))
}

fn tiny() -> &'static Checkpoint {
    checkpoint(true, Licence::Apache2)
}

struct Bench {
    folder: tempfile::TempDir,
    store: Store,
    server: Server,
}

impl Bench {
    /// A hub whose weights are answered by `answer`; everything else is as it should be.
    fn new(mut answer: impl FnMut(&Request, &[u8]) -> Reply + Send + 'static) -> Self {
        let file = weights();
        Self::plain(move |request| {
            if request.path.ends_with(CONFIG) {
                Reply::file(request, CONFIG_TEXT)
            } else {
                answer(request, &file)
            }
        })
    }

    fn plain(answer: impl FnMut(&Request) -> Reply + Send + 'static) -> Self {
        let server = Server::start(answer);
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(settings(folder.path(), &server.address));
        Self { folder, store, server }
    }

    fn pull(&self, checkpoint: &'static Checkpoint) -> Result<vidar_hub::InstalledCheckpoint, HubError> {
        self.store.pull(checkpoint, &options(), &quiet())
    }

    fn folder(&self) -> PathBuf {
        self.folder.path().join("models/tiny")
    }

    fn files(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.folder()).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Requests for the weights, as method and first byte.
    fn asked(&self) -> Vec<(String, Option<usize>)> {
        let requests = self.server.requests();
        requests
            .iter()
            .filter(|r| r.path.contains(WEIGHTS))
            .map(|r| (r.method.clone(), r.range_start()))
            .collect()
    }
}

fn settings(folder: &Path, endpoint: &str) -> HubSettings {
    HubSettings {
        endpoint: endpoint.to_owned(),
        proxy_from_environment: false,
        silence: Duration::from_secs(2),
        tries: 3,
        backoff: Duration::from_millis(2),
        longest_wait: Duration::from_secs(2),
        ..HubSettings::new(folder.join("models"))
    }
}

fn options() -> PullOptions {
    PullOptions { now: "2026-01-02T03:04:05Z".to_owned(), ..PullOptions::default() }
}

fn quiet() -> TransferCallbacks<'static> {
    TransferCallbacks { progress: &|_| {}, cancel: &|| false }
}

#[test]
fn a_checkpoint_is_fetched_recorded_verified_and_not_fetched_twice() {
    let bench = Bench::new(Reply::file);
    let last = Cell::new(0);
    let watch = TransferCallbacks {
        progress: &|p| {
            assert!(p.done >= last.get() || p.file == CONFIG);
            last.set(p.done);
            assert!(p.file == CONFIG || p.total == weights().len() as u64);
        },
        cancel: &|| false,
    };
    let installed = bench.store.pull(tiny(), &options(), &watch).unwrap();
    assert_eq!(last.get(), weights().len() as u64);
    assert_eq!(std::fs::read(installed.weights()).unwrap(), weights());
    assert_eq!(std::fs::read(installed.folder.join(CONFIG)).unwrap(), CONFIG_TEXT);
    assert_eq!(bench.files(), [".lock", CONFIG, WEIGHTS, "vidar-model.json"]);
    let record = installed.record.clone().unwrap();
    assert_eq!((record.name.as_str(), record.licence.as_str()), ("tiny", "Apache-2.0"));
    assert_eq!(record.source, format!("{}/maker/TINY", bench.server.address));
    assert_eq!(record.added, "2026-01-02T03:04:05Z");
    assert_eq!(installed.recorded_sha256(), Some(hex(&weights()).as_str()));
    assert_eq!(installed.location, CheckpointLocation::Store);
    let paths: Vec<String> = bench.server.requests().iter().map(|r| r.path.clone()).collect();
    let base = "/maker/TINY/resolve/0123456789abcdef0123456789abcdef01234567";
    assert!(paths.iter().all(|p| p.starts_with(base)), "{paths:?}");
    let verified = bench.store.verify(tiny(), &quiet()).unwrap();
    assert_eq!(verified[1].identified_by, IdentifiedBy::Catalogue);
    bench.pull(tiny()).unwrap();
    assert_eq!(bench.server.requests().len(), paths.len(), "the second pull asked the hub");
    let again = PullOptions { again: true, ..options() };
    bench.store.pull(tiny(), &again, &quiet()).unwrap();
    assert!(bench.server.requests().len() > paths.len());
}

#[test]
fn an_interrupted_transfer_continues_where_it_stopped() {
    let mut cuts = vec![120_000, 50_000].into_iter();
    let bench = Bench::new(move |request, file| {
        let cut_after = if request.method == "GET" { cuts.next() } else { None };
        Reply { cut_after, ..Reply::file(request, file) }
    });
    let installed = bench.pull(tiny()).unwrap();
    assert_eq!(std::fs::read(installed.weights()).unwrap(), weights());
    let asked = bench.asked();
    let starts: Vec<_> = asked.iter().filter(|(m, _)| m == "GET").map(|(_, start)| *start).collect();
    assert_eq!(starts, [None, Some(120_000), Some(170_000)]);
}

#[test]
fn a_part_of_an_earlier_run_is_continued() {
    let bench = Bench::new(|request, file| Reply { cut_after: Some(60_000), ..Reply::file(request, file) });
    let HubError::Network { reason, .. } = bench.pull(tiny()).unwrap_err() else { panic!() };
    assert!(reason.contains("after"), "{reason}");
    let part = bench.files().into_iter().find(|f| f.ends_with(".part")).unwrap();
    assert!(part.starts_with(WEIGHTS), "{part}");
    assert!(!bench.folder().join(WEIGHTS).exists() && bench.store.find(tiny()).unwrap().is_none());
    let there = std::fs::metadata(bench.folder().join(&part)).unwrap().len() as usize;
    let server = Server::start(move |request| {
        if request.path.ends_with(CONFIG) {
            Reply::file(request, CONFIG_TEXT)
        } else {
            Reply::file(request, &weights())
        }
    });
    let store = Store::new(settings(bench.folder.path(), &server.address));
    store.pull(tiny(), &options(), &quiet()).unwrap();
    let starts: Vec<_> = server.requests().iter().filter_map(Request::range_start).collect();
    assert_eq!(starts, [there]);
    assert_eq!(bench.files(), [".lock", CONFIG, WEIGHTS, "vidar-model.json"]);
}

#[test]
fn a_corrupted_part_is_discarded_and_fetched_again() {
    let bench = Bench::new(Reply::file);
    std::fs::create_dir_all(bench.folder()).unwrap();
    let part = bench.folder().join(format!("{WEIGHTS}.{}.part", &hex(&weights())[..12]));
    for corrupted in [vec![0; 1000], vec![0; weights().len()], vec![0; weights().len() + 5]] {
        std::fs::write(&part, corrupted).unwrap();
        let again = PullOptions { again: true, ..options() };
        let installed = bench.store.pull(tiny(), &again, &quiet()).unwrap();
        assert_eq!(std::fs::read(installed.weights()).unwrap(), weights());
        assert!(!part.exists());
    }
}

#[test]
fn a_server_that_ignores_ranges_is_read_from_the_start() {
    let mut first = true;
    let bench = Bench::new(move |request, file| {
        let whole = Reply { body: file.to_vec(), ..Reply::status(200) };
        if request.method == "GET" && std::mem::take(&mut first) {
            return Reply { cut_after: Some(90_000), ..whole };
        }
        whole
    });
    let installed = bench.pull(tiny()).unwrap();
    assert_eq!(std::fs::read(installed.weights()).unwrap(), weights());
    assert_eq!(bench.asked().last().unwrap(), &("GET".to_owned(), Some(90_000)));
}

#[test]
fn redirects_are_followed_with_their_hash_but_without_the_token() {
    let storage = Server::start(|request| Reply::file(request, &weights()));
    let away = format!("{}/blob?Signature=a%2Fb", storage.address);
    let hash = hex(&weights());
    let hub = Server::start(move |request| {
        if request.path.ends_with(CONFIG) {
            return Reply::file(request, CONFIG_TEXT);
        }
        if request.path.starts_with("/inner") {
            return Reply::status(302).with("Location", &away);
        }
        Reply::status(307)
            .with("Location", "/inner/x")
            .with("X-Linked-ETag", format!("\"{hash}\""))
            .with("X-Linked-Size", weights().len())
            .with("X-Repo-Commit", "0123456789ABCDEF0123456789abcdef01234567")
    });
    let folder = tempfile::tempdir().unwrap();
    let settings =
        HubSettings { token: Some("hf_secret".to_owned()), ..settings(folder.path(), &hub.address) };
    let store = Store::new(settings);
    let unknown = checkpoint(false, Licence::Apache2);
    let installed = store.pull(unknown, &options(), &quiet()).unwrap();
    let record = installed.record.unwrap();
    assert_eq!(record.revision.as_deref(), Some("0123456789abcdef0123456789abcdef01234567"));
    assert_eq!(record.files[1].identified_by, IdentifiedBy::Hub);
    assert!(hub.requests().iter().all(|r| r.header("authorization") == Some("Bearer hf_secret")));
    let carried = storage.requests();
    assert!(!carried.is_empty() && carried.iter().all(|r| r.header("authorization").is_none()));
    assert!(carried.iter().all(|r| r.path == "/blob?Signature=a%2Fb"));
}

#[test]
fn invalid_redirects_and_redirect_loops_fail_with_their_address() {
    for location in ["/maker/TINY/resolve/round", "ftp://elsewhere/x", "", "http://"] {
        let bench = Bench::plain(move |_| Reply::status(302).with("Location", location));
        let error = bench.pull(tiny()).unwrap_err();
        assert!(matches!(error, HubError::Redirect { .. }), "{location:?}: {error}");
        assert!(error.to_string().contains("redirected"), "{error}");
    }
    let mut n = 0;
    let bench = Bench::plain(move |_| {
        n += 1;
        Reply::status(302).with("Location", format!("/{n}"))
    });
    let error = bench.pull(tiny()).unwrap_err().to_string();
    assert!(error.contains("more than 10 times"), "{error}");
}

#[test]
fn each_refusal_has_its_error_and_hint() {
    for (status, with_token, expected) in [(401, false, "HF_TOKEN"), (403, true, "has no read access")] {
        let bench = Bench::plain(move |_| Reply::status(status).with("X-Error-Message", "gated repo"));
        let token = with_token.then(|| "t".to_owned());
        let store = Store::new(HubSettings { token, ..bench.store.settings().clone() });
        let error = store.pull(tiny(), &options(), &quiet()).unwrap_err();
        assert!(matches!(error, HubError::NoAccess { .. }), "{error}");
        assert!(error.to_string().contains("gated repo"), "{error}");
        let hint = error.hint().unwrap();
        assert!(hint.contains(expected) && hint.contains("/maker/TINY"), "{hint}");
        assert_eq!(bench.server.requests().len(), 1, "a refusal is not retried");
    }
    let bench = Bench::plain(|_| Reply::status(404));
    assert!(matches!(bench.pull(tiny()).unwrap_err(), HubError::NotFound { .. }));
    assert_eq!(bench.server.requests().len(), 1);
    let bench = Bench::plain(|_| Reply::status(418));
    assert!(matches!(bench.pull(tiny()).unwrap_err(), HubError::Status { status: 418, .. }));
    assert_eq!(bench.server.requests().len(), 1);
}

#[test]
fn requests_to_a_busy_or_broken_server_are_retried_and_finally_fail() {
    let mut left = 2;
    let bench = Bench::new(move |request, file| {
        if left > 0 {
            left -= 1;
            return Reply::status(if left == 1 { 429 } else { 503 }).with("Retry-After", 0);
        }
        Reply::file(request, file)
    });
    bench.pull(tiny()).unwrap();
    let bench = Bench::plain(|_| Reply::status(500));
    assert!(matches!(bench.pull(tiny()).unwrap_err(), HubError::Status { status: 500, .. }));
    assert_eq!(bench.server.requests().len(), 3);
    let bench = Bench::plain(|_| Reply::status(429).with("Retry-After", 3600));
    let error = bench.pull(tiny()).unwrap_err();
    assert!(matches!(error, HubError::RateLimited { retry_after_secs: Some(3600), .. }), "{error}");
    assert_eq!(bench.server.requests().len(), 1, "an hour is not waited for");
    assert!(error.hint().unwrap().contains("HF_TOKEN"));
}

#[test]
fn a_missing_connection_is_reported_without_retries() {
    // A port that was free a moment ago: nothing answers there.
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    for endpoint in [format!("http://{address}"), "http://no-such-host.invalid".to_owned()] {
        let folder = tempfile::tempdir().unwrap();
        let settings =
            HubSettings { tries: 5, backoff: Duration::from_secs(20), ..settings(folder.path(), &endpoint) };
        let clock = Instant::now();
        let error = Store::new(settings).pull(tiny(), &options(), &quiet()).unwrap_err();
        assert!(matches!(error, HubError::NoConnection { .. }), "{error}");
        assert!(error.to_string().contains("no connection to") && error.hint().is_some(), "{error}");
        assert!(clock.elapsed() < Duration::from_secs(15), "{:?}", clock.elapsed());
    }
}

#[test]
fn the_wait_requested_by_a_server_is_respected() {
    let mut first = true;
    let bench = Bench::new(move |request, file| match std::mem::take(&mut first) {
        true => Reply::status(429).with("Retry-After", 1),
        false => Reply::file(request, file),
    });
    let clock = Instant::now();
    bench.pull(tiny()).unwrap();
    assert!(clock.elapsed() >= Duration::from_secs(1), "{:?}", clock.elapsed());
}

#[test]
fn wrong_bytes_are_refused_and_leave_nothing() {
    let bench = Bench::new(|request, file| {
        let mut other = file.to_vec();
        other[150_000] ^= 1;
        Reply::file(request, &other)
    });
    let error = bench.pull(tiny()).unwrap_err();
    let HubError::WrongHash { expected, found, .. } = &error else { panic!("{error}") };
    assert_eq!(expected, &hex(&weights()));
    assert_ne!(expected, found);
    assert_eq!(bench.files(), [".lock", CONFIG]);
    assert_eq!(bench.asked().iter().filter(|(m, _)| m == "GET").count(), 1, "the same bytes came twice");
}

#[test]
fn a_length_or_hash_that_the_hub_announces_differently_is_refused_before_a_byte_is_fetched() {
    for (name, value) in
        [("X-Linked-Size", "7".to_owned()), ("X-Linked-ETag", format!("\"{}\"", "0".repeat(64)))]
    {
        let bench = Bench::new(move |request, file| Reply::file(request, file).with(name, &value));
        let error = bench.pull(tiny()).unwrap_err();
        assert!(
            matches!(error, HubError::WrongSize { found: 7, .. } | HubError::WrongHash { .. }),
            "{error}"
        );
        assert!(bench.asked().iter().all(|(method, _)| method == "HEAD"), "{:?}", bench.asked());
    }
}

#[test]
fn a_body_of_the_wrong_length_is_refused() {
    // Too long, with a matching Content-Length.
    let bench = Bench::new(|request, file| Reply::file(request, &[file, b"more"].concat()));
    let error = bench.pull(tiny()).unwrap_err();
    assert!(matches!(error, HubError::WrongSize { .. }), "{error}");
    // Too long, without Content-Length.
    let bench = Bench::new(|_, file| Reply {
        body: [file, b"more"].concat(),
        own_length: true,
        ..Reply::status(200)
    });
    let error = bench.pull(tiny()).unwrap_err();
    assert!(matches!(error, HubError::WrongSize { .. }), "{error}");
    // Too short, with a matching Content-Length.
    let bench = Bench::new(|_, file| Reply { body: file[..9].to_vec(), ..Reply::status(200) });
    let error = bench.pull(tiny()).unwrap_err();
    assert!(matches!(error, HubError::WrongSize { found: 9, .. }), "{error}");
    // Too short, without Content-Length: treated as a broken connection.
    let bench =
        Bench::new(|_, file| Reply { body: file[..9].to_vec(), own_length: true, ..Reply::status(200) });
    let error = bench.pull(tiny()).unwrap_err();
    assert!(error.to_string().contains("ended after"), "{error}");
    assert_eq!(bench.files().len(), 3, "the part is kept: {:?}", bench.files());
}

#[test]
fn an_endless_file_of_unknown_length_is_cut_off() {
    let bench = Bench::plain(|request| match request.method.as_str() {
        "HEAD" => Reply::status(200),
        _ => Reply { body: vec![b' '; 17 << 20], own_length: true, ..Reply::status(200) },
    });
    let error = bench.pull(tiny()).unwrap_err();
    assert!(matches!(error, HubError::WrongSize { .. }), "{error}");
    assert_eq!(bench.files(), [".lock"]);
}

#[test]
fn a_slow_transfer_can_be_stopped_and_a_stalled_one_times_out() {
    let bench = Bench::new(|request, file| Reply {
        drip: Some((1000, Duration::from_millis(20))),
        ..Reply::file(request, file)
    });
    let clock = Instant::now();
    let cancel = || clock.elapsed() > Duration::from_millis(300);
    let error = bench
        .store
        .pull(tiny(), &options(), &TransferCallbacks { progress: &|_| {}, cancel: &cancel })
        .unwrap_err();
    assert!(matches!(error, HubError::Cancelled), "{error}");
    assert!(clock.elapsed() < Duration::from_secs(2), "{:?}", clock.elapsed());
    let part = bench.files().into_iter().find(|f| f.ends_with(".part")).unwrap();
    assert!(std::fs::metadata(bench.folder().join(part)).unwrap().len() > 0, "what came is kept");

    let bench = Bench::new(|request, file| Reply {
        drip: Some((100_000, Duration::from_millis(900))),
        ..Reply::file(request, file)
    });
    let settings =
        HubSettings { silence: Duration::from_millis(200), tries: 2, ..bench.store.settings().clone() };
    let error = Store::new(settings).pull(tiny(), &options(), &quiet()).unwrap_err();
    assert!(matches!(error, HubError::Network { .. }), "{error}");
}

#[test]
fn a_transfer_that_trickles_and_one_that_takes_too_long_are_given_up() {
    // Never silent: a byte every two milliseconds would take minutes.
    let trickle = |request: &Request, file: &[u8]| Reply {
        drip: Some((1, Duration::from_millis(2))),
        ..Reply::file(request, file)
    };
    let bench = Bench::new(trickle);
    let settings = HubSettings {
        min_bytes_per_sec: 50_000,
        rate_window: Duration::from_millis(200),
        tries: 2,
        ..bench.store.settings().clone()
    };
    let clock = Instant::now();
    let error = Store::new(settings).pull(tiny(), &options(), &quiet()).unwrap_err();
    assert!(
        matches!(error, HubError::Network { .. }) && error.to_string().contains("bytes per second"),
        "{error}"
    );
    assert!(clock.elapsed() < Duration::from_secs(4), "{:?}", clock.elapsed());

    let bench = Bench::new(trickle);
    let settings =
        HubSettings { longest_transfer: Duration::from_millis(300), ..bench.store.settings().clone() };
    let clock = Instant::now();
    let error = Store::new(settings).pull(tiny(), &options(), &quiet()).unwrap_err();
    assert!(matches!(error, HubError::TooSlow { .. }), "{error}");
    assert!(clock.elapsed() < Duration::from_secs(4), "{:?}", clock.elapsed());
}

#[test]
fn hostile_responses_end_in_an_error() {
    type WrongResponse = fn(&Request, &[u8]) -> Reply;
    let responses: [WrongResponse; 8] = [
        |r, f| Reply { status: 206, ..Reply::file(r, f) }.with("Content-Range", "bytes 5-9/10"),
        |r, f| {
            Reply { status: 206, ..Reply::file(r, f) }.with("Content-Range", "bytes 18446744073709551616-/*")
        },
        |_, _| Reply::status(416),
        |_, f| {
            Reply { own_length: true, body: f.to_vec(), ..Reply::status(200) }.with("Content-Length", "-1")
        },
        |_, _| Reply { own_length: true, ..Reply::status(200) }.with("Content-Length", u64::MAX),
        |_, _| Reply::status(200).with("X-Long", "a".repeat(100_000)),
        |r, f| Reply::file(r, f).with("X-Linked-Size", u64::MAX),
        |_, _| Reply::status(999),
    ];
    for (i, response) in responses.into_iter().enumerate() {
        let bench = Bench::new(response);
        assert!(bench.pull(tiny()).is_err(), "wrong response {i} was accepted");
        assert!(!bench.folder().join(WEIGHTS).exists(), "wrong response {i}");
    }
    // Headers without meaning are ignored.
    let bench =
        Bench::new(|r, f| Reply::file(r, f).with("X-Linked-Size", "-3").with("X-Linked-ETag", "\"x\""));
    bench.pull(tiny()).unwrap();
}

#[test]
fn random_bytes_in_place_of_a_response_never_panic() {
    let mut state = 7_u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as u32
    };
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let (rounds, tries) = (60, 1);
    std::thread::spawn(move || {
        use std::io::{Read, Write};
        for _ in 0..rounds {
            let Ok((mut stream, _)) = listener.accept() else { return };
            let _ = stream.set_read_timeout(Some(Duration::from_millis(200)));
            let _ = stream.read(&mut [0; 4096]);
            let length = random() as usize % 300;
            let mut bytes: Vec<u8> = (0..length).map(|_| random() as u8).collect();
            if random() % 2 == 0 {
                bytes = [&b"HTTP/1.1 200 OK\r\n"[..], &bytes, b"\r\n\r\n"].concat();
            }
            let _ = stream.write_all(&bytes);
        }
    });
    let folder = tempfile::tempdir().unwrap();
    let store = Store::new(HubSettings {
        tries,
        silence: Duration::from_millis(500),
        ..settings(folder.path(), &address)
    });
    for _ in 0..rounds {
        assert!(store.pull(tiny(), &options(), &quiet()).is_err());
    }
}

#[test]
fn offline_makes_no_request() {
    let bench = Bench::new(Reply::file);
    let store = Store::new(HubSettings { offline: true, ..bench.store.settings().clone() });
    let error = store.pull(tiny(), &options(), &quiet()).unwrap_err();
    assert!(matches!(error, HubError::Offline { .. }), "{error}");
    assert!(bench.server.requests().is_empty() && bench.files().is_empty());
    bench.pull(tiny()).unwrap();
    store.pull(tiny(), &options(), &quiet()).unwrap();
}

#[test]
fn non_commercial_weights_need_a_recorded_acceptance() {
    let free_of_charge = checkpoint(true, Licence::CcByNc4);
    let bench = Bench::new(Reply::file);
    let error = bench.pull(free_of_charge).unwrap_err();
    assert!(matches!(error, HubError::LicenceNotAccepted { .. }), "{error}");
    let hint = error.hint().unwrap();
    assert!(hint.contains("--accept-licence CC-BY-NC-4.0") && hint.contains("legalcode"), "{hint}");
    assert!(bench.server.requests().is_empty(), "it was fetched before it was accepted");
    assert!(Acceptance::new(free_of_charge, "MIT", "me", "now").is_err());
    let acceptance = Acceptance::new(free_of_charge, "cc-by-nc-4.0", "me", "2026-01-02T03:04:05Z").unwrap();
    let with = PullOptions { acceptance: Some(acceptance.clone()), ..options() };
    let installed = bench.store.pull(free_of_charge, &with, &quiet()).unwrap();
    assert_eq!(installed.acceptance, Some(acceptance));
    let text = std::fs::read_to_string(bench.folder().join("acceptance.json")).unwrap();
    for word in
        ["\"accepted_by\": \"me\"", "2026-01-02T03:04:05Z", "CC-BY-NC-4.0", "legalcode", "vidar.acceptance/1"]
    {
        assert!(text.contains(word), "{word} is missing in {text}");
    }
    bench.store.require(free_of_charge).unwrap();
    bench.pull(free_of_charge).unwrap();
    std::fs::remove_file(bench.folder().join("acceptance.json")).unwrap();
    assert!(matches!(bench.store.require(free_of_charge).unwrap_err(), HubError::LicenceNotAccepted { .. }));
}

#[test]
fn two_processes_do_not_write_the_same_checkpoint() {
    let bench = Bench::new(Reply::file);
    std::fs::create_dir_all(bench.folder()).unwrap();
    let lock = std::fs::File::create(bench.folder().join(".lock")).unwrap();
    lock.lock().unwrap();
    assert!(matches!(bench.pull(tiny()).unwrap_err(), HubError::Busy { .. }));
    lock.unlock().unwrap();
    bench.pull(tiny()).unwrap();
}

#[test]
fn another_revision_is_identified_by_the_hub_and_a_bad_one_is_refused() {
    let hash = hex(&weights());
    let bench = Bench::new(move |request, file| Reply::file(request, file).with("X-Linked-ETag", &hash));
    let main = PullOptions { revision: Some("main".to_owned()), ..options() };
    let record = bench.store.pull(tiny(), &main, &quiet()).unwrap().record.unwrap();
    assert_eq!(record.files[1].identified_by, IdentifiedBy::Hub);
    assert!(bench.server.requests().iter().all(|r| r.path.contains("/resolve/main/")));
    for bad in ["", "../../x", "a b", "a?b", ".hidden"] {
        let options = PullOptions { revision: Some(bad.to_owned()), ..options() };
        assert!(
            matches!(bench.store.pull(tiny(), &options, &quiet()), Err(HubError::BadSetting { .. })),
            "{bad}"
        );
    }
}
