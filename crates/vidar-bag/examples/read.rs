//! Opens a bag, reads every message in the order of logging and tells the time, to compare it with the disk.
//!
//! ```sh
//! cargo run --release -p vidar-bag --example read -- flight.mcap
//! time cat flight.mcap > /dev/null
//! ```

#![allow(clippy::print_stdout, reason = "the example's output")]

use std::path::Path;
use std::time::Instant;
use vidar_bag::Bag;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args_os().nth(1).ok_or("give a bag")?;
    let start = Instant::now();
    let bag = Bag::open(Path::new(&path))?;
    let opened = start.elapsed().as_secs_f64();
    let mut messages: Vec<_> = bag.topics().iter().flat_map(|t| &t.messages).collect();
    messages.sort_by_key(|m| m.log_time);
    let (mut bytes, mut unread) = (0, 0);
    for message in &messages {
        match bag.bytes(message) {
            Ok(content) => bytes += content.len(),
            Err(e) => {
                unread += 1;
                println!("{e}");
            }
        }
    }
    let secs = start.elapsed().as_secs_f64();
    let files = bag.files().filter_map(|f| std::fs::metadata(f).ok()).map(|m| m.len()).sum::<u64>();
    println!(
        "{} messages of {} MB in files of {} MB: opened in {opened:.2} s, read in {secs:.2} s, {:.0} MB of messages a second, {unread} unread",
        messages.len(),
        bytes / 1_000_000,
        files / 1_000_000,
        bytes as f64 / 1e6 / secs
    );
    Ok(())
}
