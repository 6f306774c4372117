//! A stream of MCAP, in pieces: the same messages for any pieces, and nothing allocated that was only announced.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::sync::OnceLock;
use vidar_bag::{KeptStream, McapStream, StreamEnd};

/// The parser only names the file in errors.
fn kept() -> &'static KeptStream {
    static KEPT: OnceLock<KeptStream> = OnceLock::new();
    KEPT.get_or_init(|| {
        let path = std::env::temp_dir().join(format!("vidar-fuzz-stream-{}", std::process::id()));
        std::fs::write(&path, b"").expect("the file is written");
        KeptStream::open(&path).expect("the file opens")
    })
}

/// Messages with the sums of their bytes, and the end.
fn streamed(bytes: &[u8], piece: usize) -> (Vec<(i64, usize, u64)>, Option<StreamEnd>) {
    let (mut parser, mut came) = (McapStream::new(kept()), Vec::new());
    for piece in bytes.chunks(piece) {
        let pushed = parser.push(piece, &mut |m| {
            // What its decoder makes of it is the fuzz target `bag_message`; here only that it is asked.
            let _ = m.topic.header(m.data);
            came.push((m.log_time.nanos(), m.data.len(), m.data.iter().map(|b| u64::from(*b)).sum()));
        });
        if pushed.is_err() {
            return (came, None);
        }
    }
    (came, Some(parser.finish()))
}

fuzz_target!(|data: &[u8]| {
    let Some((first, stream)) = data.split_first() else { return };
    let pieces = streamed(stream, usize::from(*first).max(1));
    let whole = streamed(stream, usize::MAX);
    assert_eq!(pieces, whole);
});
