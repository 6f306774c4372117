//! TUM and EuRoC trajectories, and the guess of a file's format.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use vidar_dataset::TimeUnit;
use vidar_dataset::parse::{self, Source, UnitRule};

fuzz_target!(|bytes: &[u8]| {
    let source = Source { path: Path::new("fuzz"), bytes };
    drop(parse::guess_trajectory_format(&source));
    for rule in [UnitRule::Expected(TimeUnit::Seconds), UnitRule::Guess] {
        if let Ok(file) = parse::tum_poses(&source, rule) {
            assert!(file.poses.iter().all(|p| p.world_from_body.is_finite()));
        }
    }
    if let Ok(file) = parse::euroc_poses(&source, UnitRule::Expected(TimeUnit::Nanoseconds)) {
        assert!(file.poses.iter().all(|p| p.world_from_body.is_finite()));
    }
});
