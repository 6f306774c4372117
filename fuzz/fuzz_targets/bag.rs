//! Recordings: the first bytes tell ROS 1 bag, MCAP and SQLite apart; every message that is listed is read.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_bag::{Bag, Message};

/// Most messages read of one input: an index may list the same place many times.
const MOST_READ: usize = 64;

fuzz_target!(|bytes: &[u8]| {
    // The reader takes files, because it reads them in any order; this one is in memory on most systems.
    let path = std::env::temp_dir().join(format!("vidar-fuzz-bag-{}", std::process::id()));
    if std::fs::write(&path, bytes).is_err() {
        return;
    }
    let Ok(bag) = Bag::open(&path) else { return };
    for message in bag.topics().iter().flat_map(|t| &t.messages).take(MOST_READ) {
        if let Ok(Message::Image(image)) = bag.read(message) {
            drop(image.pixels());
        }
    }
});
