//! Messages of a robot, as they come, as an MCAP stream: what `rmw_zenoh` carries becomes a recording that every reader here takes.

use crate::config::LinkConfig;
use crate::error::Error;
use crate::events::CancelToken;
use crate::run_folder::now_ns;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{WriteOptions, Writer};
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, Instant};
use vidar_link::ros::{Attachment, TopicKey};
use vidar_link::{Link, Role, Sample};

/// The types that a map needs.
const TYPES: [&str; 5] = [
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/Imu",
    "sensor_msgs/CameraInfo",
    "tf2_msgs/TFMessage",
];
/// The most topics: a robot with a dozen cameras has some fifty.
const MOST_TOPICS: usize = 64;
/// The most senders whose last message is remembered.
const MOST_SENDERS: usize = 4096;
/// The largest message: a colour image of 20 megapixels.
const MAX_BYTES: usize = 64 << 20;
/// How often it is looked whether to end.
const STEP: Duration = Duration::from_millis(100);
/// How long output is held back at most.
const FLUSH_EVERY: Duration = Duration::from_millis(20);

/// What to take, and for how long.
#[derive(Clone, Debug)]
pub struct ReceiveRequest {
    /// Key expressions, such as `0/cam0/**`.
    pub expressions: Vec<String>,
    /// How the robot is reached.
    pub link: LinkConfig,
    /// Ends after this time.
    pub duration: Option<Duration>,
    /// Ends when nothing came for this time, once something has.
    pub idle: Option<Duration>,
}

/// What came.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Received {
    /// Messages written, by topic.
    pub topics: BTreeMap<String, u64>,
    /// Their bytes.
    pub bytes: u64,
    /// Messages of types that no map needs, or under keys that are no topic's.
    pub ignored: u64,
    /// Messages that had come before, or came behind a later one of the same sender.
    pub repeated: u64,
    /// Messages beyond a bound, or with an attachment that is none.
    pub refused: u64,
    /// Messages left out because they came faster than they were taken.
    pub dropped: u64,
}

/// Writes messages as MCAP: one record each, so that a reader of the stream has it at once.
pub struct StreamWriter<W: Write> {
    writer: Writer<NoSeek<W>>,
    channels: HashMap<String, u16>,
    /// Last number of each sender on each topic.
    last: HashMap<([u8; 16], u16), i64>,
    received: Received,
}

impl<W: Write> StreamWriter<W> {
    /// Begins the stream.
    ///
    /// # Errors
    /// The output cannot be written.
    pub fn new(out: W) -> Result<Self, mcap::McapError> {
        let options = WriteOptions::new()
            .profile("ros2")
            .library(format!("vidar {}", crate::VERSION))
            .use_chunks(false)
            .disable_seeking(true)
            .compression(None);
        let writer = options.create(NoSeek::new(out))?;
        Ok(Self { writer, channels: HashMap::new(), last: HashMap::new(), received: Received::default() })
    }

    /// Takes a message; whether it was written. Whatever is wrong with it is counted and goes no further.
    ///
    /// # Errors
    /// The output cannot be written.
    pub fn take(&mut self, sample: &Sample, now_ns: u64) -> Result<bool, mcap::McapError> {
        let topic = TopicKey::parse(&sample.key).ok().filter(|t| TYPES.contains(&t.message_type.as_str()));
        let Some(topic) = topic else {
            self.received.ignored += 1;
            return Ok(false);
        };
        let attached = sample.attachment.as_deref().map(Attachment::decode).transpose();
        let (Ok(attached), true) = (attached, sample.payload.len() <= MAX_BYTES) else {
            self.received.refused += 1;
            return Ok(false);
        };
        let Some(channel) = self.channel(&topic)? else {
            self.received.refused += 1;
            return Ok(false);
        };
        if let Some(attached) = attached
            && !self.is_next(&attached, channel)
        {
            self.received.repeated += 1;
            return Ok(false);
        }
        let count = self.received.topics.entry(topic.topic).or_default();
        *count += 1;
        self.received.bytes += sample.payload.len() as u64;
        let publish_time = attached.and_then(|a| u64::try_from(a.sent_ns).ok()).unwrap_or(now_ns);
        let header =
            MessageHeader { channel_id: channel, sequence: *count as u32, log_time: now_ns, publish_time };
        self.writer.write_to_known_channel(&header, &sample.payload)?;
        Ok(true)
    }

    fn channel(&mut self, topic: &TopicKey) -> Result<Option<u16>, mcap::McapError> {
        let name = format!("{} {}", topic.topic, topic.message_type);
        if let Some(known) = self.channels.get(&name) {
            return Ok(Some(*known));
        }
        if self.channels.len() >= MOST_TOPICS {
            return Ok(None);
        }
        let long = topic.message_type.replacen('/', "/msg/", 1);
        let schema = self.writer.add_schema(&long, "ros2msg", b"")?;
        let notes = BTreeMap::from([("topic_type_hash".to_owned(), topic.hash.clone())]);
        let channel = self.writer.add_channel(schema, &topic.topic, "cdr", &notes)?;
        self.channels.insert(name, channel);
        Ok(Some(channel))
    }

    /// Whether it comes behind the last one of its sender.
    fn is_next(&mut self, attached: &Attachment, channel: u16) -> bool {
        let sender = (attached.sender, channel);
        let is_next = self.last.get(&sender).is_none_or(|last| attached.sequence > *last);
        if is_next {
            if self.last.len() >= MOST_SENDERS && !self.last.contains_key(&sender) {
                // A robot has dozens; who makes up thousands is forgotten with them.
                self.last.clear();
            }
            self.last.insert(sender, attached.sequence);
        }
        is_next
    }

    /// Hands on what is held back.
    ///
    /// # Errors
    /// The output cannot be written.
    pub fn flush(&mut self) -> Result<(), mcap::McapError> {
        self.writer.flush()
    }

    /// Ends the stream.
    ///
    /// # Errors
    /// The output cannot be written.
    pub fn finish(mut self) -> Result<Received, mcap::McapError> {
        self.writer.finish()?;
        Ok(self.received)
    }
}

/// Takes messages until Ctrl-C, the end of the time, or silence, and writes them to `out`. `told` hears once they are waited for.
///
/// # Errors
/// No link, or the output cannot be written. An output that is closed ends it like Ctrl-C.
pub fn receive(
    request: &ReceiveRequest,
    out: impl Write,
    told: &dyn Fn(),
    cancel: &CancelToken,
) -> Result<Received, Error> {
    let failed = |e: mcap::McapError| {
        let source = match e {
            mcap::McapError::Io(source) => source,
            other => io::Error::other(other.to_string()),
        };
        Error::io("write", Path::new("the stream"), source)
    };
    let link = Link::open(&request.link.options(), Role::Client)?;
    let subscriptions =
        request.expressions.iter().map(|e| link.subscribe(e)).collect::<Result<Vec<_>, _>>()?;
    let mut writer = StreamWriter::new(out).map_err(failed)?;
    writer.flush().map_err(failed)?;
    told();
    let (began, mut last, mut flushed) = (Instant::now(), None::<Instant>, Instant::now());
    let is_over = |last: &Option<Instant>| {
        let is_silent = request.idle.zip(*last).is_some_and(|(idle, last)| last.elapsed() > idle);
        cancel.is_cancelled() || is_silent || request.duration.is_some_and(|d| began.elapsed() > d)
    };
    let step = if subscriptions.len() == 1 { STEP } else { FLUSH_EVERY / 4 };
    let mut is_closed = false;
    while !is_over(&last) && !is_closed {
        let mut is_quiet = true;
        for subscription in &subscriptions {
            let Some(sample) = subscription.next(if is_quiet { step } else { Duration::ZERO }) else {
                continue;
            };
            (is_quiet, last) = (false, Some(Instant::now()));
            let mut written = writer.take(&sample, now_ns()).map(|_| ());
            if written.is_ok() && flushed.elapsed() > FLUSH_EVERY {
                written = writer.flush();
                flushed = Instant::now();
            }
            is_closed |= ended(written).map_err(failed)?;
        }
        if is_quiet {
            is_closed |= ended(writer.flush()).map_err(failed)?;
        }
    }
    writer.received.dropped = subscriptions.iter().map(|s| s.dropped()).sum();
    let received = writer.received.clone();
    match writer.finish() {
        Ok(received) => Ok(received),
        Err(error) => ended(Err(error)).map(|_| received).map_err(failed),
    }
}

/// Whether the reader of the output has gone.
fn ended(written: Result<(), mcap::McapError>) -> Result<bool, mcap::McapError> {
    match written {
        Ok(()) => Ok(false),
        Err(mcap::McapError::Io(e)) if e.kind() == io::ErrorKind::BrokenPipe => Ok(true),
        Err(other) => Err(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_bag::{Bag, Header, ImuMessage, Message, write::encode};
    use vidar_core::Timestamp;

    fn imu(i: i64) -> Message {
        Message::Imu(ImuMessage {
            header: Header { stamp: Timestamp::from_nanos(5_000_000 * i), frame: "imu".into() },
            angular_velocity: [i as f64, 0.0, 0.0],
            linear_acceleration: [0.0, 0.0, 9.81],
        })
    }

    fn sample(i: i64, sender: u8) -> Sample {
        Sample {
            key: "0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a".into(),
            payload: encode(&imu(i)).unwrap().1,
            attachment: Some(Attachment { sequence: i, sent_ns: 7 * i, sender: [sender; 16] }.encode()),
        }
    }

    #[test]
    fn what_comes_is_a_recording_and_what_comes_again_or_is_none_is_not() {
        let mut bytes = Vec::new();
        let mut writer = StreamWriter::new(&mut bytes).unwrap();
        let takes = |w: &mut StreamWriter<&mut Vec<u8>>, s: &Sample| w.take(s, 99).unwrap();
        for i in 0..50 {
            assert!(takes(&mut writer, &sample(i, 1)));
        }
        assert!(!takes(&mut writer, &sample(49, 1)), "twice");
        assert!(!takes(&mut writer, &sample(3, 1)), "replayed");
        assert!(takes(&mut writer, &sample(0, 2)), "the node was started again");
        let named = |key: &str| Sample { key: key.into(), ..sample(60, 1) };
        assert!(!takes(&mut writer, &named("0/chatter/std_msgs::msg::dds_::String_/RIHS01_df")));
        assert!(!takes(&mut writer, &named("no topic")));
        assert!(!takes(&mut writer, &Sample { attachment: Some(vec![1, 2, 3]), ..sample(60, 1) }));
        assert!(!takes(&mut writer, &Sample { payload: vec![0; MAX_BYTES + 1], ..sample(60, 1) }));
        assert!(
            takes(&mut writer, &Sample { attachment: None, ..sample(60, 1) }),
            "no attachment, no number"
        );
        let received = writer.finish().unwrap();
        assert_eq!(received.topics, BTreeMap::from([("/imu/data".to_owned(), 52)]));
        assert_eq!((received.ignored, received.repeated, received.refused), (2, 2, 2));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("received.mcap");
        std::fs::write(&path, &bytes).unwrap();
        let bag = Bag::open(&path).unwrap();
        let topic = &bag.topics()[0];
        assert_eq!((topic.name.as_str(), topic.messages.len()), ("/imu/data", 52));
        assert_eq!(bag.read(&topic.messages[7]).unwrap(), imu(7));
        // Whoever is killed leaves what was written.
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(Bag::open(&path).unwrap().topics()[0].messages.len() > 20);
    }

    #[test]
    fn topics_that_are_made_up_end_at_a_bound() {
        let mut writer = StreamWriter::new(Vec::new()).unwrap();
        for i in 0..500 {
            let key = format!("0/t{i}/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a");
            writer.take(&Sample { key, ..sample(i, 1) }, 0).unwrap();
        }
        let received = writer.finish().unwrap();
        assert_eq!((received.topics.len(), received.refused), (MOST_TOPICS, 500 - MOST_TOPICS as u64));
    }
}
