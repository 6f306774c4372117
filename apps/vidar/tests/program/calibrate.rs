//! `vidar calibrate`, and what other verbs do without a calibration.

use crate::support::{ProgramOutput, command, shared, vidar};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A phone in lively use whose calibration is withheld: rolling shutter of 24 ms, stamps 40 ms late.
const WORLD: &str = "duration_secs = 12.0\ncamera_rate_hz = 15.0\nwidth = 400\nheight = 300\nblur_samples = 1\n\
    exposure_secs = 0.0\nscan_spacing_m = 0.2\nflight = \"handheld-lively\"\ndepth = false\nseed = 8\n\
    [imu_noise]\ngyro_noise_density = 5e-4\ngyro_random_walk = 2e-5\naccel_noise_density = 5e-3\n\
    accel_random_walk = 1e-3\nrate_hz = 200.0\n\
    [device]\nmount = \"any-axes\"\nreadout_secs = 0.024\nstamp_delay_secs = 0.04\ncalibration = \"absent\"\n\
    [device.lens.radtan]\nfocal_px = 330.0\ncentre_offset_px = [2.0, -3.0]\ndistortion = [-0.08, 0.03, 0.0, 0.0]\n";

fn phone() -> &'static Path {
    static PHONE: OnceLock<PathBuf> = OnceLock::new();
    PHONE.get_or_init(|| {
        let world = shared().root.join("phone.toml");
        std::fs::write(&world, WORLD).unwrap();
        let sequence = shared().root.join("phone without calibration");
        let made = command()
            .args(["synth".as_ref(), sequence.as_os_str(), "--world-config".as_ref(), world.as_os_str()])
            .output();
        ProgramOutput::from(made.unwrap()).ends_with(0);
        sequence
    })
}

fn number(v: &Value) -> f64 {
    v.as_f64().unwrap_or_else(|| panic!("{v} is no number"))
}

/// Value and standard deviation against the truth.
fn check(found: &Value, truth: f64, bound: f64) {
    let (value, sigma) = (number(&found["value"]), number(&found["sigma"]));
    assert_eq!(found["observable"], true, "{found}");
    assert!((value - truth).abs() < bound, "{value} instead of {truth}");
    assert!((value - truth).abs() < 3.5 * sigma, "{value} ± {sigma} instead of {truth}");
}

#[test]
fn a_phone_is_calibrated_by_its_recording_and_the_file_is_read_again() {
    let file = shared().root.join("found calibration.yaml");
    let sequence = phone().to_str().unwrap();
    let found =
        vidar(&["calibrate", sequence, "-o", file.to_str().unwrap(), "--json", "-q"]).ends_with(0).json();
    assert_eq!(found["schema"], "vidar.calibrate/1");
    check(&found["focal_px"], 330.0, 0.02 * 330.0);
    check(&found["time_offset_secs"], -0.04, 0.003);
    check(&found["readout_secs"], 0.024, 0.004);
    let truth: Value = serde_json::from_slice(&std::fs::read(phone().join("truth.json")).unwrap()).unwrap();
    let given = &truth["camera"]["body_from_camera"];
    // Angle between the rotations, from the trace of one times the other's transpose.
    let trace: f64 = (0..9)
        .map(|k| number(&given[4 * (k / 3) + k % 3]) * number(&found["body_from_camera"][k / 3][k % 3]))
        .sum();
    let angle = (0.5 * (trace - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
    assert!(angle < 1.0, "rotation off by {angle} degrees: {found}");
    assert!((number(&found["gyro_noise"]) / 5e-4 - 1.0).abs() < 0.3, "{found}");
    assert!((number(&found["accel_noise"]) / 5e-3 - 1.0).abs() < 0.3, "{found}");

    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.contains("sigma") && text.contains("±") && text.contains("not observable"), "{text}");
    // Given back, it is checked against what the recording shows and agrees with it.
    let again = vidar(&["calibrate", sequence, "--calibration", file.to_str().unwrap(), "--json", "-q"])
        .ends_with(0)
        .json();
    let checks = again["checks"].as_array().unwrap();
    assert_eq!(checks.len(), 3, "{again}");
    assert!(checks.iter().all(|c| c["contradicts"] == false), "{again}");
    let shown = vidar(&["calibrate", sequence, "--calibration", file.to_str().unwrap()]).ends_with(0);
    for words in ["focal length", "time offset", "rotation", "not observable", "the file says", "agrees"] {
        assert!(shown.stdout.contains(words), "{words} is missing in {}", shown.stdout);
    }
}

#[test]
fn a_wrong_calibration_is_contradicted() {
    let camera = "radtan:290,290,199.5,149.5,0,0,0,0";
    let ran = vidar(&["calibrate", phone().to_str().unwrap(), "--camera-model", camera, "-q"]).ends_with(3);
    assert!(ran.stdout.contains("contradicts"), "{}", ran.stdout);
}

/// The phone's gyroscope through `turn`, everything else as it is.
fn with_gyroscope(folder: &Path, turn: impl Fn([f64; 3]) -> [f64; 3]) -> PathBuf {
    let sequence = folder.join("turned");
    let copy = |from: &Path, to: &Path| {
        std::fs::create_dir_all(to).unwrap();
        for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap).filter(|e| e.path().is_file()) {
            std::fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    };
    for part in ["mav0", "mav0/cam0", "mav0/cam0/data", "mav0/imu0"] {
        copy(&phone().join(part), &sequence.join(part));
    }
    let table = sequence.join("mav0/imu0/data.csv");
    let turned = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        let Ok(rates) = fields[1..4].iter().map(|f| f.parse()).collect::<Result<Vec<f64>, _>>() else {
            return line.to_owned();
        };
        let [x, y, z] = turn([rates[0], rates[1], rates[2]]);
        format!("{},{x},{y},{z},{}", fields[0], fields[4..].join(","))
    };
    let text: Vec<String> = std::fs::read_to_string(&table).unwrap().lines().map(turned).collect();
    std::fs::write(&table, text.join("\n") + "\n").unwrap();
    sequence
}

#[test]
fn a_gyroscope_whose_axes_are_not_right_handed_is_contradicted_by_the_images() {
    let folder = tempfile::tempdir().unwrap();
    for (name, turn) in [("mirrored", [1.0, 1.0, -1.0]), ("reversed", [-1.0, -1.0, -1.0])] {
        let sequence =
            with_gyroscope(&folder.path().join(name), |[x, y, z]| [x * turn[0], y * turn[1], z * turn[2]]);
        let told = vidar(&["calibrate", sequence.to_str().unwrap()]).ends_with(1);
        told.says(&[
            "error[E0208]",
            "the gyroscope contradicts the images",
            "not right-handed",
            "opposite signs",
        ]);
    }
    // What is no gyroscope of this recording is not mended by a sign.
    let sequence =
        with_gyroscope(&folder.path().join("foreign"), |[x, y, z]| [3.0 * x * y, 3.0 * z * z, y.abs()]);
    let told = vidar(&["calibrate", sequence.to_str().unwrap()]).ends_with(1);
    told.says(&["error[E0208]", "no camera explains the images"]);
    // Axes in another order are right-handed: the camera's rotation on the IMU is another one, and the rest is as it was.
    let sequence = with_gyroscope(&folder.path().join("renamed"), |[x, y, z]| [z, x, y]);
    let found = vidar(&["calibrate", sequence.to_str().unwrap(), "--json", "-q"]).ends_with(0).json();
    check(&found["focal_px"], 330.0, 0.02 * 330.0);
}

#[test]
fn odometry_calibrates_by_itself_and_says_so() {
    let out = shared().root.join("odometry without calibration");
    vidar(&["odometry", phone().to_str().unwrap(), "-o", out.to_str().unwrap()]).ends_with(0).says(&[
        "calibrated-from-recording",
        "focal length",
        "lever arm",
    ]);
    let report: Value =
        serde_json::from_slice(&std::fs::read(out.join("odometry/report.json")).unwrap()).unwrap();
    let images = |key: &str| number(&report[key]);
    assert!(images("images_with_state") > 0.5 * images("images"), "{report}");
}

#[test]
fn a_recording_that_shows_no_calibration_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let world = folder.path().join("still.toml");
    let still = WORLD.replace("duration_secs = 12.0", "duration_secs = 1.0");
    std::fs::write(&world, still).unwrap();
    let sequence = folder.path().join("short");
    let (sequence, world) = (sequence.to_str().unwrap(), world.to_str().unwrap());
    vidar(&["synth", sequence, "--world-config", world, "-q"]).ends_with(0);
    vidar(&["calibrate", sequence]).ends_with(1).says(&["error[E0208]", "hint:"]);
    let out = folder.path().join("out");
    vidar(&["odometry", sequence, "-o", out.to_str().unwrap()]).ends_with(1).says(&["error[E0208]"]);
    assert!(!out.exists(), "a refused run left a folder");
}

#[test]
fn inspect_says_what_is_missing_and_what_the_recording_shows_of_it() {
    let ran = vidar(&["inspect", phone().to_str().unwrap(), "-q"]).ends_with(0);
    for words in [
        "missing",
        "intrinsics of the camera",
        "readout time",
        "found",
        "focal length",
        "noise of the IMU",
        "turns ",
    ] {
        assert!(ran.stdout.contains(words), "{words} is missing in\n{}", ran.stdout);
    }
    let calibrated = vidar(&["inspect", shared().sequence.to_str().unwrap(), "--json"]).ends_with(0).json();
    let missing = calibrated["missing"].as_array().unwrap();
    assert!(!missing.iter().any(|m| m.as_str().unwrap().contains("intrinsics")), "{calibrated}");
}

#[test]
fn a_lens_without_its_place_on_the_imu_is_completed_from_the_recording() {
    let folder = tempfile::tempdir().unwrap();
    let sequence = folder.path().join("recording");
    let mut synth = command();
    synth.arg("synth").arg(&sequence).args([
        "--preset",
        "phone-fast",
        "--size",
        "320x240",
        "--frame-rate",
        "20",
    ]);
    synth.args(["--duration", "10", "--seed", "9611", "--calibration", "partial", "-q"]);
    ProgramOutput::from(synth.output().unwrap()).ends_with(0);
    let mut program = command();
    program.arg("odometry").arg(&sequence).arg("-o").arg(folder.path().join("out")).args(["--json", "-q"]);
    let ran = ProgramOutput::from(program.output().unwrap()).ends_with(0);
    assert!(ran.stderr.contains("nothing says how the camera is mounted"), "{}", ran.stderr);
    let json = ran.json();
    let number = |path: &str| json.pointer(path).and_then(Value::as_f64).unwrap();
    let path_m = number("/final/trajectory/matched_truth_path_m");
    // The path that is told is the adjusted one: live poses that scatter are longer.
    assert!((number("/path_m") - path_m).abs() < 0.02 * path_m, "{} of {path_m} m", number("/path_m"));
    assert!(number("/final/trajectory/ate_se3_m/rmse") < 0.01 * path_m, "{}", json["final"]["trajectory"]);
}
