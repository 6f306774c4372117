//! EXIF, records and calibrations of phones' recorders, KITTI's text files, associations, and headers of tables.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use vidar_dataset::TimeUnit;
use vidar_dataset::parse::{self, JsonRecording, Source, UnitRule};

fuzz_target!(|bytes: &[u8]| {
    let Some((selector, bytes)) = bytes.split_first() else { return };
    let source = Source { path: Path::new("fuzz"), bytes };
    let rule = if selector >> 4 == 0 { UnitRule::Guess } else { UnitRule::Expected(TimeUnit::Seconds) };
    match selector & 15 {
        0 => drop(JsonRecording::default().add(&source, 0, 0)),
        1 => {
            for camera in parse::json_calibration(&source).unwrap_or_default() {
                let _ = camera.model(&source);
                let motion = camera.camera_from_imu(&source).ok().flatten();
                assert!(motion.is_none_or(|m| m.is_finite()));
            }
        }
        2 => drop(parse::replica_camera(&source)),
        3 => drop(parse::numbered_poses(&source, rule)),
        4 => drop(parse::first_column_times(&source, rule)),
        5 => drop(parse::frame_intrinsics(&source)),
        6 => drop(parse::associations(&source)),
        7 => drop(parse::projection_matrices(&source)),
        8 => {
            if let Ok(motion) = parse::rotation_and_translation(&source) {
                assert!(motion.is_finite());
            }
        }
        9 => drop(parse::times_of_day(&source)),
        10 => {
            if let Ok(record) = parse::oxts(&source) {
                assert!(record.world_from_unit(49.0).is_none_or(|m| m.is_finite()));
            }
        }
        11 => drop(parse::photo_exif(bytes)),
        _ => drop(parse::imu_columns(&String::from_utf8_lossy(bytes), "gyro.csv")),
    }
});
