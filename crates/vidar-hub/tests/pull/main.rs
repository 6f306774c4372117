//! Fetching from a hub that responds correctly, fails, or sends wrong data. Nothing but 127.0.0.1 is contacted.
#![allow(clippy::unwrap_used, clippy::panic)] // Helpers of tests may stop at the first surprise, as tests may.

mod bench;
#[path = "../server/mod.rs"]
mod server;
mod wrong_data;

use bench::{Bench, CONFIG_TEXT, checkpoint, hex, options, quiet, settings, tiny, weights};
use server::{Reply, Request, Server};
use std::cell::Cell;
use std::time::{Duration, Instant};
use vidar_hub::catalogue::{CONFIG, WEIGHTS};
use vidar_hub::{
    Acceptance, CheckpointLocation, HubError, HubSettings, IdentifiedBy, Licence, PullOptions, Store,
    TransferCallbacks,
};

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
