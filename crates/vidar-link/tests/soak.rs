//! Workers behind a network with faults: connections that are cut, stand still, deliver late, deliver twice, or are flooded with garbage. Every chunk
//! comes back with its own bits, and memory stays flat. A few seconds in the ordinary tests; half an hour with
//! `cargo test -p vidar-link --features zenoh --release --test soak -- --ignored --nocapture`.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stderr)]

mod common;

use common::{Brightness, chunk, facts, local, same_bits};
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};
use vidar_core::random::SplitMix64;
use vidar_link::geometry::{AskError, DepthFormat, Expected, ImageFormat, Reach, RemoteModel, RemoteOptions};
use vidar_link::{Link, LinkError, LinkOptions, Role, Serving};

const KEY: &str = "soak/depth";
/// Its first numbers below ten have a nought and a one.
const DICE_SEED: u64 = 5;

/// A way to an address that can be disturbed.
struct Proxy {
    port: u16,
    /// Connections made before this moment are cut when they notice.
    cut: Arc<AtomicU64>,
    /// Nothing passes while it is set.
    stands_still: Arc<AtomicBool>,
    /// Each piece waits for so long, ms.
    delay_ms: Arc<AtomicU64>,
}

impl Proxy {
    fn start(to: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let this = Self {
            port,
            cut: Default::default(),
            stands_still: Default::default(),
            delay_ms: Default::default(),
        };
        let (cut, still, delay) = (this.cut.clone(), this.stands_still.clone(), this.delay_ms.clone());
        std::thread::spawn(move || {
            for here in listener.incoming().flatten() {
                let Ok(there) = TcpStream::connect(("127.0.0.1", to)) else { continue };
                let born = cut.load(Ordering::SeqCst);
                for (mut from, mut into) in
                    [(here.try_clone().unwrap(), there.try_clone().unwrap()), (there, here)]
                {
                    let (cut, still, delay) = (cut.clone(), still.clone(), delay.clone());
                    std::thread::spawn(move || {
                        from.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
                        let mut buffer = vec![0; 16 << 10];
                        while cut.load(Ordering::SeqCst) == born {
                            if still.load(Ordering::SeqCst) {
                                std::thread::sleep(Duration::from_millis(10));
                                continue;
                            }
                            match from.read(&mut buffer) {
                                Ok(0) => break,
                                Ok(n) => {
                                    std::thread::sleep(Duration::from_millis(delay.load(Ordering::SeqCst)));
                                    if into.write_all(&buffer[..n]).is_err() {
                                        break;
                                    }
                                }
                                Err(e)
                                    if [std::io::ErrorKind::WouldBlock, std::io::ErrorKind::TimedOut]
                                        .contains(&e.kind()) => {}
                                Err(_) => break,
                            }
                        }
                        let _ = (from.shutdown(Shutdown::Both), into.shutdown(Shutdown::Both));
                    });
                }
            }
        });
        this
    }
}

/// A way on which requests and replies come twice: now and then a worker gets a request two times, and now and then the reply to an
/// earlier request comes first.
struct Duplicating {
    reach: Box<dyn Reach>,
    dice: SplitMix64,
    earlier: Vec<u8>,
    /// Requests and replies that came twice.
    count: Arc<AtomicU64>,
}

impl Reach for Duplicating {
    fn key(&self) -> &str {
        self.reach.key()
    }

    fn greet(&mut self, question: &[u8], within: Duration) -> Result<Vec<Vec<u8>>, LinkError> {
        let answers = self.reach.greet(question, within)?;
        Ok([answers.clone(), answers].concat())
    }

    fn ask(
        &mut self,
        worker: &str,
        request: &[u8],
        within: Duration,
        stop: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, AskError> {
        let dice = self.dice.below(10);
        if dice == 0 {
            drop(self.reach.ask(worker, request, within, stop));
        }
        if dice == 1 && !self.earlier.is_empty() {
            self.count.fetch_add(1, Ordering::SeqCst);
            return Ok(std::mem::take(&mut self.earlier));
        }
        let answer = self.reach.ask(worker, request, within, stop)?;
        self.count.fetch_add(u64::from(dice == 0), Ordering::SeqCst);
        self.earlier.clone_from(&answer);
        Ok(answer)
    }
}

fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmRSS:")).unwrap_or("VmRSS: 0 kB");
    line.split_whitespace().nth(1).and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) * 1024
}

fn soak(time: Duration, least_chunks: u32) {
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let mut ways = Vec::new();
        for _ in 0..2 {
            let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
            let (sender, ready) = sync_channel(1);
            let stop = &stop;
            scope.spawn(move || {
                let options =
                    LinkOptions { listen: vec![format!("tcp/127.0.0.1:{port}")], ..LinkOptions::default() };
                let link = Link::open(&options, Role::Server).unwrap();
                let told = move |serving: Serving| {
                    if matches!(serving, Serving::Ready { .. }) {
                        sender.send(()).unwrap();
                    }
                };
                let served = Arc::new(Brightness(facts("bright")));
                link.serve(KEY, "test", served, &told, &|| stop.load(Ordering::SeqCst)).unwrap();
            });
            ready.recv_timeout(Duration::from_secs(20)).unwrap();
            ways.push(Proxy::start(port));
        }
        let connect = ways.iter().map(|w| format!("tcp/127.0.0.1:{}", w.port)).collect();
        let link = Link::open(&LinkOptions { connect, ..LinkOptions::default() }, Role::Client).unwrap();
        let options = RemoteOptions {
            settings: "{}".into(),
            expected: Expected::default(),
            images: ImageFormat::Raw,
            depth: DepthFormat::F32,
            timeout: Duration::from_millis(800),
            patience: Duration::from_secs(30),
            run: 5,
            rank: 0,
        };
        let count = Arc::new(AtomicU64::new(0));
        let reach = link.reach(KEY).unwrap();
        let dice = SplitMix64::new(DICE_SEED);
        let reach = Duplicating { reach, dice, earlier: Vec::new(), count: count.clone() };
        let mut model = RemoteModel::open(Box::new(reach), options, &|| false).unwrap();
        // By seed, so that a failure can be had again.
        let mut random = SplitMix64::new(7);
        let (clock, mut done, mut warm) = (Instant::now(), 0_u32, 0_u64);
        while clock.elapsed() < time || done < least_chunks {
            let way = &ways[random.below(2)];
            match random.below(6) {
                0 => drop(way.cut.fetch_add(1, Ordering::SeqCst)),
                1 => way.stands_still.store(true, Ordering::SeqCst),
                2 => way.delay_ms.store(random.next_u64() % 30, Ordering::SeqCst),
                3 => {
                    // Somebody who speaks no Zenoh at all.
                    if let Ok(mut stranger) = TcpStream::connect(("127.0.0.1", way.port)) {
                        let garbage: Vec<u8> = (0..4096).map(|_| random.next_u64() as u8).collect();
                        let _ = stranger.write_all(&garbage);
                    }
                }
                _ => ways.iter().for_each(|w| {
                    w.stands_still.store(false, Ordering::SeqCst);
                    w.delay_ms.store(0, Ordering::SeqCst);
                }),
            }
            // One of both ways is always open.
            if ways.iter().all(|w| w.stands_still.load(Ordering::SeqCst)) {
                ways[0].stands_still.store(false, Ordering::SeqCst);
            }
            let views = chunk(done % 500);
            let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
            assert!(same_bits(&found, &local(&views, 0..4)), "chunk {done}");
            done += 1;
            if done == 200 {
                warm = resident_bytes();
            }
        }
        let report = model.report();
        eprintln!(
            "{done} chunks, {} retries, {} duplicates, {} invalid replies, {:?}, {} MB resident",
            report.retries,
            count.load(Ordering::SeqCst),
            report.invalid_replies,
            report.workers,
            resident_bytes() >> 20
        );
        assert_eq!(report.chunks, done as usize);
        assert!(count.load(Ordering::SeqCst) > 0);
        // The reply to another request is none.
        assert!(report.invalid_replies > 0, "{report:?}");
        if warm > 0 {
            assert!(resident_bytes() < warm + (64 << 20), "{} MB at 200 chunks", warm >> 20);
        }
        stop.store(true, Ordering::SeqCst);
    });
}

#[test]
fn every_chunk_comes_back_from_a_network_with_faults() {
    soak(Duration::from_secs(6), 20);
}

#[test]
#[ignore = "half an hour"]
fn every_chunk_comes_back_for_half_an_hour_and_memory_is_flat() {
    soak(Duration::from_secs(1800), 200);
}
