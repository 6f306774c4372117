//! One file: resumed, hashed while it streams, and in place only when it is whole and right.
//!
//! 1. `HEAD`: what the hub says of length and hash is held against what is expected, before a byte is fetched.
//! 2. The disk is asked whether the rest fits.
//! 3. `GET` with `Range` from the end of `<file>.<hash>.part`; what is already there is hashed first.
//! 4. Length and hash are checked, then the part takes the file's name.
//!
//! A break in the middle is followed by another try from where it broke. A part is continued only when the hash of the
//! whole is known, because nothing else would notice that two halves belong to different files.

use crate::client::{Announced, Answer, Client, Failure, Method, header};
use crate::digest::{Digest, hash_prefix};
use crate::error::HubError;
use crate::settings::HubSettings;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Bytes between two looks at the clock, the bar and the wish to stop.
const PIECE: usize = 64 << 10;
/// Longest file of which neither length nor hash is known, bytes.
const MOST_UNKNOWN: u64 = 16 << 20;
/// So much progress earns a fresh set of tries, bytes.
const REAL_PROGRESS: u64 = 1 << 20;

/// How far a file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress<'a> {
    /// Which file.
    pub file: &'a str,
    /// Bytes that are there.
    pub done: u64,
    /// Bytes that there will be; 0 when the hub does not say.
    pub total: u64,
}

/// Who is told and who may stop it.
pub struct Watch<'a> {
    /// Told of progress, at most once per 64 KiB.
    pub progress: &'a dyn Fn(Progress<'_>),
    /// Asked now and then; `true` stops.
    pub cancel: &'a dyn Fn() -> bool,
}

impl Watch<'_> {
    pub(crate) fn stop(&self) -> Result<(), HubError> {
        if (self.cancel)() { Err(HubError::Cancelled) } else { Ok(()) }
    }
}

/// What is to be fetched.
pub(crate) struct Wanted<'a> {
    pub url: &'a str,
    pub target: &'a Path,
    pub name: &'a str,
    pub bytes: Option<u64>,
    pub sha256: Option<&'a str>,
}

/// What was fetched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Fetched {
    pub bytes: u64,
    pub sha256: String,
    /// Whether hub or catalogue named that hash beforehand.
    pub hash_was_known: bool,
    pub revision: Option<String>,
}

/// Fetches one file.
pub(crate) fn fetch(
    client: &Client<'_>,
    settings: &HubSettings,
    wanted: &Wanted<'_>,
    watch: &Watch<'_>,
) -> Result<Fetched, HubError> {
    let announced = retried(settings, watch, || ask_about(client, wanted).map_err(|f| (f, 0)))?;
    let expected = Expected::of(wanted, &announced)?;
    let part = Part::of(wanted, &expected);
    let digest = retried(settings, watch, || attempt(client, wanted, &expected, &part, watch))?;
    part.into_place(wanted.target)?;
    Ok(Fetched {
        bytes: digest.bytes(),
        sha256: digest.hex(),
        hash_was_known: expected.sha256.is_some(),
        revision: announced.revision,
    })
}

/// Tries, waits, tries again. A failure comes with the bytes that its attempt added.
fn retried<T>(
    settings: &HubSettings,
    watch: &Watch<'_>,
    mut attempt: impl FnMut() -> Result<T, (Failure, u64)>,
) -> Result<T, HubError> {
    let mut tried = 0;
    loop {
        watch.stop()?;
        match attempt() {
            Ok(value) => return Ok(value),
            Err((Failure::Final(error), _)) => return Err(error),
            Err((Failure::Passing(error, wait), gained)) => {
                tried = if gained >= REAL_PROGRESS { 1 } else { tried + 1 };
                if tried >= settings.tries {
                    return Err(error);
                }
                let doubled = settings.backoff.saturating_mul(1 << (tried - 1).min(16));
                pause(wait.unwrap_or(doubled).min(settings.longest_wait), watch)?;
            }
        }
    }
}

/// Waits, but not longer than the user wants.
fn pause(wait: Duration, watch: &Watch<'_>) -> Result<(), HubError> {
    let mut left = wait;
    while !left.is_zero() {
        watch.stop()?;
        let slice = left.min(Duration::from_millis(50));
        std::thread::sleep(slice);
        left -= slice;
    }
    watch.stop()
}

fn ask_about(client: &Client<'_>, wanted: &Wanted<'_>) -> Result<Announced, Failure> {
    match client.ask(Method::Head, wanted.url) {
        Ok(answer) => Ok(answer.announced),
        // A plain mirror may not know HEAD; what is missing is checked when the file streams.
        Err(Failure::Final(HubError::Status { status: 405, .. }))
        | Err(Failure::Passing(HubError::Status { status: 501, .. }, _)) => Ok(Announced::default()),
        Err(failure) => Err(failure),
    }
}

/// What the file must be, from catalogue and hub together.
struct Expected {
    bytes: Option<u64>,
    sha256: Option<String>,
}

impl Expected {
    fn of(wanted: &Wanted<'_>, announced: &Announced) -> Result<Self, HubError> {
        let what = || wanted.url.to_owned();
        if let (Some(expected), Some(found)) = (wanted.bytes, announced.bytes)
            && expected != found
        {
            return Err(HubError::WrongSize { what: what(), found, expected });
        }
        if let (Some(expected), Some(found)) = (wanted.sha256, &announced.sha256)
            && expected != found
        {
            return Err(HubError::WrongHash {
                what: what(),
                found: found.clone(),
                expected: expected.to_owned(),
            });
        }
        Ok(Self {
            bytes: wanted.bytes.or(announced.bytes),
            sha256: wanted.sha256.map(str::to_owned).or_else(|| announced.sha256.clone()),
        })
    }

    /// No file may become longer than this.
    fn most(&self) -> u64 {
        self.bytes.unwrap_or(if self.sha256.is_some() { u64::MAX } else { MOST_UNKNOWN })
    }
}

/// The unfinished file.
struct Part {
    path: PathBuf,
    /// Whether what it holds from before may be used.
    continues: bool,
}

impl Part {
    fn of(wanted: &Wanted<'_>, expected: &Expected) -> Self {
        let key = expected.sha256.as_deref().map_or("new", |h| &h[..12]);
        let path = wanted.target.with_file_name(format!("{}.{key}.part", wanted.name));
        Self { path, continues: expected.sha256.is_some() }
    }

    fn open(&self) -> Result<File, HubError> {
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(!self.continues);
        options.open(&self.path).map_err(HubError::io("open", &self.path))
    }

    fn discard(&self) {
        // Ours and wrong; if it cannot be removed, the next try truncates it.
        let _ = std::fs::remove_file(&self.path);
    }

    fn into_place(self, target: &Path) -> Result<(), HubError> {
        std::fs::rename(&self.path, target).map_err(HubError::io("rename to", target))
    }
}

fn attempt(
    client: &Client<'_>,
    wanted: &Wanted<'_>,
    expected: &Expected,
    part: &Part,
    watch: &Watch<'_>,
) -> Result<Digest, (Failure, u64)> {
    let last = |error: HubError| (Failure::Final(error), 0);
    let mut file = part.open().map_err(last)?;
    let mut digest = hash_prefix(&mut file, &part.path, expected.most(), watch).map_err(last)?;
    let before = digest.bytes();
    if expected.bytes.is_none_or(|bytes| digest.bytes() < bytes) || before == 0 {
        check_space(wanted.target, expected, before).map_err(last)?;
        let answer = client.ask(Method::Get(before), wanted.url).map_err(|f| (f, 0))?;
        stream(answer, wanted, expected, &mut file, &mut digest, part, watch).map_err(|failure| {
            let gained = digest.bytes().saturating_sub(before);
            (failure, gained)
        })?;
    }
    file.sync_all().map_err(HubError::io("flush", &part.path)).map_err(last)?;
    let (found, what) = (digest.hex(), wanted.url.to_owned());
    match expected.sha256.as_deref() {
        Some(expected) if expected != found => {
            part.discard();
            let error = HubError::WrongHash { what, found, expected: expected.to_owned() };
            // Bytes from an earlier day may be to blame; without them there is nothing else to blame.
            Err(if before > 0 { (Failure::Passing(error, Some(Duration::ZERO)), 0) } else { last(error) })
        }
        _ => Ok(digest),
    }
}

fn check_space(target: &Path, expected: &Expected, there: u64) -> Result<(), HubError> {
    let Some(bytes) = expected.bytes else { return Ok(()) };
    let folder = target.parent().unwrap_or(Path::new("."));
    match crate::disk::free_bytes(folder) {
        Some(available) if available < bytes - there => {
            Err(HubError::NoSpace { path: folder.to_owned(), available, needed: bytes - there })
        }
        _ => Ok(()),
    }
}

/// Writes the answer behind what is there, or instead of it when the server begins anew.
fn stream(
    answer: Answer,
    wanted: &Wanted<'_>,
    expected: &Expected,
    file: &mut File,
    digest: &mut Digest,
    part: &Part,
    watch: &Watch<'_>,
) -> Result<(), Failure> {
    let start = where_it_begins(&answer, wanted, digest.bytes())?;
    if start != digest.bytes() {
        let restart = file.set_len(0).and_then(|()| file.seek(SeekFrom::Start(0)));
        restart.map_err(HubError::io("truncate", &part.path)).map_err(Failure::Final)?;
        *digest = Digest::new();
    }
    if answer.status == 416 {
        let reason = format!("no bytes from {start} on");
        return Err(Failure::Passing(HubError::Network { url: wanted.url.to_owned(), reason }, None));
    }
    check_length(&answer, wanted, expected, start)?;
    let total = expected.bytes.unwrap_or(0);
    let mut body = answer.body;
    let mut piece = vec![0; PIECE];
    loop {
        watch.stop().map_err(Failure::Final)?;
        let broken =
            |reason: String| Failure::Passing(HubError::Network { url: wanted.url.to_owned(), reason }, None);
        let n = match body.read(&mut piece) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(broken(format!("broke off after {} bytes: {e}", digest.bytes()))),
        };
        let found = digest.bytes() + n as u64;
        if found > expected.most() {
            part.discard();
            let what = wanted.url.to_owned();
            return Err(Failure::Final(HubError::WrongSize { what, found, expected: expected.most() }));
        }
        file.write_all(&piece[..n]).map_err(HubError::io("write", &part.path)).map_err(Failure::Final)?;
        digest.update(&piece[..n]);
        (watch.progress)(Progress { file: wanted.name, done: digest.bytes(), total });
    }
    match expected.bytes {
        Some(bytes) if digest.bytes() < bytes => {
            let reason = format!("ended after {} of {bytes} bytes", digest.bytes());
            Err(Failure::Passing(HubError::Network { url: wanted.url.to_owned(), reason }, None))
        }
        _ => Ok(()),
    }
}

/// The byte at which the answer's body begins: where asked, or 0 when the server ignores ranges.
fn where_it_begins(answer: &Answer, wanted: &Wanted<'_>, asked: u64) -> Result<u64, Failure> {
    if answer.status != 206 {
        return Ok(0);
    }
    let range = header(&answer.headers, "content-range").unwrap_or_default();
    let start =
        range.strip_prefix("bytes ").and_then(|r| r.split_once('-')).and_then(|(s, _)| s.parse().ok());
    if start == Some(asked) {
        return Ok(asked);
    }
    Err(Failure::Final(HubError::BadAnswer {
        url: wanted.url.to_owned(),
        what: "Content-Range",
        found: range.chars().take(80).collect(),
        expected: format!("bytes {asked}-…"),
    }))
}

/// Refuses an answer whose announced length cannot be right, before it is streamed.
fn check_length(
    answer: &Answer,
    wanted: &Wanted<'_>,
    expected: &Expected,
    start: u64,
) -> Result<(), Failure> {
    let length: Option<u64> = header(&answer.headers, "content-length").and_then(|v| v.trim().parse().ok());
    let Some(found) = length.map(|l| l.saturating_add(start)) else { return Ok(()) };
    let wrong = match expected.bytes {
        Some(bytes) => found != bytes,
        None => found > expected.most(),
    };
    if wrong {
        let (what, expected) = (wanted.url.to_owned(), expected.most());
        return Err(Failure::Final(HubError::WrongSize { what, found, expected }));
    }
    Ok(())
}
