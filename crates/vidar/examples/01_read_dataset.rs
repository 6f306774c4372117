//! Read a recording: its layout, its streams and their events in time order.
#![allow(clippy::print_stdout)] // an example prints

use vidar_dataset::OpenOptions;
use vidar_synth::{SynthConfig, write_sequence};

/// Writes a small synthetic sequence in EuRoC layout and reads it back.
pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let config = SynthConfig { duration_secs: 1.0, ..SynthConfig::default() };
    let written = write_sequence(folder.path(), &config, None, &|_, _| true)?;

    let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default())?;
    println!("{:?}: {} images, {} IMU samples", dataset.kind, dataset.images.len(), dataset.imu.len());
    assert_eq!((dataset.images.len(), dataset.imu.len()), (written.frames, written.imu_samples));
    for event in dataset.events().take(5) {
        println!("{} s", event?.time());
    }
    Ok(())
}
