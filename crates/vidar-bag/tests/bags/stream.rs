//! MCAP as it comes: the same messages as from the file, whatever the pieces; cut, damaged and hostile streams.

use std::io::Write;
use std::path::Path;
use vidar_bag::write::{McapWriter, encode};
use vidar_bag::{Bag, BagError, Header, ImuMessage, KeptStream, McapStream, Message, StreamEnd, StreamPlace};
use vidar_core::Timestamp;

/// What came: topic, time, bytes and place.
type Came = Vec<(String, Timestamp, Vec<u8>, StreamPlace)>;

struct Streamed {
    came: Came,
    end: Result<StreamEnd, BagError>,
    kept: KeptStream,
    folder: tempfile::TempDir,
}

/// Streams `bytes` in pieces while they are written to a file.
fn streamed(bytes: &[u8], piece: usize) -> Streamed {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording.mcap");
    let mut file = std::fs::File::create(&path).unwrap();
    let kept = KeptStream::open(&path).unwrap();
    let (mut parser, mut came, mut broken, mut before) = (McapStream::new(&kept), Came::new(), None, 0);
    for piece in bytes.chunks(piece) {
        file.write_all(piece).unwrap();
        let result = parser.push(piece, &mut |m| {
            assert!(m.end >= before && m.end <= bytes.len() as u64);
            before = m.end;
            came.push((m.topic.name.clone(), m.log_time, m.data.to_vec(), m.place));
        });
        if let Err(e) = result {
            broken = Some(e);
            break;
        }
    }
    Streamed { came, end: broken.map_or_else(|| Ok(parser.finish()), Err), kept, folder }
}

/// The messages of a file as `Bag` lists them.
fn listed(path: &Path) -> Vec<(String, Timestamp, Vec<u8>)> {
    let bag = Bag::open(path).unwrap();
    let all = bag.topics().iter().flat_map(|t| t.messages.iter().map(|m| (t.name.clone(), m)));
    let mut all: Vec<_> = all.map(|(name, m)| (name, m.log_time, bag.bytes(m).unwrap())).collect();
    all.sort();
    all
}

fn without_place(came: &Came) -> Vec<(String, Timestamp, Vec<u8>)> {
    let mut all: Vec<_> = came.iter().map(|(n, t, b, _)| (n.clone(), *t, b.clone())).collect();
    all.sort();
    all
}

fn fixtures() -> Vec<std::path::PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
    let (mut folders, mut found) = (vec![folder], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.extension().and_then(|e| e.to_str()) {
                Some("mcap") => found.push(path),
                None if path.is_dir() => folders.push(path),
                _ => {}
            }
        }
    }
    found.sort();
    assert!(found.len() >= 3, "{found:?}");
    found
}

#[test]
fn a_stream_in_any_pieces_gives_the_messages_of_the_file_and_reads_them_again() {
    for path in fixtures() {
        let (bytes, expected) = (std::fs::read(&path).unwrap(), listed(&path));
        for piece in [1, 7, 4096, usize::MAX] {
            let Streamed { came, end, kept, folder } = streamed(&bytes, piece);
            assert_eq!(without_place(&came), expected, "{} in pieces of {piece}", path.display());
            let end = end.unwrap();
            assert!(end.is_closed && end.lost_bytes == 0 && end.messages == expected.len() as u64, "{end:?}");
            came.iter().for_each(|(_, _, bytes, place)| assert_eq!(kept.bytes(place).unwrap(), *bytes));
            drop(folder);
        }
    }
}

fn imu(i: i64) -> Message {
    let header = Header { stamp: Timestamp::from_nanos(1_000_000_007 * i), frame: "imu0".into() };
    Message::Imu(ImuMessage {
        header,
        angular_velocity: [i as f64, 0.0, 0.0],
        linear_acceleration: [0.0, 0.0, 9.81],
    })
}

/// Two chunks of lz4.
fn written() -> Vec<u8> {
    let mut writer = McapWriter::new(Vec::new(), "test").unwrap();
    let channel = writer.channel("/imu0", encode(&imu(0)).unwrap().0).unwrap();
    for i in 0..10_000 {
        writer.write(channel, Timestamp::from_nanos(1_000_000_007 * i), &encode(&imu(i)).unwrap().1).unwrap();
    }
    writer.finish().unwrap()
}

#[test]
fn a_stream_that_is_cut_off_gives_what_came_whole_and_says_so() {
    let bytes = written();
    let whole = streamed(&bytes, 1 << 16);
    let cut = streamed(&bytes[..bytes.len() * 3 / 4], 1 << 16);
    let end = cut.end.unwrap();
    assert!(!end.is_closed && end.lost_bytes > 0, "{end:?}");
    assert!((3000..10_000).contains(&cut.came.len()));
    assert_eq!(cut.came, whole.came[..cut.came.len()]);
    // The same as the file.
    assert_eq!(without_place(&cut.came), listed(&cut.folder.path().join("recording.mcap")));
}

#[test]
fn the_beginning_of_a_file_that_is_written_is_a_bag_of_its_own() {
    let bytes = written();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("growing.mcap");
    std::fs::write(&path, &bytes).unwrap();
    let (all, part) =
        (Bag::open(&path).unwrap(), Bag::open_beginning(&path, bytes.len() as u64 * 3 / 4).unwrap());
    assert!(part.warnings().is_empty(), "it is not cut off, more is to come");
    let count = part.topics()[0].messages.len();
    assert!((3000..10_000).contains(&count) && all.topics()[0].messages.len() == 10_000);
    assert_eq!(part.read(&part.topics()[0].messages[count - 1]).unwrap(), imu(count as i64 - 1));
}

#[test]
fn a_damaged_chunk_is_left_out_and_counted() {
    let mut bytes = written();
    let chunk = bytes.windows(12).position(|w| w[..4] == [3, 0, 0, 0] && &w[4..7] == b"lz4").unwrap();
    bytes[chunk + 40..chunk + 80].iter_mut().for_each(|b| *b = !*b);
    let found = streamed(&bytes, 1000);
    assert_eq!(found.end.unwrap().damaged_chunks, 1);
    assert!((1000..8000).contains(&found.came.len()), "the other chunk");
}

#[test]
fn announced_sizes_take_no_memory_and_garbage_is_an_error() {
    let record = |op: u8, length: u64| {
        let mut bytes = b"\x89MCAP0\r\n".to_vec();
        bytes.push(op);
        bytes.extend(length.to_le_bytes());
        bytes.extend([0; 64]);
        bytes
    };
    // A schema, a message and a chunk of terabytes.
    for op in [3, 5, 6] {
        let error = streamed(&record(op, 1 << 42), 10).end.unwrap_err();
        assert!(matches!(error, BagError::TooLarge { .. }), "{error}");
    }
    // What is not read is passed over, however long.
    let end = streamed(&record(9, u64::MAX), 10).end.unwrap();
    assert_eq!((end.messages, end.lost_bytes), (0, 0));
    // A chunk of 16 bytes that announces half a terabyte of content, and one that is not long enough for its head.
    let mut chunk = record(6, 28 + 4 + 3 + 8 + 16);
    chunk[17 + 16..17 + 24].copy_from_slice(&(1u64 << 39).to_le_bytes());
    chunk[17 + 28..17 + 35].copy_from_slice(b"\x03\0\0\0lz4");
    assert!(matches!(streamed(&chunk, 10).end, Err(BagError::TooLarge { .. })));
    assert!(streamed(&record(6, 20), 10).end.is_err());
    assert!(streamed(&record(0, 20), 10).end.unwrap_err().to_string().contains("kind 0"));
    let error = streamed(b"#ROSBAG V2.0\n", 3).end.unwrap_err().to_string();
    assert!(error.contains("expected MCAP"), "{error}");
    assert!(streamed(b"", 1).end.unwrap().messages == 0);
}
