//! Video without a container, as bags keep it: access units as byte streams; the first byte picks the codec and where the bytes are cut.
#![no_main]

mod decoders;

use libfuzzer_sys::fuzz_target;
use std::sync::Arc;
use vidar_video::{AccessUnits, StreamCodec, StreamUnit, VideoStream};

struct Units(Vec<Vec<u8>>);

impl AccessUnits for Units {
    fn read(&self, number: usize) -> Result<Vec<u8>, String> {
        self.0.get(number).cloned().ok_or_else(|| "no such unit".into())
    }
}

fuzz_target!(|bytes: &[u8]| {
    decoders::allow_panics_of_decoders();
    let Some((selector, bytes)) = bytes.split_first() else { return };
    let codec = if selector & 1 == 0 { StreamCodec::H264 } else { StreamCodec::H265 };
    let length = (bytes.len() / (1 + usize::from(selector >> 1 & 7))).max(1);
    let units: Vec<Vec<u8>> = bytes.chunks(length).map(<[u8]>::to_vec).collect();
    let listed: Vec<StreamUnit> = units
        .iter()
        .enumerate()
        .map(|(n, unit)| StreamUnit {
            time: vidar_core::Timestamp::from_nanos(n as i64),
            stands_alone: codec.stands_alone(unit),
        })
        .collect();
    let sets = units.first().map(|unit| codec.parameter_sets(unit)).unwrap_or_default();
    let Ok(stream) = VideoStream::open(codec, &listed, sets, Arc::new(Units(units))) else { return };
    for number in 0..stream.frame_count() {
        let _ = stream.frame(number);
    }
});
