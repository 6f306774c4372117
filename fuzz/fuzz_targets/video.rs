//! Videos: tables of mp4 and mov, the first frames through the decoders, telemetry.
#![no_main]

mod decoders;

use libfuzzer_sys::fuzz_target;
use vidar_video::Video;

fuzz_target!(|bytes: &[u8]| {
    decoders::allow_panics_of_decoders();
    let path = std::env::temp_dir().join(format!("vidar-fuzz-video-{}", std::process::id()));
    if std::fs::write(&path, bytes).is_err() {
        return;
    }
    let Ok(video) = Video::open(&path) else { return };
    let _ = video.telemetry();
    for number in 0..video.frame_count().min(3) {
        let _ = video.frame(number);
    }
});
