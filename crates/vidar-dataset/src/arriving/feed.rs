//! The thread that takes the stream: it writes the file, then hands out what came whole.

use crate::error::{DatasetError, io_error};
use nalgebra::Vector3;
use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Instant;
use vidar_bag::{
    KeptStream, McapStream, Message, Role, StreamEnd, StreamMessage, StreamPlace, StreamTopic, role_of,
};
use vidar_core::{AngularRate, ImuSample, SpecificForce, Timestamp, Warning};

/// Bytes taken at a time.
const PIECE_BYTES: usize = 64 << 10;
/// Messages that wait for who takes them; the stream then waits, too. Their images lie in the file.
const CAPACITY: usize = 1024;

/// A message that is used.
#[derive(Debug)]
pub(super) struct Item {
    pub topic: Arc<StreamTopic>,
    /// Its stamp, or when it was logged.
    pub time: Timestamp,
    pub place: StreamPlace,
    /// Bytes of the stream in which it came.
    pub end: u64,
    /// When it came.
    pub came: Instant,
    pub kind: Kind,
}

#[derive(Debug)]
pub(super) enum Kind {
    Image,
    Imu(ImuSample),
    CameraInfo,
}

enum Sent {
    Item(Box<Item>),
    /// The stream has ended, with what is to be said of it.
    End(Vec<Warning>),
    Failed(Box<DatasetError>),
}

/// What comes from the thread.
pub(super) struct Feed {
    kept: Arc<KeptStream>,
    items: Receiver<Sent>,
    /// What the end of the stream said.
    ending: std::sync::Mutex<Vec<Warning>>,
}

impl std::fmt::Debug for Feed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Feed").field("kept", &self.kept).finish_non_exhaustive()
    }
}

impl Feed {
    /// Starts the thread. It ends with the stream, or when nobody takes what comes and something more comes.
    pub fn start(input: impl Read + Send + 'static, path: &Path) -> Result<Self, DatasetError> {
        let file = File::create(path).map_err(io_error(path))?;
        let kept = Arc::new(KeptStream::open(path)?);
        let (sender, items) = sync_channel(CAPACITY);
        let of_thread = Arc::clone(&kept);
        let work = move || {
            let sent = take(input, file, &of_thread, &sender);
            // Nobody may be there to hear of it any more.
            let _ = sender.send(sent);
        };
        std::thread::Builder::new().name("vidar stream".into()).spawn(work).map_err(io_error(path))?;
        Ok(Self { kept, items, ending: std::sync::Mutex::default() })
    }

    pub fn kept(&self) -> Arc<KeptStream> {
        Arc::clone(&self.kept)
    }

    /// The next message; `None` at the end, and where one is not to go on.
    pub fn next(&self, go_on: &dyn Fn() -> bool) -> Result<Option<Item>, DatasetError> {
        const STEP: std::time::Duration = std::time::Duration::from_millis(50);
        loop {
            match self.items.recv_timeout(STEP) {
                Ok(Sent::Item(item)) => return Ok(Some(*item)),
                Ok(Sent::End(warnings)) => {
                    let mut ending = self.ending.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                    ending.extend(warnings);
                    return Ok(None);
                }
                Ok(Sent::Failed(error)) => return Err(*error),
                Err(RecvTimeoutError::Timeout) if go_on() => {}
                Err(_) => return Ok(None),
            }
        }
    }

    /// What the end of the stream said.
    pub fn ending(&self) -> Vec<Warning> {
        std::mem::take(&mut *self.ending.lock().unwrap_or_else(std::sync::PoisonError::into_inner))
    }
}

/// Takes all of the stream, or until nobody takes what comes.
fn take(mut input: impl Read, mut file: File, kept: &Arc<KeptStream>, sender: &SyncSender<Sent>) -> Sent {
    let mut parser = McapStream::new(kept);
    let (mut piece, mut is_heard, mut handed, mut unread) = (vec![0; PIECE_BYTES], true, 0usize, 0usize);
    let path = kept.path();
    let broken = loop {
        let count = match input.read(&mut piece) {
            Ok(0) => break None,
            Ok(count) => count,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => break Some(DatasetError::Io { path: "-".into(), source: e }),
        };
        let came = &piece[..count];
        // The file first: what is handed out can be read from it.
        if let Err(e) = file.write_all(came) {
            break Some(io_error(path)(e));
        }
        let mut sink = |message: StreamMessage<'_>| match item(&message) {
            Some(Ok(item)) => {
                handed += 1;
                is_heard &= sender.send(Sent::Item(Box::new(item))).is_ok();
            }
            Some(Err(())) => unread += 1,
            None => {}
        };
        if let Err(e) = parser.push(came, &mut sink) {
            break Some(e.into());
        }
        if !is_heard {
            break None;
        }
    };
    match broken {
        // What cannot be used from the beginning is an error; what breaks later ends the recording.
        Some(error) if handed == 0 => Sent::Failed(Box::new(error)),
        broken => Sent::End(ending(&parser.finish(), broken, unread, path)),
    }
}

/// What is to be said of a stream that ended.
fn ending(end: &StreamEnd, broken: Option<DatasetError>, unread: usize, path: &Path) -> Vec<Warning> {
    let mut said = Vec::new();
    let mut say =
        |kind: &str, message: String| said.push(Warning::degraded(kind, message).at(path.display()));
    if let Some(error) = broken {
        say(
            "stream-broken",
            format!("the stream cannot be read any further: {error}; what came before is used"),
        );
    } else if !end.is_closed {
        let message = format!(
            "the stream is cut off: its last {} bytes are no whole record; the {} messages before them are used",
            end.lost_bytes, end.messages
        );
        say("stream-cut-off", message);
    }
    if end.damaged_chunks > 0 {
        say("bag-chunk", format!("{} chunks are damaged and left out", end.damaged_chunks));
    }
    if end.unknown > 0 {
        let message =
            format!("{} messages belong to channels that no record describes; left out", end.unknown);
        say("bag-connection", message);
    }
    if unread > 0 {
        say(
            "imu-unreadable",
            format!("{unread} IMU samples or heads of images cannot be read and are left out"),
        );
    }
    said
}

/// A message that is used; an error where it cannot be read.
fn item(message: &StreamMessage<'_>) -> Option<Result<Item, ()>> {
    let topic = message.topic;
    let made = |time: Timestamp, kind: Kind| {
        let time = if time.nanos() == 0 { message.log_time } else { time };
        let (place, end, came) = (message.place, message.end, Instant::now());
        Item { topic: Arc::clone(topic), time, place, end, came, kind }
    };
    Some(match role_of(&topic.message_type, topic.encoding)? {
        Role::Image => topic.header(message.data).map(|header| made(header.stamp, Kind::Image)).map_err(drop),
        Role::CameraInfo => Ok(made(message.log_time, Kind::CameraInfo)),
        Role::Imu => match topic.decode(message.data) {
            Ok(Message::Imu(sample)) => {
                let (gyro, accel) = (sample.angular_velocity, sample.linear_acceleration);
                if !gyro.iter().chain(&accel).all(|v| v.is_finite()) {
                    return Some(Err(()));
                }
                let made = made(sample.header.stamp, Kind::CameraInfo);
                let (gyro, accel) = (AngularRate(Vector3::from(gyro)), SpecificForce(Vector3::from(accel)));
                let sample = ImuSample { time: made.time, gyro, accel };
                Ok(Item { kind: Kind::Imu(sample), ..made })
            }
            _ => Err(()),
        },
        // Video is refused when the topics are chosen; poses and transforms are read from the file.
        _ => return None,
    })
}
