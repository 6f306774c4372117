//! A recording from a stream: the same measurements in the same order as from the file, whatever the pieces; its images read again;
//! cut off, broken and refused streams.

use std::io::Read;
use std::path::Path;
use vidar_bag::write::{McapWriter, encode};
use vidar_bag::{CameraInfo, FrameTransform, Header, ImuMessage, Message, Pose, RawImage};
use vidar_core::{FrameImage, SensorEvent, Timestamp};
use vidar_dataset::{Arrived, ArrivingRecording, CalibrationSource, DatasetError, OpenOptions, Recording};

const MS: i64 = 1_000_000;
const START: i64 = 1_700_000_000_000 * MS;

fn header(at: i64, frame: &str) -> Header {
    Header { stamp: Timestamp::from_nanos(START + at), frame: frame.into() }
}

/// Four seconds of a camera at 20 Hz and an IMU at 200 Hz as a driver logs them: images 40 ms after their stamps.
fn recorded() -> Vec<u8> {
    recorded_with(|_| {})
}

/// The same with something changed.
fn recorded_with(change: impl Fn(&mut Vec<(i64, &str, Message)>)) -> Vec<u8> {
    let mut messages: Vec<(i64, &str, Message)> = Vec::new();
    let pose = Pose { position: [0.1, 0.0, 0.0], orientation: [0.0, 0.0, 0.0, 1.0] };
    let mount = FrameTransform { parent: header(0, "imu"), child: "cam".into(), pose };
    messages.push((0, "/tf_static", Message::Transforms(vec![mount])));
    for i in 0..800 {
        let at = i * 5 * MS;
        let (w, a) = ([0.01 * (i as f64).sin(), 0.0, 0.02], [0.0, 0.1, 9.81]);
        let sample = ImuMessage { header: header(at, "imu"), angular_velocity: w, linear_acceleration: a };
        messages.push((at, "/imu", Message::Imu(sample)));
    }
    for i in 0..80 {
        let at = i * 50 * MS + MS;
        let data = (0..16 * 12).map(|p| (p + i) as u8).collect();
        let image = RawImage {
            header: header(at, "cam"),
            width: 16,
            height: 12,
            encoding: "mono8".into(),
            row_bytes: 16,
            is_big_endian: false,
            data,
        };
        let info = CameraInfo {
            header: header(at, "cam"),
            width: 16,
            height: 12,
            distortion_model: "plumb_bob".into(),
            distortion: vec![0.0; 5],
            k: [10.0, 0.0, 7.5, 0.0, 10.0, 5.5, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [10.0, 0.0, 7.5, 0.0, 0.0, 10.0, 5.5, 0.0, 0.0, 0.0, 1.0, 0.0],
        };
        messages.push((at + 40 * MS, "/cam/image_raw", Message::Image(image)));
        messages.push((at + 40 * MS, "/cam/camera_info", Message::CameraInfo(Box::new(info))));
    }
    messages.sort_by_key(|(at, ..)| *at);
    change(&mut messages);
    let mut writer = McapWriter::new(Vec::new(), "test").unwrap();
    let mut channels = std::collections::BTreeMap::new();
    for (at, topic, message) in &messages {
        let (name, bytes) = encode(message).unwrap();
        let channel = *channels.entry(*topic).or_insert_with(|| writer.channel(topic, name).unwrap());
        writer.write(channel, Timestamp::from_nanos(START + at), &bytes).unwrap();
    }
    writer.finish().unwrap()
}

/// A stream that gives a few bytes at a time, and then ends, or breaks.
struct Pieces(std::io::Cursor<Vec<u8>>, usize);

impl Read for Pieces {
    fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
        let most = into.len().min(self.1);
        self.0.read(&mut into[..most])
    }
}

struct Came {
    facts: Recording,
    /// Times and, of images, their numbers and pixels.
    measured: Vec<(Timestamp, Option<(u32, FrameImage)>)>,
    stream: ArrivingRecording,
}

fn arrived(bytes: Vec<u8>, piece: usize, kept: &Path, options: &OpenOptions) -> Result<Came, DatasetError> {
    let input = Pieces(std::io::Cursor::new(bytes), piece);
    let (stream, facts) = ArrivingRecording::open(input, kept, options, &|| true)?;
    let (mut arrivals, mut measured) = (stream.arrivals().unwrap(), Vec::new());
    assert!(stream.arrivals().is_none());
    while let Some(arrival) = arrivals.next(&|| true) {
        measured.push(match arrival.what {
            Arrived::Imu(sample) => (sample.time, None),
            Arrived::Image(entry, image) => (entry.time, Some((entry.frame_id.0, image.unwrap()))),
        });
    }
    Ok(Came { facts, measured, stream })
}

fn of_file(path: &Path, options: &OpenOptions) -> Vec<(Timestamp, Option<(u32, FrameImage)>)> {
    let recording = vidar_dataset::open(path, options).unwrap();
    let event = |event| match event {
        SensorEvent::Imu(sample) => (sample.time, None),
        SensorEvent::Image(frame) => (frame.time, Some((frame.id.0, frame.image))),
        other => panic!("{other:?}"),
    };
    recording.events().map(|e| event(e.unwrap())).collect()
}

#[test]
fn a_stream_gives_what_its_file_gives_in_the_same_order() {
    let (folder, bytes) = (tempfile::tempdir().unwrap(), recorded());
    let (file, kept) = (folder.path().join("file.mcap"), folder.path().join("recording.mcap"));
    std::fs::write(&file, &bytes).unwrap();
    let expected = of_file(&file, &OpenOptions::default());
    assert_eq!(expected.len(), 880);
    for piece in [777, usize::MAX] {
        let Came { facts, measured, stream } =
            arrived(bytes.clone(), piece, &kept, &OpenOptions::default()).unwrap();
        assert!(measured == expected, "in pieces of {piece}");
        assert!(matches!(facts.calibration, CalibrationSource::Topic(_)));
        let camera = facts.rig.camera(facts.camera).unwrap();
        assert_eq!(camera.body_from_camera.translation.x, 0.1, "from /tf_static");
        assert!(stream.take_warnings().is_empty());
        assert_eq!(std::fs::read(&kept).unwrap(), bytes, "kept as it came");
        let whole = stream.whole().unwrap();
        assert_eq!((whole.images.len(), whole.imu.len()), (80, 800));
        // Images are read again in any order.
        for entry in whole.images.iter().rev().step_by(7) {
            let again = stream.load_image(entry.frame_id, entry.time).unwrap();
            assert_eq!(again, whole.load_image(entry).unwrap());
        }
        assert!(stream.load_image(whole.images[3].frame_id, whole.images[4].time).is_err());
    }
}

#[test]
fn a_part_is_selected_as_of_a_file() {
    let (folder, bytes) = (tempfile::tempdir().unwrap(), recorded());
    let (file, kept) = (folder.path().join("file.mcap"), folder.path().join("recording.mcap"));
    std::fs::write(&file, &bytes).unwrap();
    let seconds = |s: f64| Some(vidar_core::Duration::from_secs_f64(s));
    let options = OpenOptions { start: seconds(3.2), end: seconds(3.5), ..OpenOptions::default() };
    let (expected, came) = (of_file(&file, &options), arrived(bytes, 4096, &kept, &options).unwrap());
    let images = |list: &[(Timestamp, Option<(u32, FrameImage)>)]| -> Vec<_> {
        list.iter().filter_map(|(t, image)| Some((*t, image.clone()?))).collect()
    };
    assert_eq!(images(&came.measured), images(&expected));
    assert_eq!(images(&expected).len(), 7);
}

/// Moves the stamps of an IMU sample and of an image.
fn restamped(messages: &mut [(i64, &str, Message)], moved: impl Fn(i64) -> i64) {
    for (_, _, message) in messages {
        let header = match message {
            Message::Imu(sample) => &mut sample.header,
            Message::Image(image) => &mut image.header,
            _ => continue,
        };
        header.stamp = Timestamp::from_nanos(START + moved(header.stamp.nanos() - START));
    }
}

#[test]
fn a_stamp_far_ahead_is_left_out_and_what_comes_behind_it_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let kept = folder.path().join("recording.mcap");
    let hour = 3600 * 1000 * MS;
    // One sample and one image an hour ahead, after the opening.
    let wrong = |at: i64| if at == 3000 * MS || at == 3001 * MS { at + hour } else { at };
    let bytes = recorded_with(|messages| restamped(messages, wrong));
    let Came { measured, stream, .. } = arrived(bytes, 4096, &kept, &OpenOptions::default()).unwrap();
    let expected = arrived(recorded(), 4096, &folder.path().join("right.mcap"), &OpenOptions::default());
    let left: Vec<Timestamp> = expected.unwrap().measured.iter().map(|(time, _)| *time).collect();
    let right = |time: &Timestamp| ![3000 * MS, 3001 * MS].contains(&(time.nanos() - START));
    let times: Vec<Timestamp> = measured.iter().map(|(time, _)| *time).collect();
    assert_eq!(times, left.into_iter().filter(right).collect::<Vec<_>>());
    let warnings = stream.take_warnings();
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings.iter().all(|w| w.message.starts_with("1 ")), "{warnings:?}");
    // An image is read again by its place in the stream, also behind one that is left out.
    let whole = stream.whole().unwrap();
    let last = measured.iter().rev().find_map(|(time, image)| Some((*time, image.clone()?))).unwrap();
    assert_eq!(stream.load_image(vidar_core::FrameId(last.1.0), last.0).unwrap(), last.1.1);
    assert_eq!(whole.images.len(), 80);
    // A pause is none: what comes after it goes on.
    let bytes = recorded_with(|m| restamped(m, |at| if at > 3000 * MS { at + hour } else { at }));
    let Came { measured, stream, .. } = arrived(bytes, 4096, &kept, &OpenOptions::default()).unwrap();
    assert_eq!((measured.len(), stream.take_warnings().len()), (880, 0));
}

#[test]
fn a_clock_that_is_set_back_ends_the_recording_and_it_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let kept = folder.path().join("recording.mcap");
    let bytes = recorded_with(|m| restamped(m, |at| if at > 2700 * MS { at - 100_000 * MS } else { at }));
    let Came { measured, stream, .. } = arrived(bytes, 4096, &kept, &OpenOptions::default()).unwrap();
    assert!(measured.iter().all(|(time, _)| time.nanos() <= START + 2700 * MS));
    assert_eq!(measured.len(), 541 + 54);
    let warnings = stream.take_warnings();
    assert!(warnings.iter().any(|w| w.kind == "clock-set-back"), "{warnings:?}");
}

/// A stream that stands still after its bytes.
struct Standing(std::io::Cursor<Vec<u8>>);

impl Read for Standing {
    fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
        match self.0.read(into)? {
            0 => loop {
                std::thread::park();
            },
            count => Ok(count),
        }
    }
}

#[test]
fn samples_behind_an_image_do_not_wait_for_the_next_one() {
    let folder = tempfile::tempdir().unwrap();
    let plain = unchunked(&recorded());
    let cut = plain[..plain.len() * 4 / 5].to_vec();
    let (kept, options) = (folder.path().join("recording.mcap"), OpenOptions::default());
    let input = Standing(std::io::Cursor::new(cut));
    let (stream, _) = ArrivingRecording::open(input, &kept, &options, &|| true).unwrap();
    let (mut arrivals, mut last) = (stream.arrivals().unwrap(), [Timestamp::from_nanos(0); 2]);
    // What is handed out before the stream is given up.
    let given_up = std::cell::Cell::new(false);
    let go_on = || {
        given_up.set(true);
        false
    };
    while let Some(arrival) = arrivals.next(&go_on).filter(|_| !given_up.get()) {
        match arrival.what {
            Arrived::Imu(sample) => last[0] = sample.time,
            Arrived::Image(entry, _) => last[1] = entry.time,
        }
    }
    // Half of the 50 ms between images, in steps of 5 ms.
    let ahead = (last[0] - last[1]).as_secs_f64();
    assert!((0.019..=0.025).contains(&ahead), "{ahead} s");
}

#[test]
fn what_came_of_a_stream_that_is_cut_off_is_used_and_it_says_so() {
    let (folder, bytes) = (tempfile::tempdir().unwrap(), recorded());
    let kept = folder.path().join("recording.mcap");
    // Small enough for one chunk, so as a recorder without chunks writes it.
    let plain = unchunked(&bytes);
    let cut = plain[..plain.len() * 4 / 5].to_vec();
    let Came { measured, stream, .. } = arrived(cut, 5000, &kept, &OpenOptions::default()).unwrap();
    assert!((500..800).contains(&measured.len()), "{}", measured.len());
    let warnings = stream.take_warnings();
    assert!(
        warnings.iter().any(|w| w.kind == "stream-cut-off" && w.severity == vidar_core::Severity::Degraded),
        "{warnings:?}"
    );
    let whole = stream.whole().unwrap();
    let images = measured.iter().filter(|(_, image)| image.is_some()).count();
    assert_eq!((whole.images.len(), whole.imu.len()), (images, measured.len() - images));
    // Garbage in the middle ends it in the same way.
    let mut broken = plain.clone();
    let from = broken.len() * 4 / 5;
    broken[from..].iter_mut().for_each(|b| *b = 0xff);
    let Came { measured: before, stream, .. } =
        arrived(broken, 5000, &kept, &OpenOptions::default()).unwrap();
    assert!(before.len().abs_diff(measured.len()) < 5);
    let warnings = stream.take_warnings();
    assert!(
        warnings.iter().any(|w| ["stream-broken", "stream-cut-off"].contains(&w.kind.as_str())),
        "{warnings:?}"
    );
}

/// The records of the chunks without the chunks.
fn unchunked(bytes: &[u8]) -> Vec<u8> {
    let (mut out, mut at) = (bytes[..8].to_vec(), 8);
    while at + 9 <= bytes.len() {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        let end = at + 9 + length;
        match bytes[at] {
            6 => {
                let name = u32::from_le_bytes(bytes[at + 9 + 28..at + 9 + 32].try_into().unwrap()) as usize;
                let records = &bytes[at + 9 + 32 + name + 8..end];
                let mut decoder = lz4_flex::frame::FrameDecoder::new(records);
                decoder.read_to_end(&mut out).unwrap();
            }
            7 => {}
            0x0f => break,
            _ => out.extend(&bytes[at..end]),
        }
        at = end;
    }
    out
}

#[test]
fn what_is_no_stream_of_images_is_refused_with_what_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let kept = folder.path().join("recording.mcap");
    let error = |bytes: &[u8]| {
        let found = arrived(bytes.to_vec(), 100, &kept, &OpenOptions::default());
        found.err().unwrap().to_string()
    };
    assert!(error(b"#ROSBAG V2.0\n").contains("expected MCAP"), "{}", error(b"#ROSBAG V2.0\n"));
    let nothing = McapWriter::new(Vec::new(), "test").unwrap().finish().unwrap();
    assert!(error(&nothing).contains("no message"), "{}", error(&nothing));
    assert!(!error(b"").is_empty());
}
