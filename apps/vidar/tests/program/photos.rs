//! Every image counts: photos without times are all used, and what is left out or invented is told.

use crate::support::{command, images_of, shared, vidar};
use std::path::{Path, PathBuf};

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Eight images of the tiny recording as a camera names them.
fn photos(name: &str) -> PathBuf {
    let folder = shared().root.join(name);
    std::fs::create_dir_all(&folder).unwrap();
    for (k, image) in images_of(&shared().sequence).iter().step_by(2).take(8).enumerate() {
        std::fs::copy(image, folder.join(format!("IMG_{:04}.png", 101 + k))).unwrap();
    }
    folder
}

const CAMERA: [&str; 2] = ["--camera-model", "pinhole:97.6,97.3,77.6,53.3"];

fn plan(folder: &Path, more: &[&str]) -> crate::support::ProgramOutput {
    let mut command = command();
    command.arg("run").arg(folder).args(["--mode", "pose-free", "--geometry", "da3-nano", "--dry-run"]);
    command.args(CAMERA).args(more).output().unwrap().into()
}

#[test]
fn photos_without_times_are_all_used_and_their_rate_is_not_invented() {
    let folder = photos("eight photos");
    let ran =
        plan(&folder, &[]).ends_with(0).says(&["[times-synthesised]", "[every-image-used]", "8 images"]);
    assert!(ran.stdout.contains("8 in 1 chunks"), "{}", ran.stdout);
    let inspected = vidar(&["inspect", text(&folder)]).ends_with(0);
    assert!(
        inspected.stdout.contains("without times") && !inspected.stdout.contains("30.0 Hz"),
        "{}",
        inspected.stdout
    );
    // With times the interval between keyframes counts again.
    let times: String = (0..8).map(|k| format!("{:.3}\n", 1.6e9 + 0.05 * f64::from(k))).collect();
    let list = shared().root.join("eight times.txt");
    std::fs::write(&list, times).unwrap();
    let ran = plan(&folder, &["--timestamps", text(&list)]).ends_with(0);
    assert!(
        !ran.stderr.contains("every-image-used") && ran.stdout.contains("2 in 1 chunks"),
        "{}",
        ran.stdout
    );
}

#[test]
fn images_of_another_size_and_calibrations_that_are_not_read_are_told() {
    let folder = photos("mixed photos");
    // The first image is the odd one: the others must not be lost to it.
    std::fs::write(folder.join("IMG_0100.png"), upright_png()).unwrap();
    std::fs::write(folder.join("calib.txt"), "P0: 1 0 0 0\n").unwrap();
    let ran = plan(&folder, &[]).ends_with(0).says(&[
        "[image-size]",
        "8 images are 160x104, 1 are not",
        "104x160",
        "[calibration-ignored]",
        "calib.txt",
        "--camera-model",
    ]);
    assert!(ran.stdout.contains("8 in 1 chunks"), "{}", ran.stdout);
    vidar(&["inspect", text(&folder)]).ends_with(0).says(&["[image-size]", "[calibration-ignored]"]);
}

/// A picture of 104 x 160 pixels as PNG, by way of an export that writes one.
fn upright_png() -> Vec<u8> {
    let image = vidar::core::MetricDepth::new(vidar::core::Image::filled(104, 160, 2.0));
    let mut bytes = Vec::new();
    vidar::export_formats::write_depth_png(&mut bytes, &image, 1000.0).unwrap();
    bytes
}

#[test]
fn a_csv_whose_quaternion_order_is_not_stated_is_refused_and_one_that_states_it_is_read_right() {
    // A quarter turn about z: as w x y z it would be something else.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let row = |k: i32, order: [f64; 4]| {
        let [a, b, c, d] = order;
        format!("{:.2},{},{},0,{a},{b},{c},{d}\n", 100.0 + f64::from(k) * 0.1, k, k * k)
    };
    let rows = |order: [f64; 4]| (0..20).map(|k| row(k, order)).collect::<String>();
    let file = |name: &str, text: String| {
        let path = shared().root.join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let xyzw = [0.0, 0.0, half, half];
    let plain = file("plain.csv", rows(xyzw));
    let blanks = file("blanks.tum", rows(xyzw).replace(',', " "));
    let tum = file("tum.csv", format!("#timestamp,tx,ty,tz,qx,qy,qz,qw\n{}", rows(xyzw)));
    let euroc =
        file("wxyz.csv", format!("#timestamp,px,py,pz,qw,qx,qy,qz\n{}", rows([half, 0.0, 0.0, half])));
    vidar(&["eval", text(&plain), text(&blanks)])
        .ends_with(1)
        .says(&["order of the quaternion", "--trajectory-format tum"]);
    for path in [&tum, &euroc] {
        let json = vidar(&["eval", text(path), text(&blanks), "--json"]).ends_with(0).json();
        let turned = json["report"]["orientation_se3_deg"]["max"].as_f64().unwrap();
        assert!(turned < 1e-6, "{}: turned by {turned} degrees", path.display());
    }
    let flag = ["--trajectory-format", "tum"];
    let json =
        vidar(&[&["eval", text(&plain), text(&plain), "--json"], &flag[..]].concat()).ends_with(0).json();
    assert_eq!(json["scores"]["ate"].as_f64().map(|v| v < 1e-9), Some(true));
}
