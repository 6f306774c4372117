//! Parsers return a value or an error for any bytes.

use proptest::prelude::*;
use std::path::Path;
use vidar_dataset::decode::{ImageLimits, decode_image};
use vidar_dataset::parse::{self, Source, UnitRule};
use vidar_dataset::{CameraFlag, TimeUnit, TrajectoryReadOptions, trajectory_from};

/// Runs every parser of text.
fn parse_all(bytes: &[u8]) {
    let source = Source { path: Path::new("any"), bytes };
    for rule in
        [UnitRule::Guess, UnitRule::Expected(TimeUnit::Nanoseconds), UnitRule::Given(TimeUnit::Seconds)]
    {
        let _ = parse::file_list(&source, rule);
        let _ = parse::time_list(&source, rule);
        let _ = parse::imu_csv(&source, rule);
        let _ = parse::accelerometer_list(&source, rule);
        let _ = parse::tum_poses(&source, rule);
        let _ = parse::euroc_poses(&source, rule);
    }
    for rule in [UnitRule::Guess, UnitRule::Expected(TimeUnit::Seconds)] {
        let _ = parse::numbered_poses(&source, rule);
        let _ = parse::first_column_times(&source, rule);
    }
    let _ = parse::imu_columns(&String::from_utf8_lossy(bytes), "gyro.csv");
    let _ = parse::frame_intrinsics(&source);
    let _ = parse::associations(&source);
    let _ = parse::named_numbers(&source);
    let _ = parse::projection_matrices(&source);
    let _ = parse::rotation_and_translation(&source);
    let _ = parse::times_of_day(&source);
    let _ = parse::oxts(&source).map(|record| record.world_from_unit(49.0));
    let _ = parse::replica_camera(&source);
    for camera in parse::json_calibration(&source).unwrap_or_default() {
        let _ = (camera.model(&source), camera.camera_from_imu(&source));
    }
    let _ = parse::JsonRecording::default().add(&source, 0, 0);
    let _ = parse::kitti_poses(&source);
    let _ = parse::matrix_poses(&source);
    let _ = parse::single_pose(&source);
    let _ = parse::intrinsics_matrix(&source);
    let _ = parse::euroc_sensor_yaml(&source);
    let _ = parse::kalibr_yaml(&source);
    let _ = trajectory_from(&source, &TrajectoryReadOptions::default());
}

/// Text made of the pieces that the formats are made of.
fn pieces() -> impl Strategy<Value = String> {
    let piece = prop_oneof![
        Just("\n".to_string()),
        Just(",".to_string()),
        Just(" ".to_string()),
        Just("# ".to_string()),
        Just("\r\n".to_string()),
        Just("nan".to_string()),
        Just("1403636580838555648".to_string()),
        Just("1e999".to_string()),
        Just("-".to_string()),
        Just("a.png".to_string()),
        Just("T_BS: [".to_string()),
        Just("cam0:\n ".to_string()),
        Just("intrinsics: ".to_string()),
        Just("&a *a".to_string()),
        Just("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n".to_string()),
        Just("2011-09-26 13:02:25.5".to_string()),
        Just("{\"time\":1,\"frames\":[{".to_string()),
        Just("\"cameraInd\":0,\"time\":".to_string()),
        Just("}]}".to_string()),
        Just("gyro_x,gyro_y,gyro_z,time".to_string()),
        any::<f64>().prop_map(|v| v.to_string()),
        any::<i64>().prop_map(|v| v.to_string()),
        "[ -~é]{0,6}",
    ];
    prop::collection::vec(piece, 0..60).prop_map(|p| p.concat())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn text_parsers_never_panic_on_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        parse_all(&bytes);
    }

    #[test]
    fn text_parsers_never_panic_on_what_looks_right(text in pieces()) {
        parse_all(text.as_bytes());
    }

    #[test]
    fn image_decoding_never_panics(
        head in prop_oneof![
            Just(&b"\x89PNG\r\n\x1a\n"[..]),
            Just(&b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\0\x04\0\0\0\x02\x08\x03"[..]),
            Just(&b"\xff\xd8\xff\xe0"[..]),
            Just(&b""[..]),
        ],
        tail in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        let limits = ImageLimits { max_side_px: 512, max_decoded_bytes: 1 << 20 };
        let _ = decode_image(&[head, &tail].concat(), &limits);
    }

    #[test]
    fn flags_never_panic(text in "[a-z0-9:,.e-]{0,40}") {
        let _ = text.parse::<CameraFlag>();
    }

    #[test]
    fn tum_rows_are_read_as_they_were_written(
        rows in prop::collection::vec((0i64..4_000_000_000_000_000_000, prop::array::uniform3(-1e3..1e3f64)), 1..20),
    ) {
        let mut rows = rows;
        rows.sort_by_key(|r| r.0);
        rows.dedup_by_key(|r| r.0);
        let text: String = rows
            .iter()
            .map(|(t, [x, y, z])| format!("{}.{:09} {x} {y} {z} 0 0 0 1\n", t / 1_000_000_000, t % 1_000_000_000))
            .collect();
        let source = Source { path: Path::new("t.txt"), bytes: text.as_bytes() };
        let file = parse::tum_poses(&source, UnitRule::Given(TimeUnit::Seconds)).unwrap();
        prop_assert_eq!(file.poses.len(), rows.len());
        for (pose, (t, [x, y, z])) in file.poses.iter().zip(&rows) {
            prop_assert_eq!(pose.time.unwrap().nanos(), *t);
            prop_assert_eq!(pose.world_from_body.translation, nalgebra::Vector3::new(*x, *y, *z));
        }
    }
}
