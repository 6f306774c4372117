//! Calibrations as the usual tools write them, and implausible ones.

use crate::common::*;
use vidar_core::{CameraModel, LieGroup};
use vidar_dataset::{DatasetError, OpenOptions, Recording};

/// A camchain as Kalibr writes it, with the numbers of EuRoC's first camera.
const KALIBR: &str = "cam0:
  T_cam_imu:
  - [0.0148655429818, 0.999557249008, -0.0257744366974, 0.06522290953]
  - [-0.999880929698, 0.0149672133247, 0.00375618835797, -0.02070638549]
  - [0.00414029679422, 0.025715529948, 0.999660727178, -0.00805460246]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0042
";

/// The same rig in the dialect of OpenVINS.
const OPENVINS: &str = "%YAML:1.0

cam0:
  T_imu_cam: #rotation from camera to IMU, position of camera in IMU
    - [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975]
    - [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768]
    - [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949]
    - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0042
";

const IMU: &str = "%YAML:1.0

imu0:
  T_i_b:
    - [1.0, 0.0, 0.0, 0.0]
    - [0.0, 1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0, 0.0]
    - [0.0, 0.0, 0.0, 1.0]
  accelerometer_noise_density: 2.0e-3
  accelerometer_random_walk: 3.0e-3
  gyroscope_noise_density: 1.6968e-04
  gyroscope_random_walk: 1.9393e-05
  rostopic: /imu0
  time_offset: 0.0
  update_rate: 200.0
";

/// A EuRoC folder with images of EuRoC's size, read with `camera` and `imu` as its calibration.
fn with(camera: &str, imu: &str) -> Result<Recording, DatasetError> {
    let f = euroc();
    for i in 0..10 {
        f.write(&format!("mav0/cam0/data/{}.png", frame_ns(i)), gray_png(752, 480, 90));
    }
    f.write("chain.yaml", camera).write("imu.yaml", imu);
    let calibration = vec![f.join("chain.yaml"), f.join("imu.yaml")];
    f.open_with(&OpenOptions { calibration, ..Default::default() })
}

fn camera(dataset: &Recording) -> &vidar_core::RigCamera {
    dataset.rig.camera(dataset.camera).unwrap()
}

#[test]
fn kalibr_and_open_vins_files_give_the_same_rig() {
    let (kalibr, open_vins) = (with(KALIBR, IMU).unwrap(), with(OPENVINS, IMU).unwrap());
    for d in [&kalibr, &open_vins] {
        assert_eq!(kinds(d), Vec::<&str>::new());
        assert!(matches!(camera(d).model, CameraModel::RadTan(_)));
        assert_eq!(camera(d).time_offset.nanos(), 4_200_000);
        assert_eq!(d.rig.imu, Some(vidar_core::ImuNoise::EUROC));
    }
    let apart = camera(&kalibr).body_from_camera.inverse() * camera(&open_vins).body_from_camera;
    assert!(apart.log().norm() < 1e-6, "{apart:?}");
}

#[test]
fn contradicting_extrinsics_are_refused() {
    let block = |text: &str, key: &str| {
        let lines: Vec<&str> = text.lines().collect();
        let at = lines.iter().position(|l| l.contains(key)).unwrap();
        lines[at..at + 5].join("\n").replace("    -", "  -")
    };
    let both = KALIBR.replace("  cam_overlaps", &format!("{}\n  cam_overlaps", block(OPENVINS, "T_imu_cam")));
    with(&both, IMU).unwrap();
    let swapped =
        both.replace("T_cam_imu", "T_x").replace("T_imu_cam", "T_cam_imu").replace("T_x", "T_imu_cam");
    assert!(with(&swapped, IMU).is_ok(), "swapped as a whole they still agree");
    let wrong = both.replace("-0.064676986768]", "0.064676986768]");
    let error = with(&wrong, IMU).unwrap_err().to_string();
    assert!(error.contains("T_imu_cam") && error.contains("inverse of T_cam_imu"), "{error}");
}

#[test]
fn the_main_config_of_open_vins_is_refused_with_the_files_to_give() {
    let head = "%YAML:1.0\nverbosity: INFO\nuse_fej: true\nrelative_config_imu: kalibr_imu_chain.yaml\nrelative_config_imucam: kalibr_imucam_chain.yaml\n";
    let error = with(head, IMU).unwrap_err().to_string();
    assert!(error.contains("relative_config_imucam"), "{error}");
}

#[test]
fn implausible_values_are_reported() {
    let edited = |from: &str, to: &str| (KALIBR.replace(from, to), IMU.to_string());
    let noisy = |from: &str, to: &str| (KALIBR.to_string(), IMU.replace(from, to));
    let identity = "  - [1, 0, 0, 0]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0.0, 0.0, 0.0, 1.0]";
    let rows: String = KALIBR.lines().skip(2).take(4).collect::<Vec<_>>().join("\n");
    let cases = [
        ("calibration-lever", "m apart", edited("0.06522290953", "65.22290953")),
        ("calibration-clock", "4.2000 s", edited("0.0042", "4.2")),
        ("extrinsics-identity", "same axes", edited(&rows, identity)),
        ("calibration-focal", "2.00", edited("[458.654, 457.296", "[458.654, 229.327")),
        ("calibration-focal", "0.10 of", edited("[458.654, 457.296", "[75.2, 75.2")),
        ("calibration-centre", "248.4, 367.2", edited("367.215, 248.375", "248.375, 367.215")),
        ("calibration-distortion", "folds over", edited("-0.28340811, 0.07395907", "-0.28340811, -0.9")),
        ("imu-noise-range", "gyroscope noise 9.72", noisy("1.6968e-04", "0.0972")),
        ("imu-noise-range", "accelerometer noise 0.00e0", noisy("2.0e-3", "0.0")),
        ("imu-noise-range", "never changes", noisy("1.9393e-05", "0.0")),
        ("imu-noise-range", "hardly", noisy("1.9393e-05", "0.03")),
        ("imu-rate", "an IMU rate of 800 Hz", noisy("update_rate: 200", "update_rate: 800")),
    ];
    for (kind, words, (camera, imu)) in cases {
        let d = with(&camera, &imu).unwrap();
        let found = d.warnings.iter().find(|w| w.kind == kind);
        let text = found.map(|w| format!("{} {}", w.message, w.hint.clone().unwrap_or_default()));
        assert!(text.as_ref().is_some_and(|t| t.contains(words)), "{kind}, {words}: {:?}", d.warnings);
    }
}

#[test]
fn broken_files_are_refused_with_key_and_line() {
    let fails = |camera: &str, words: &[&str]| {
        let error = with(camera, IMU).unwrap_err().to_string();
        assert!(words.iter().all(|w| error.contains(w)), "{error}: {words:?}");
    };
    fails(&KALIBR.replace("0.999557249008", "9.99557249008"), &["chain.yaml", "T_cam_imu"]);
    fails(&KALIBR.replace("  - [0.0, 0.0, 0.0, 1.0]\n", ""), &["T_cam_imu", "16 numbers"]);
    fails(
        &KALIBR.replace("[458.654, 457.296, 367.215, 248.375]", "[458.654, 457.296]"),
        &["4: fu, fv, cu, cv"],
    );
    fails(&KALIBR.replace("0.0042", "soon"), &["timeshift_cam_imu", "finite number"]);
    fails(&KALIBR[..KALIBR.len() / 2], &["chain.yaml"]);
    fails("", &["chain.yaml"]);
}

#[test]
fn the_real_excerpt_is_plausible() {
    let Some(folder) = vidar_core::testing::shared_data("data/euroc_MH_01_real_11s") else { return };
    let d = vidar_dataset::open(&folder, &OpenOptions::default()).unwrap();
    let doubts: Vec<&str> = kinds(&d)
        .into_iter()
        .filter(|k| k.starts_with("calibration") || k.starts_with("imu-noise") || k.starts_with("extrinsics"))
        .collect();
    assert!(doubts.is_empty(), "{:?}", d.warnings);
}
