//! A hub that sends wrong data, too much of it, or too slowly.

use crate::bench::{Bench, hex, options, quiet, settings, tiny, weights};
use crate::server::{Reply, Request};
use std::time::{Duration, Instant};
use vidar_hub::catalogue::{CONFIG, WEIGHTS};
use vidar_hub::{HubError, HubSettings, Store, TransferCallbacks};

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
