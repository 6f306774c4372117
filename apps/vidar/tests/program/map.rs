//! The place is found again: after the camera saw nothing for seconds, and in the map of an earlier recording.

use crate::support::{ProgramOutput, command, copy_tree, images_of, shared, vidar};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

const WORLD: &str = "duration_secs = 14.0\ncamera_rate_hz = 20.0\nwidth = 376\nheight = 240\nblur_samples = 1\n\
    exposure_secs = 0.0\nscan_spacing_m = 0.1\n";

/// A camera that is moved to and fro for 14 s, as by a hand, so that it sees the same wall again and again.
fn to_and_fro() -> &'static Path {
    static RECORDING: OnceLock<PathBuf> = OnceLock::new();
    RECORDING.get_or_init(|| {
        let (world, path) = (shared().root.join("to_and_fro.toml"), shared().root.join("to_and_fro.tum"));
        std::fs::write(&world, WORLD).unwrap();
        let mut poses = String::new();
        for k in 0..=280 {
            let t = 0.05 * f64::from(k);
            let phase = std::f64::consts::TAU * t / 3.5;
            let (x, y, z) =
                (0.5 * phase.sin(), 0.4 * (1.3 * phase + 0.5).sin(), 1.4 + 0.25 * (0.8 * phase).sin());
            let (s, c) = (0.175 * (0.7 * phase).sin()).sin_cos();
            writeln!(poses, "{t:.3} {x:.6} {y:.6} {z:.6} 0 0 {s:.7} {c:.7}").unwrap();
        }
        std::fs::write(&path, poses).unwrap();
        let sequence = shared().root.join("to and fro");
        let mut synth = command();
        synth.arg("synth").arg(&sequence).arg("--world-config").arg(&world).arg("--trajectory").arg(&path);
        ProgramOutput::from(synth.output().unwrap()).ends_with(0);
        sequence
    })
}

fn odometry(sequence: &Path, out: &Path, more: &[&str]) -> ProgramOutput {
    let mut command = command();
    command.arg("odometry").arg(sequence).arg("-o").arg(out).args(["--json", "-q"]).args(more);
    command.output().unwrap().into()
}

/// A PNG of one grey level: deflate's stored blocks.
fn flat_png(width: u32, height: u32) -> Vec<u8> {
    let crc = |bytes: &[u8]| {
        !bytes.iter().fold(!0_u32, |crc, byte| {
            (0..8).fold(crc ^ u32::from(*byte), |c, _| (c >> 1) ^ (0xedb8_8320 * (c & 1)))
        })
    };
    let row: Vec<u8> = std::iter::once(0).chain(std::iter::repeat_n(128, width as usize)).collect();
    let raw = row.repeat(height as usize);
    let (a, b) = raw.iter().fold((1_u32, 0_u32), |(a, b), byte| {
        let a = (a + u32::from(*byte)) % 65521;
        (a, (b + a) % 65521)
    });
    let mut stored = vec![0x78, 1];
    let mut blocks = raw.chunks(65535).peekable();
    while let Some(block) = blocks.next() {
        let length = block.len() as u16;
        stored.push(u8::from(blocks.peek().is_none()));
        stored.extend(length.to_le_bytes().iter().chain(&(!length).to_le_bytes()).chain(block));
    }
    stored.extend(((b << 16) | a).to_be_bytes());
    let header = [width.to_be_bytes().as_slice(), &height.to_be_bytes(), &[8, 0, 0, 0, 0]].concat();
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    for (kind, data) in [(b"IHDR", header), (b"IDAT", stored), (b"IEND", Vec::new())] {
        let body = [kind.as_slice(), &data].concat();
        png.extend((data.len() as u32).to_be_bytes().iter().chain(&body).chain(&crc(&body).to_be_bytes()));
    }
    png
}

/// Time, s, and position, m, of every pose.
fn positions(tum: &Path) -> Vec<(f64, [f64; 3])> {
    let text = std::fs::read_to_string(tum).unwrap();
    let rows = text.lines().filter(|l| !l.starts_with('#'));
    rows.map(|row| {
        let v: Vec<f64> = row.split(' ').map(|v| v.parse().unwrap()).collect();
        (v[0], [v[1], v[2], v[3]])
    })
    .collect()
}

#[test]
fn after_seconds_without_sight_the_place_is_found_again_and_the_world_is_one() {
    let folder = tempfile::tempdir().unwrap();
    let (sequence, out) = (folder.path().join("blind"), folder.path().join("out"));
    copy_tree(to_and_fro(), &sequence);
    // 3.5 s: the IMU alone is trusted for 2 s, and the adjustment bridges 3 s without one.
    let flat = flat_png(376, 240);
    images_of(&sequence)[90..160].iter().for_each(|image| std::fs::write(image, &flat).unwrap());
    let ran = odometry(&sequence, &out, &[]).ends_with(3).says(&["track-lost", "the place was found again"]);
    let json = ran.json();
    let lost = json["lost"].as_array().unwrap();
    assert!(lost.len() == 1 && lost[0]["found_again_ns"].is_i64(), "{lost:?}");
    let rmse = |report: &Value| report["ate_se3_m"]["rmse"].as_f64().unwrap();
    assert!(rmse(&json["final"]["trajectory"]) < 0.01, "{}", json["final"]["trajectory"]);
    assert!(rmse(&json["trajectory"]) < 0.05, "{}", json["trajectory"]);
    let (all, adjusted) = (json["images"].as_f64().unwrap(), json["final"]["images"].as_f64().unwrap());
    assert!(adjusted > 0.95 * all, "{adjusted} of {all}");
}

#[test]
fn a_recording_is_found_in_the_map_of_an_earlier_one_and_shares_its_world() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    odometry(to_and_fro(), &first, &["--end", "8"]).ends_with(0);
    let map = first.to_str().unwrap();
    let json = odometry(to_and_fro(), &second, &["--start", "6", "--map", map]).ends_with(0).json();
    assert!(json["map"]["matches"].as_u64().unwrap() > 100, "{}", json["map"]);
    assert!(json["map"]["found_live_ns"].is_i64(), "{}", json["map"]);
    // Between 6 and 8 s both have poses.
    let (a, b) = ["first", "second"]
        .map(|f| positions(&folder.path().join(f).join("trajectory/final_body.tum")))
        .into();
    let mut common = 0;
    for (time, position) in &b {
        let Some((_, other)) = a.iter().find(|(t, _)| (t - time).abs() < 1e-4) else { continue };
        let apart = (0..3).map(|k| (position[k] - other[k]).powi(2)).sum::<f64>().sqrt();
        assert!(apart < 0.03, "{apart} m apart at {time} s");
        common += 1;
    }
    assert!(common > 30, "{common} poses at the same times");

    // The map that it leaves holds both recordings, and a dense map lies in the same world.
    let size = |run: &Path| std::fs::metadata(run.join("odometry/map.cbor")).unwrap().len();
    assert!(size(&second) > size(&first), "{} and {}", size(&second), size(&first));

    let elsewhere = folder.path().join("elsewhere");
    let ran = odometry(crate::odometry::flight(), &elsewhere, &["--map", map]);
    let ran = ran.ends_with(3).says(&["map-not-found", "a world of their own"]);
    assert!(ran.json()["map"]["matches"].is_null());
}

#[test]
fn what_is_no_map_is_refused_before_anything_is_tracked() {
    let folder = tempfile::tempdir().unwrap();
    let damaged = folder.path().join("map.cbor");
    std::fs::write(&damaged, [0x9f; 2000]).unwrap();
    let out = folder.path().join("out");
    for (map, says) in [
        (damaged.as_path(), "no map of VIDAR"),
        (folder.path(), "odometry/map.cbor"),
        (Path::new("/dev/zero"), "larger than"),
    ] {
        for verb in ["odometry", "run"] {
            let arguments = [
                verb.as_ref(),
                to_and_fro().as_os_str(),
                "--map".as_ref(),
                map.as_ref(),
                "-o".as_ref(),
                out.as_ref(),
            ];
            vidar(&arguments).ends_with(1).says(&["E0211", says]);
            assert!(!out.exists(), "{verb}");
        }
    }
}
