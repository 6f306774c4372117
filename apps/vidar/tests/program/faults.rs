//! Bad input and bad luck: a clear error or a named degradation, its exit code, nothing lost.

mod output;

use crate::support::{
    ProgramOutput, copy_of_sequence, finished, images_of, manifest, run_on, shared, vidar, vidar_in,
};
use std::fs;
use std::path::{Path, PathBuf};

const SHORT: &[&str] = &["-q", "--stride", "2"];

/// A copy of the recording that may be spoilt, and a place for results.
struct Bench {
    folder: tempfile::TempDir,
    sequence: PathBuf,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let sequence = copy_of_sequence(folder.path());
        Self { folder, sequence }
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn run(&self, more: &[&str]) -> ProgramOutput {
        run_on(&self.sequence, &self.out(), more)
    }

    fn edit(&self, file: &str, change: impl FnOnce(String) -> String) -> PathBuf {
        let path = self.sequence.join(file);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, change(text)).unwrap();
        path
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Only the images of the recording, in one folder, named by their times.
fn image_folder(folder: &Path) -> PathBuf {
    let images = folder.join("just images");
    fs::create_dir(&images).unwrap();
    for image in images_of(&shared().sequence) {
        fs::copy(&image, images.join(image.file_name().unwrap())).unwrap();
    }
    images
}

#[test]
fn broken_images_are_named_left_out_and_the_run_is_degraded() {
    let bench = Bench::new();
    let images = images_of(&bench.sequence);
    let whole = fs::read(&images[4]).unwrap();
    fs::write(&images[4], &whole[..whole.len() / 2]).unwrap();
    fs::write(&images[8], b"").unwrap();
    fs::write(&images[12], b"this is not an image").unwrap();
    let ran = bench.run(&[]).ends_with(3).says(&[
        "warning: [image-unreadable]",
        "(and 1 more)",
        "warning: [image-empty]",
    ]);
    assert!(ran.stderr.contains(images[4].file_name().unwrap().to_str().unwrap()), "{}", ran.stderr);
    assert!(ran.stdout.contains("of 19 with depth"), "{}", ran.stdout);
    let log = fs::read_to_string(bench.out().join("log.jsonl")).unwrap();
    for i in [4, 8, 12] {
        assert!(
            log.contains(images[i].file_name().unwrap().to_str().unwrap()),
            "image {i} is not in the log"
        );
    }
    assert!(fs::metadata(bench.out().join("map/mesh.ply")).unwrap().len() > 10_000);
}

#[test]
fn an_image_of_another_size_is_left_out_and_named() {
    let bench = Bench::new();
    let images = images_of(&bench.sequence);
    // A depth picture of the finished run's own size would fit; one pixel is the smallest valid PNG here.
    fs::write(&images[6], ONE_PIXEL_PNG).unwrap();
    bench.run(&[]).ends_with(3).says(&["[image-size]", "1x1", "160x104"]);
}

/// A valid PNG of one grey pixel.
const ONE_PIXEL_PNG: &[u8] = &[
    0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0, 0, 0, 0x0d, 0x49, 0x48, 0x44, 0x52, 0, 0, 0, 1, 0, 0,
    0, 1, 8, 0, 0, 0, 0, 0x3a, 0x7e, 0x9b, 0x55, 0, 0, 0, 0x0a, 0x49, 0x44, 0x41, 0x54, 0x78, 0x9c, 0x63,
    0x60, 0, 0, 0, 2, 0, 1, 0x48, 0xaf, 0xa4, 0x71, 0, 0, 0, 0, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60,
    0x82,
];

#[test]
fn ground_truth_in_place_of_odometry_that_failed_degrades_the_run() {
    // Two and a half seconds at 8 Hz of 160x104 pixels are too little for the odometry to initialise.
    let out = shared().root.join("fallback");
    let flags = ["-q", "--stride", "2", "--set", "input.poses=auto"];
    run_on(&shared().sequence, &out, &flags).ends_with(3).says(&["[odometry-not-used]", "upper bound"]);
    let manifest = manifest(&out);
    assert_eq!((&manifest["exit"], &manifest["poses"]["source"]), (&3.into(), &"ground-truth".into()));
    let out = shared().root.join("no fallback");
    let flags = ["-q", "--stride", "2", "--set", "input.poses=odometry"];
    run_on(&shared().sequence, &out, &flags).ends_with(1).says(&["error[E0209]", "hint:"]);
}

#[test]
fn no_readable_image_at_all_is_bad_input() {
    let bench = Bench::new();
    for image in images_of(&bench.sequence) {
        fs::write(image, b"").unwrap();
    }
    bench.run(&[]).ends_with(1).says(&["error[E0", "hint:"]);
}

#[test]
fn a_malformed_csv_is_reported_with_file_and_line() {
    for (file, code) in [("mav0/cam0/data.csv", 4), ("mav0/imu0/data.csv", 9)] {
        let bench = Bench::new();
        bench.edit(file, |text| {
            let mut lines: Vec<&str> = text.lines().collect();
            lines[code - 1] = "16000x00,&&&,\u{fffd},,";
            lines.join("\n")
        });
        let ran = bench.run(SHORT).ends_with(1).says(&["error[E0201]", "expected", "hint:"]);
        assert!(ran.stderr.contains(&format!("data.csv:{code}")), "{}", ran.stderr);
    }
}

#[test]
fn a_camera_that_is_not_there_is_named_with_those_that_are() {
    let out = shared().root.join("no camera");
    run_on(&shared().sequence, &out, &["--camera", "3"]).ends_with(1).says(&[
        "error[E0201]",
        "no camera",
        "3",
    ]);
    assert!(!out.exists(), "a refused run left a folder");
}

#[test]
fn a_missing_image_list_and_a_missing_calibration_are_bad_input() {
    let bench = Bench::new();
    fs::remove_dir_all(bench.sequence.join("mav0/cam0/data")).unwrap();
    let code = bench.run(SHORT).code;
    assert!([1, 3].contains(&code), "{code}");
    let bench = Bench::new();
    fs::remove_file(bench.sequence.join("mav0/cam0/sensor.yaml")).unwrap();
    bench.run(SHORT).ends_with(1).says(&["error[", "sensor.yaml", "hint:"]);
}

#[test]
fn singular_intrinsics_are_refused_with_their_place() {
    for zero in ["[0.0, 99.0, 77.0, 53.0]", "[.nan, 99.0, 77.0, 53.0]", "[-99.0, 99.0, 77.0, 53.0]"] {
        let bench = Bench::new();
        bench.edit("mav0/cam0/sensor.yaml", |t| {
            t.lines()
                .map(
                    |l| {
                        if l.starts_with("intrinsics") { format!("intrinsics: {zero}") } else { l.to_owned() }
                    },
                )
                .collect::<Vec<_>>()
                .join("\n")
        });
        bench.run(SHORT).ends_with(1).says(&["error[E0201]", "sensor.yaml", "hint:"]);
    }
    vidar(&["inspect", text(&shared().sequence), "--camera-model", "pinhole:0,0,1,1"]).ends_with(2).says(&[
        "error[E0105]",
        "camera model",
        "fx",
        "pinhole:fx,fy,cx,cy",
        "hint:",
    ]);
}

#[test]
fn poses_that_are_not_numbers_are_left_out_and_counted() {
    let truth = fs::read_to_string(finished().0.join("trajectory/metric_camera.tum")).unwrap();
    let mut number = 0;
    let spoilt: Vec<String> = truth
        .lines()
        .map(|line| {
            number += usize::from(!line.starts_with('#'));
            let stamp = line.split(' ').next().unwrap();
            if !line.starts_with('#') && number % 97 == 50 {
                format!("{stamp} nan nan nan 0 0 0 1")
            } else {
                line.into()
            }
        })
        .collect();
    let file = shared().root.join("nan.tum");
    fs::write(&file, spoilt.join("\n")).unwrap();
    let flags = ["--stride", "2", "--trajectory", text(&file), "--trajectory-body", "camera0"];
    let ran = run_on(&shared().sequence, &shared().root.join("nan poses"), &flags).says(&["pose-not-finite"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    // Nothing but NaN is no trajectory.
    fs::write(&file, "1600000000.0 nan 0 0 0 0 0 1\n1600000001.0 nan 0 0 0 0 0 1\n").unwrap();
    run_on(&shared().sequence, &shared().root.join("all nan"), &flags)
        .ends_with(1)
        .says(&["error[E0201]", "nan.tum"]);
}

#[test]
fn images_and_poses_without_overlap_are_reported_with_both_ranges_and_the_likely_unit() {
    let file = shared().root.join("elsewhere.tum");
    fs::write(&file, "5.0 0 0 0 0 0 0 1\n6.0 1 0 0 0 0 0 1\n7.0 2 0 0 0 0 0 1\n").unwrap();
    let out = shared().root.join("no overlap");
    let flags = ["--trajectory", text(&file), "--trajectory-body", "imu"];
    run_on(&shared().sequence, &out, &flags).ends_with(1).says(&[
        "error[E0203]",
        "1600000000.000000000",
        "5.000000000",
        "7.000000000",
        "hint:",
        "clock",
    ]);
    assert!(!out.exists(), "a refused run left a folder");
    // The same times in milliseconds.
    fs::write(&file, "1600000.000 0 0 0 0 0 0 1\n1600000.001 1 0 0 0 0 0 1\n1600000.002 2 0 0 0 0 0 1\n")
        .unwrap();
    let ran = run_on(&shared().sequence, &out, &flags).ends_with(1).says(&["error[E0203]", "hint:"]);
    assert!(ran.stderr.contains("1000 times"), "{}", ran.stderr);
}

#[test]
fn images_alone_are_inspected_but_not_mapped_without_calibration_and_poses() {
    let folder = tempfile::tempdir().unwrap();
    let images = image_folder(folder.path());
    let ran = vidar(&["inspect", text(&images)]).ends_with(0).says(&["intrinsics-guessed"]);
    assert!(ran.stdout.contains("not possible yet"), "{}", ran.stdout);
    let truth = finished().0.join("trajectory/metric_camera.tum");
    let out = folder.path().join("out");
    let trajectory = ["--trajectory", text(&truth), "--trajectory-body", "camera0", "-q"];
    run_on(&images, &out, &trajectory).ends_with(1).says(&[
        "error[E0208]",
        "guess",
        "--camera-model",
        "--calibration",
    ]);
    let camera = "radtan:99.375,99.0808,77.7049,53.4229,-0.28340811,0.07395907,0.00019359,1.76187114e-5";
    run_on(&images, &out, &["--camera-model", camera]).ends_with(1).says(&["error[E0202]", "--trajectory"]);
    let with_both: Vec<&str> = trajectory.into_iter().chain(["--camera-model", camera]).collect();
    run_on(&images, &out, &with_both).ends_with(0);
    assert!(out.join("map/mesh.ply").is_file());
}

#[test]
fn what_is_no_recording_is_refused_with_what_was_looked_for() {
    let folder = tempfile::tempdir().unwrap();
    for verb in ["run", "inspect"] {
        vidar(&[verb, text(folder.path())]).ends_with(1).says(&["error[E0201]", "expected", "hint:"]);
        vidar(&[verb, "not/there"]).ends_with(1).says(&["error[E0201]", "not/there", "hint:"]);
    }
    fs::write(folder.path().join("notes.txt"), "milk").unwrap();
    vidar(&["inspect", text(folder.path())]).ends_with(1).says(&["error[E0201]", "expected"]);
    vidar(&["inspect", text(&folder.path().join("notes.txt"))]).ends_with(1).says(&["error[E0201]"]);
}

#[test]
fn an_empty_selection_of_images_is_reported_with_the_available_range() {
    let out = shared().root.join("cut");
    let (sequence, cut) = (&shared().sequence, |flags: &[&str]| run_on(&shared().sequence, &out, flags));
    cut(&["--start", "100"]).ends_with(1).says(&["error[E0201]", "no image", "hint:"]);
    cut(&["--stride", "1000000000000"]).ends_with(1).says(&["error[E0204]", "keyframes", "hint:"]);
    cut(&["--start", "-1"]).ends_with(2).says(&["error"]);
    cut(&["--start", "2", "--end", "1"]).ends_with(2).says(&["error[E0105]", "later than start"]);
    cut(&["--start", "1e300"]).ends_with(1);
    assert!(!out.exists() && sequence.exists());
}

#[test]
fn an_invalid_reference_is_refused_early_or_prevents_only_the_evaluation() {
    let out = shared().root.join("reference");
    run_on(&shared().sequence, &out, &["--reference", "no.ply"])
        .ends_with(4)
        .says(&["error[E0401]", "no.ply"]);
    assert!(!out.exists(), "refused before anything was made");
    let bench = Bench::new();
    let nan = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        end_header\n0 0 0\nnan 1 2\n1 0 0\n";
    let file = bench.folder.path().join("nan.ply");
    fs::write(&file, nan).unwrap();
    let flags = ["--stride", "2", "--set", "eval.mode=auto", "--reference", text(&file)];
    let ran = bench.run(&flags).ends_with(3).says(&["[not-evaluated]"]);
    assert!(ran.stderr.contains("nan") || ran.stderr.contains("NaN"), "{}", ran.stderr);
    assert!(bench.out().join("map/mesh.ply").is_file(), "the map must survive a bad reference");
    vidar(&["eval", text(&file), text(&finished().0.join("map/points.ply"))]).ends_with(1).says(&["error["]);
}

#[test]
fn relative_paths_with_spaces_and_letters_of_any_script_work() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path().join("mein Ordner – дом");
    fs::create_dir(&here).unwrap();
    crate::support::copy_tree(&shared().sequence, &here.join("Küche 1"));
    let settings = text(&shared().settings);
    let ran =
        vidar_in(&here, &["run", "./Küche 1", "--config", settings, "-q", "--stride", "2"]).ends_with(0);
    assert!(ran.stdout.contains("runs/Küche_1/"), "{}", ran.stdout);
    let manifest = fs::read_to_string(here.join("runs/Küche_1/latest/manifest.json")).unwrap();
    assert!(
        manifest.contains("'./Küche 1'") || manifest.contains("./Küche 1"),
        "the command can be typed again"
    );
}

#[test]
fn errors_give_what_where_and_the_next_step_in_one_form() {
    let ran = vidar(&["run", "not/there", "-q"]).ends_with(1);
    let lines: Vec<&str> = ran.stderr.lines().collect();
    assert!(lines[0].starts_with("error[E0201]: ") && lines[0].contains("not/there"), "{}", ran.stderr);
    assert!(lines.last().unwrap().starts_with("  hint: "), "{}", ran.stderr);
    assert!(!ran.stderr.contains("backtrace"));
}
