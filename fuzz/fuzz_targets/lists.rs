//! EuRoC and TUM lists of files, inertial csv, accelerometer lists, files of times, small matrices.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use vidar_dataset::TimeUnit;
use vidar_dataset::parse::{self, Source, UnitRule};

fuzz_target!(|bytes: &[u8]| {
    let Some((selector, bytes)) = bytes.split_first() else { return };
    let source = Source { path: Path::new("fuzz"), bytes };
    let rule = match selector >> 4 {
        0 => UnitRule::Guess,
        1 => UnitRule::Expected(TimeUnit::Seconds),
        2 => UnitRule::Given(TimeUnit::Milliseconds),
        _ => UnitRule::Expected(TimeUnit::Nanoseconds),
    };
    match selector & 7 {
        0 => drop(parse::file_list(&source, rule)),
        1 => drop(parse::imu_csv(&source, rule)),
        2 => drop(parse::accelerometer_list(&source, rule)),
        3 => drop(parse::time_list(&source, rule)),
        4 => drop(parse::intrinsics_matrix(&source)),
        5 => drop(parse::matrix_poses(&source)),
        _ => drop(parse::single_pose(&source)),
    }
});
