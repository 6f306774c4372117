//! EuRoC sensor.yaml and Kalibr YAML.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use vidar_dataset::parse::{self, Source};

fuzz_target!(|bytes: &[u8]| {
    let source = Source { path: Path::new("fuzz"), bytes };
    if let Ok((sensor, _)) = parse::euroc_sensor_yaml(&source) {
        assert!(sensor.body_from_sensor.is_none_or(|m| m.is_finite()));
    }
    if let Ok((file, _)) = parse::kalibr_yaml(&source) {
        assert!(file.cameras.iter().all(|c| c.camera_from_imu.is_none_or(|m| m.is_finite())));
    }
});
