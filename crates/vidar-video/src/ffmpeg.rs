//! The user's own `ffmpeg` program (5.1 or newer) as a decoder, where the user asks for it by name. It is started, never fetched.
//!
//! Pictures come through a pipe as PPM, which states its size. A thread takes them out of the pipe and keeps two ready; the program
//! waits when the pipe is full, so memory is bounded, and is killed when the reader goes.

use crate::error::VideoError;
use crate::lane::PICTURE_LIMIT;
use crate::picture::check_size;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use vidar_core::{FrameImage, Image, Timestamp, printable};

/// Who decodes a video.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum VideoDecoder {
    /// The decoders that are part of VIDAR.
    #[default]
    BuiltIn,
    /// The `ffmpeg` program of this machine, for what the others refuse.
    Ffmpeg,
}

/// Name of the program, which is looked for where the system looks for programs.
const PROGRAM: &str = "ffmpeg";
/// Frames ahead that are decoded and dropped; further ahead the program is started anew there.
const SKIPPED_AT_MOST: usize = 64;
/// Most frames of a video: ten hours at 1 kHz.
const MAX_FRAMES: usize = 36_000_000;
/// What is kept of the program's messages, bytes.
const KEPT_MESSAGES: usize = 4 << 10;

/// A video that the program decodes.
pub(crate) struct Ffmpeg {
    program: PathBuf,
    path: PathBuf,
    /// When each frame is shown, ascending, as the file states it.
    times: Vec<Timestamp>,
    running: Mutex<Option<Running<FrameImage>>>,
}

impl Ffmpeg {
    pub(crate) fn new(path: &Path, times: Vec<Timestamp>) -> Self {
        Self { program: PROGRAM.into(), path: path.to_path_buf(), times, running: Mutex::default() }
    }

    #[cfg(test)]
    fn with_program(mut self, program: &Path) -> Self {
        self.program = program.to_path_buf();
        self
    }

    /// Decodes a frame, upright; the error is the reason as text.
    pub(crate) fn frame(&self, number: usize) -> Result<FrameImage, String> {
        let mut state = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        let is_ahead = |r: &Running<_>| (r.next..r.next + SKIPPED_AT_MOST).contains(&number);
        let mut running = match state.take().filter(is_ahead) {
            Some(running) => running,
            None => self.start_at(number)?,
        };
        while running.next < number {
            running.take()?;
        }
        let image = running.take()?;
        *state = Some(running);
        Ok(image)
    }

    fn start_at(&self, number: usize) -> Result<Running<FrameImage>, String> {
        let mut command = command(&self.program);
        if number > 0 {
            // Between this frame and the one before: the program drops what is shown before this time.
            let time = |n: usize| self.times.get(n).map_or(0.0, |t| t.as_secs_f64());
            command.args([
                "-seek_timestamp",
                "1",
                "-ss",
                &format!("{:.6}", 0.5 * (time(number - 1) + time(number))),
            ]);
        }
        command.arg("-i").arg(input(&self.path));
        command.args(["-map", "0:v:0", "-fps_mode", "passthrough", "-pix_fmt", "rgb24"]);
        command.args(["-f", "image2pipe", "-c:v", "ppm", "pipe:1"]);
        Running::start(command, number, read_ppm)
    }
}

/// Times at which the frames of a video are shown, ascending, as the file states them: as the program reads its packets, without decoding.
pub(crate) fn times(path: &Path) -> Result<Vec<Timestamp>, VideoError> {
    times_by(path, Path::new(PROGRAM)).map_err(|reason| VideoError::Unsupported {
        path: path.to_path_buf(),
        found: format!("the program ffmpeg does not list its frames: {reason}"),
        way: "see what `ffmpeg -i FILE` says of it".into(),
    })
}

fn times_by(path: &Path, program: &Path) -> Result<Vec<Timestamp>, String> {
    let mut command = command(program);
    // Without `-copyts` its times begin at zero, whatever those of the file.
    command.arg("-copyts").arg("-i").arg(input(path));
    command.args(["-map", "0:v:0", "-c", "copy", "-f", "framecrc", "pipe:1"]);
    let mut running = Running::start(command, 0, read_packet)?;
    let (mut scale, mut times) = (None, Vec::new());
    while let Some(line) = running.try_take()? {
        match line {
            Packet::Scale(nanos_per_tick) => scale = Some(nanos_per_tick),
            Packet::Shown(ticks) if times.len() < MAX_FRAMES => {
                let nanos = scale.map_or(0.0, |s: f64| (ticks as f64 * s).round());
                times.push(Timestamp::from_nanos(nanos as i64));
            }
            Packet::Shown(_) | Packet::Other => {}
        }
    }
    if times.is_empty() {
        return Err(running.reason("it holds no video"));
    }
    times.sort();
    Ok(times)
}

/// A line of `framecrc`.
enum Packet {
    /// `#tb 0: 1/1000`: nanoseconds of a tick.
    Scale(f64),
    /// `0, dts, pts, duration, size, sum`.
    Shown(i64),
    Other,
}

fn read_packet(out: &mut BufReader<ChildStdout>) -> Result<Option<Packet>, String> {
    let mut line = String::new();
    // A line has under a hundred bytes.
    if out.take(1 << 10).read_line(&mut line).map_err(|e| e.to_string())? == 0 {
        return Ok(None);
    }
    if let Some((num, den)) = line.strip_prefix("#tb 0:").and_then(|t| t.trim().split_once('/')) {
        let (num, den) = (num.parse::<f64>().unwrap_or(0.0), den.parse::<f64>().unwrap_or(0.0));
        let scale = 1e9 * num / den;
        return if scale.is_finite() { Ok(Some(Packet::Scale(scale))) } else { Ok(Some(Packet::Other)) };
    }
    let shown = line.strip_prefix("0,").and_then(|l| l.split(',').nth(1)?.trim().parse().ok());
    Ok(Some(shown.map_or(Packet::Other, Packet::Shown)))
}

/// A picture in PPM as the program writes it: `P6`, columns and rows, 255, the pixels.
fn read_ppm(out: &mut BufReader<ChildStdout>) -> Result<Option<FrameImage>, String> {
    let mut line = |most: u64| -> Result<String, String> {
        let mut text = String::new();
        out.take(most).read_line(&mut text).map_err(|e| e.to_string())?;
        Ok(text.trim().to_string())
    };
    let kind = line(16)?;
    if kind.is_empty() {
        return Ok(None);
    }
    let (size, depth) = (line(32)?, line(16)?);
    let sides = size.split_once(' ').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let Some((width, height)) = sides.filter(|_| kind == "P6" && depth == "255") else {
        return Err("it gave something that is no picture".into());
    };
    let (width, height): (usize, usize) = (width, height);
    check_size(width as u64, height as u64)?;
    let mut pixels = vec![[0u8; 3]; width * height];
    out.read_exact(pixels.as_flattened_mut()).map_err(|_| "it ended inside of a picture".to_string())?;
    Image::from_vec(width, height, pixels)
        .map(|image| Some(FrameImage::Rgb8(image)))
        .map_err(|e| e.to_string())
}

/// The program with what holds for every call: no keyboard, errors only, and nothing but files of this machine.
fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    command.args(["-nostdin", "-v", "error", "-protocol_whitelist", "file,pipe"]);
    command
}

/// A path that is no option and no protocol, whatever its name.
fn input(path: &Path) -> std::ffi::OsString {
    let mut text = std::ffi::OsString::from("file:");
    text.push(path);
    text
}

/// A running program, and what a thread takes out of its pipe.
struct Running<T> {
    child: Child,
    next: usize,
    items: Option<Receiver<Result<T, String>>>,
    messages: Arc<Mutex<Vec<u8>>>,
    threads: Vec<JoinHandle<()>>,
}

impl<T: Send + 'static> Running<T> {
    fn start(
        mut command: Command,
        next: usize,
        read: fn(&mut BufReader<ChildStdout>) -> Result<Option<T>, String>,
    ) -> Result<Self, String> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => {
                "the program ffmpeg is not on this machine (--decoder ffmpeg uses one that you have installed)".into()
            }
            _ => format!("the program ffmpeg cannot be started: {e}"),
        })?;
        let (out, mut err) = (child.stdout.take(), child.stderr.take());
        let messages = Arc::new(Mutex::new(Vec::new()));
        let (done, items) = sync_channel(2);
        let kept = Arc::clone(&messages);
        let reads = std::thread::spawn(move || {
            let Some(mut out) = out.map(BufReader::new) else { return };
            while let Some(item) = read(&mut out).transpose() {
                let is_last = item.is_err();
                if done.send(item).is_err() || is_last {
                    return;
                }
            }
        });
        let listens = std::thread::spawn(move || {
            let mut buffer = [0; 512];
            while let Some(Ok(count @ 1..)) = err.as_mut().map(|e| e.read(&mut buffer)) {
                let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
                kept.extend_from_slice(&buffer[..count]);
                let over = kept.len().saturating_sub(KEPT_MESSAGES);
                kept.drain(..over);
            }
        });
        Ok(Self { child, next, items: Some(items), messages, threads: vec![reads, listens] })
    }

    /// The next item; `None` at the end.
    fn try_take(&mut self) -> Result<Option<T>, String> {
        let received = self.items.as_ref().map(|items| items.recv_timeout(PICTURE_LIMIT));
        self.next += 1;
        match received {
            Some(Ok(item)) => item.map(Some).map_err(|reason| self.reason(&reason)),
            Some(Err(RecvTimeoutError::Timeout)) => {
                Err(format!("the program ffmpeg gave nothing within {} s", PICTURE_LIMIT.as_secs()))
            }
            Some(Err(RecvTimeoutError::Disconnected)) | None => {
                let status = self.child.wait().map_err(|e| e.to_string())?;
                if status.success() { Ok(None) } else { Err(self.reason(&status.to_string())) }
            }
        }
    }

    fn take(&mut self) -> Result<T, String> {
        let number = self.next;
        self.try_take()?.ok_or_else(|| self.reason(&format!("it ended before frame {number}")))
    }

    /// A reason with the last line that the program said.
    fn reason(&mut self, what: &str) -> String {
        // What it said is whole once it has ended.
        self.end();
        let said = self.messages.lock().unwrap_or_else(PoisonError::into_inner);
        let said = String::from_utf8_lossy(&said);
        match said.lines().map(str::trim).rfind(|line| !line.is_empty()) {
            Some(line) => format!("the program ffmpeg: {what}; it said: {}", printable(line)),
            None => format!("the program ffmpeg: {what}"),
        }
    }
}

impl<T> Running<T> {
    /// Ends the program and the threads that listen to it.
    fn end(&mut self) {
        self.items = None;
        // It has ended already, or it is to.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

impl<T> Drop for Running<T> {
    fn drop(&mut self) {
        self.end();
    }
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A program of the same name that does what a test needs.
    fn script(folder: &Path, text: &str) -> PathBuf {
        let path = folder.join("ffmpeg");
        std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        path
    }

    /// A script that another thread still writes while this one starts a program cannot be started itself.
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

    fn frames(text: &str) -> (tempfile::TempDir, Ffmpeg) {
        let folder = tempfile::tempdir().unwrap();
        let times = (0..9).map(|n| Timestamp::from_nanos(n * 40_000_000)).collect();
        let made = Ffmpeg::new(Path::new("clip.mkv"), times).with_program(&script(folder.path(), text));
        (folder, made)
    }

    #[test]
    fn an_absent_program_and_a_failing_one_are_told_apart() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        let (folder, made) = frames("echo first >&2; printf 'bad \\033[31mcodec\\n' >&2; exit 1");
        let failed = made.frame(0).unwrap_err();
        assert!(failed.contains("exit status: 1") && failed.contains("codec"), "{failed}");
        assert!(!failed.contains('\u{1b}') && !failed.contains("first"), "{failed:?}");
        let absent = made.with_program(&folder.path().join("nowhere")).frame(0).unwrap_err();
        assert!(absent.contains("not on this machine"), "{absent}");
    }

    #[test]
    fn what_is_no_picture_or_too_large_or_cut_is_an_error() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        let error = |text: &str| frames(text).1.frame(0).unwrap_err();
        assert!(error("echo hello").contains("no picture"));
        assert!(error("printf 'P6\\n100000 100000\\n255\\n'").contains("100000x100000"));
        assert!(error("printf 'P6\\n2 2\\n255\\nabc'").contains("inside of a picture"));
        assert!(error("exit 0").contains("ended before frame 0"));
    }

    #[test]
    fn pictures_are_read_in_order_and_the_program_ends_with_the_reader() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        // One picture, and then it goes on for ever.
        let text = "echo $$ > \"$(dirname \"$0\")/pid\"; printf 'P6\\n1 2\\n255\\nabcdef'; exec sleep 600";
        let (folder, made) = frames(text);
        let FrameImage::Rgb8(image) = made.frame(0).unwrap() else { panic!("no colour") };
        assert_eq!((image.width(), image.data()), (1, &[*b"abc", *b"def"][..]));
        drop(made);
        let pid = std::fs::read_to_string(folder.path().join("pid")).unwrap();
        assert!(!Path::new("/proc").join(pid.trim()).exists(), "{pid} still runs");
    }

    #[test]
    fn times_are_those_of_the_packets_in_the_order_of_display() {
        let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = tempfile::tempdir().unwrap();
        let list = "echo '#tb 0: 1/1000'; echo '0, 0, 0, 40, 9, 0x1'; echo '0, 40, 80, 40, 9, 0x1'; echo '0, 80, 40, 40, 9, 0x1'";
        let times = times_by(Path::new("a"), &script(folder.path(), list)).unwrap();
        assert_eq!(times.iter().map(|t| t.nanos()).collect::<Vec<_>>(), [0, 40_000_000, 80_000_000]);
        let none = times_by(Path::new("a"), &script(folder.path(), "echo '#tb 0: 1/0'")).unwrap_err();
        assert!(none.contains("holds no video"), "{none}");
    }
}
