//! Download of one file: resumed, hashed while it streams, and renamed only when it is complete and verified.
//!
//! 1. `HEAD`: the hub's length and hash are compared with the expected ones before a byte is fetched.
//! 2. The free space of the disk is checked.
//! 3. `GET` with `Range` from the end of `<file>.<hash>.part`; existing bytes are hashed first.
//! 4. Length and hash are checked, then the part is renamed to the file.
//!
//! An interrupted transfer is retried from where it stopped. A part is continued only if the hash of the whole file is
//! known, because only the hash shows that both parts belong to the same file.

use crate::client::{Client, Failure, FileMetadata, Method, Response, header};
use crate::digest::{Digest, hash_prefix};
use crate::error::HubError;
use crate::progress::{Progress, TransferCallbacks};
use crate::settings::HubSettings;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Bytes between two progress reports and checks for cancellation.
const PIECE: usize = 64 << 10;
/// Largest file whose length and hash are both unknown, bytes.
const MOST_UNKNOWN: u64 = 16 << 20;
/// After this much progress the count of tries starts again, bytes.
const REAL_PROGRESS: u64 = 1 << 20;

/// A file to fetch.
pub(crate) struct FileRequest<'a> {
    pub url: &'a str,
    pub target: &'a Path,
    pub name: &'a str,
    pub bytes: Option<u64>,
    pub sha256: Option<&'a str>,
}

/// A fetched file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FetchedFile {
    pub bytes: u64,
    pub sha256: String,
    /// Whether hub or catalogue stated the hash beforehand.
    pub hash_was_known: bool,
    pub revision: Option<String>,
}

/// Fetches one file.
pub(crate) fn fetch(
    client: &Client<'_>,
    settings: &HubSettings,
    request: &FileRequest<'_>,
    callbacks: &TransferCallbacks<'_>,
) -> Result<FetchedFile, HubError> {
    let deadline = Deadline::new(settings, request.url);
    let metadata =
        retried(settings, &deadline, callbacks, || request_metadata(client, request).map_err(|f| (f, 0)))?;
    let expected = ExpectedFile::of(request, &metadata)?;
    let part = PartialFile::of(request, &expected);
    let digest = retried(settings, &deadline, callbacks, || {
        let limits = Limits { deadline: &deadline, rate: RateLimit::new(settings) };
        attempt(client, request, &expected, &part, limits, callbacks)
    })?;
    part.into_place(request.target)?;
    Ok(FetchedFile {
        bytes: digest.bytes(),
        sha256: digest.hex(),
        hash_was_known: expected.sha256.is_some(),
        revision: metadata.revision,
    })
}

/// When a file must be complete.
struct Deadline {
    since: Instant,
    longest: Duration,
    url: String,
}

impl Deadline {
    fn new(settings: &HubSettings, url: &str) -> Self {
        Self { since: Instant::now(), longest: settings.longest_transfer, url: url.to_owned() }
    }

    fn check(&self) -> Result<(), HubError> {
        match self.since.elapsed() > self.longest {
            true => Err(HubError::TooSlow { url: self.url.clone(), secs: self.longest.as_secs() }),
            false => Ok(()),
        }
    }
}

/// The rate below which a connection is closed.
struct RateLimit {
    least: u64,
    window: Duration,
    since: Instant,
    bytes: u64,
}

impl RateLimit {
    fn new(settings: &HubSettings) -> Self {
        let (least, window) = (settings.min_bytes_per_sec, settings.rate_window);
        Self { least, window, since: Instant::now(), bytes: 0 }
    }

    /// Takes a piece; an error in words where the window that ends with it was too slow.
    fn add(&mut self, bytes: usize) -> Result<(), String> {
        self.bytes += bytes as u64;
        let secs = self.since.elapsed().as_secs_f64();
        if secs < self.window.as_secs_f64() {
            return Ok(());
        }
        let rate = self.bytes as f64 / secs;
        (self.since, self.bytes) = (Instant::now(), 0);
        match rate < self.least as f64 {
            true => Err(format!("{rate:.0} bytes per second are less than {}", self.least)),
            false => Ok(()),
        }
    }
}

/// What ends an attempt besides its own errors.
struct Limits<'a> {
    deadline: &'a Deadline,
    rate: RateLimit,
}

/// Retries with increasing waits. A failure carries the number of bytes that its attempt added.
fn retried<T>(
    settings: &HubSettings,
    deadline: &Deadline,
    callbacks: &TransferCallbacks<'_>,
    mut attempt: impl FnMut() -> Result<T, (Failure, u64)>,
) -> Result<T, HubError> {
    let mut tried = 0;
    loop {
        callbacks.stop()?;
        deadline.check()?;
        match attempt() {
            Ok(value) => return Ok(value),
            Err((Failure::Final(error), _)) => return Err(error),
            Err((Failure::Temporary(error, wait), gained)) => {
                tried = if gained >= REAL_PROGRESS { 1 } else { tried + 1 };
                if tried >= settings.tries {
                    return Err(error);
                }
                let doubled = settings.backoff.saturating_mul(1 << (tried - 1).min(16));
                pause(wait.unwrap_or(doubled).min(settings.longest_wait), callbacks)?;
            }
        }
    }
}

/// Waits, unless cancelled.
fn pause(wait: Duration, callbacks: &TransferCallbacks<'_>) -> Result<(), HubError> {
    let mut left = wait;
    while !left.is_zero() {
        callbacks.stop()?;
        let slice = left.min(Duration::from_millis(50));
        std::thread::sleep(slice);
        left -= slice;
    }
    callbacks.stop()
}

fn request_metadata(client: &Client<'_>, request: &FileRequest<'_>) -> Result<FileMetadata, Failure> {
    match client.ask(Method::Head, request.url) {
        Ok(response) => Ok(response.metadata),
        // A plain mirror may not support HEAD; what is missing is checked when the file streams.
        Err(Failure::Final(HubError::Status { status: 405, .. }))
        | Err(Failure::Temporary(HubError::Status { status: 501, .. }, _)) => Ok(FileMetadata::default()),
        // Without any connection, waiting for a retry only delays the message. During a transfer it is retried.
        Err(Failure::Temporary(error @ HubError::NoConnection { .. }, _)) => Err(Failure::Final(error)),
        Err(failure) => Err(failure),
    }
}

/// Expected length and hash of the file, from catalogue and hub.
struct ExpectedFile {
    bytes: Option<u64>,
    sha256: Option<String>,
}

impl ExpectedFile {
    fn of(request: &FileRequest<'_>, metadata: &FileMetadata) -> Result<Self, HubError> {
        let what = || request.url.to_owned();
        if let (Some(expected), Some(found)) = (request.bytes, metadata.bytes)
            && expected != found
        {
            return Err(HubError::WrongSize { what: what(), found, expected });
        }
        if let (Some(expected), Some(found)) = (request.sha256, &metadata.sha256)
            && expected != found
        {
            return Err(HubError::WrongHash {
                what: what(),
                found: found.clone(),
                expected: expected.to_owned(),
            });
        }
        Ok(Self {
            bytes: request.bytes.or(metadata.bytes),
            sha256: request.sha256.map(str::to_owned).or_else(|| metadata.sha256.clone()),
        })
    }

    /// Largest length of the file.
    fn most(&self) -> u64 {
        self.bytes.unwrap_or(if self.sha256.is_some() { u64::MAX } else { MOST_UNKNOWN })
    }
}

/// The incomplete file.
struct PartialFile {
    path: PathBuf,
    /// Whether its existing bytes may be used.
    continues: bool,
}

impl PartialFile {
    fn of(request: &FileRequest<'_>, expected: &ExpectedFile) -> Self {
        let key = expected.sha256.as_deref().map_or("new", |h| &h[..12]);
        let path = request.target.with_file_name(format!("{}.{key}.part", request.name));
        Self { path, continues: expected.sha256.is_some() }
    }

    fn open(&self) -> Result<File, HubError> {
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(!self.continues);
        options.open(&self.path).map_err(HubError::io("open", &self.path))
    }

    fn discard(&self) {
        // The part is invalid; if it cannot be removed, the next try truncates it.
        let _ = std::fs::remove_file(&self.path);
    }

    fn into_place(self, target: &Path) -> Result<(), HubError> {
        std::fs::rename(&self.path, target).map_err(HubError::io("rename to", target))
    }
}

fn attempt(
    client: &Client<'_>,
    request: &FileRequest<'_>,
    expected: &ExpectedFile,
    part: &PartialFile,
    limits: Limits<'_>,
    callbacks: &TransferCallbacks<'_>,
) -> Result<Digest, (Failure, u64)> {
    let last = |error: HubError| (Failure::Final(error), 0);
    let mut file = part.open().map_err(last)?;
    let mut digest = hash_prefix(&mut file, &part.path, expected.most(), callbacks).map_err(last)?;
    let before = digest.bytes();
    if expected.bytes.is_none_or(|bytes| digest.bytes() < bytes) || before == 0 {
        check_space(request.target, expected, before).map_err(last)?;
        let response = client.ask(Method::Get(before), request.url).map_err(|f| (f, 0))?;
        let into = Sink { file: &mut file, digest: &mut digest, part };
        stream(response, request, expected, into, limits, callbacks).map_err(|failure| {
            let gained = digest.bytes().saturating_sub(before);
            (failure, gained)
        })?;
    }
    file.sync_all().map_err(HubError::io("flush", &part.path)).map_err(last)?;
    let (found, what) = (digest.hex(), request.url.to_owned());
    match expected.sha256.as_deref() {
        Some(expected) if expected != found => {
            part.discard();
            let error = HubError::WrongHash { what, found, expected: expected.to_owned() };
            // Bytes of an earlier run may be the cause; without them a retry cannot help.
            Err(if before > 0 { (Failure::Temporary(error, Some(Duration::ZERO)), 0) } else { last(error) })
        }
        _ => Ok(digest),
    }
}

fn check_space(target: &Path, expected: &ExpectedFile, there: u64) -> Result<(), HubError> {
    let Some(bytes) = expected.bytes else { return Ok(()) };
    let folder = target.parent().unwrap_or(Path::new("."));
    match crate::disk::free_bytes(folder) {
        Some(available) if available < bytes - there => {
            Err(HubError::NoSpace { path: folder.to_owned(), available, needed: bytes - there })
        }
        _ => Ok(()),
    }
}

/// Where a response goes.
struct Sink<'a> {
    file: &'a mut File,
    digest: &'a mut Digest,
    part: &'a PartialFile,
}

/// Appends the response to the existing bytes, or replaces them if the server starts from the beginning.
fn stream(
    response: Response,
    request: &FileRequest<'_>,
    expected: &ExpectedFile,
    into: Sink<'_>,
    mut limits: Limits<'_>,
    callbacks: &TransferCallbacks<'_>,
) -> Result<(), Failure> {
    let Sink { file, digest, part } = into;
    let start = where_it_begins(&response, request, digest.bytes())?;
    if start != digest.bytes() {
        let restart = file.set_len(0).and_then(|()| file.seek(SeekFrom::Start(0)));
        restart.map_err(HubError::io("truncate", &part.path)).map_err(Failure::Final)?;
        *digest = Digest::new();
    }
    if response.status == 416 {
        let reason = format!("no bytes from {start} on");
        return Err(Failure::Temporary(HubError::Network { url: request.url.to_owned(), reason }, None));
    }
    check_length(&response, request, expected, start)?;
    let total = expected.bytes.unwrap_or(0);
    let mut body = response.body;
    let mut piece = vec![0; PIECE];
    loop {
        callbacks.stop().map_err(Failure::Final)?;
        let broken = |reason: String| {
            Failure::Temporary(HubError::Network { url: request.url.to_owned(), reason }, None)
        };
        let n = match body.read(&mut piece) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(broken(format!("broke off after {} bytes: {e}", digest.bytes()))),
        };
        limits.deadline.check().map_err(Failure::Final)?;
        limits.rate.add(n).map_err(broken)?;
        let found = digest.bytes() + n as u64;
        if found > expected.most() {
            part.discard();
            let what = request.url.to_owned();
            return Err(Failure::Final(HubError::WrongSize { what, found, expected: expected.most() }));
        }
        file.write_all(&piece[..n]).map_err(HubError::io("write", &part.path)).map_err(Failure::Final)?;
        digest.update(&piece[..n]);
        (callbacks.progress)(Progress { file: request.name, done: digest.bytes(), total });
    }
    match expected.bytes {
        Some(bytes) if digest.bytes() < bytes => {
            let reason = format!("ended after {} of {bytes} bytes", digest.bytes());
            Err(Failure::Temporary(HubError::Network { url: request.url.to_owned(), reason }, None))
        }
        _ => Ok(()),
    }
}

/// The byte at which the response's body begins: where asked, or 0 when the server ignores ranges.
fn where_it_begins(response: &Response, request: &FileRequest<'_>, asked: u64) -> Result<u64, Failure> {
    if response.status != 206 {
        return Ok(0);
    }
    let range = header(&response.headers, "content-range").unwrap_or_default();
    let start =
        range.strip_prefix("bytes ").and_then(|r| r.split_once('-')).and_then(|(s, _)| s.parse().ok());
    if start == Some(asked) {
        return Ok(asked);
    }
    Err(Failure::Final(HubError::BadResponse {
        url: request.url.to_owned(),
        what: "Content-Range",
        found: range.chars().take(80).collect(),
        expected: format!("bytes {asked}-…"),
    }))
}

/// Refuses an response whose metadata length cannot be right, before it is streamed.
fn check_length(
    response: &Response,
    request: &FileRequest<'_>,
    expected: &ExpectedFile,
    start: u64,
) -> Result<(), Failure> {
    let length: Option<u64> = header(&response.headers, "content-length").and_then(|v| v.trim().parse().ok());
    let Some(found) = length.map(|l| l.saturating_add(start)) else { return Ok(()) };
    let wrong = match expected.bytes {
        Some(bytes) => found != bytes,
        None => found > expected.most(),
    };
    if wrong {
        let (what, expected) = (request.url.to_owned(), expected.most());
        return Err(Failure::Final(HubError::WrongSize { what, found, expected }));
    }
    Ok(())
}
