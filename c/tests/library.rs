//! The header is that of the sources, and the C++ example, built with the system's compiler, has the bits of the Rust libraries.

#![allow(clippy::unwrap_used, clippy::print_stderr)] // helpers of tests are test code, though not marked so

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use vidar::core::{CameraId, FrameImage, ImuNoise, SensorEvent, So3, Timestamp};
use vidar::da3::{Da3Options, InferOptions, Inputs, Precision};
use vidar::dataset::{CameraFlag, OpenOptions, Recording};
use vidar::models::bundled;
use vidar::odometry_stage::{Odometry, OdometryConfig, OdometryOutput};
use vidar::synth::{SynthConfig, write_sequence};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

#[test]
fn the_header_is_that_of_the_sources() {
    let config = cbindgen::Config::from_root_or_default(ROOT);
    let builder = ["error", "image", "odometry", "depth"]
        .iter()
        .fold(cbindgen::Builder::new().with_config(config), |b, m| b.with_src(format!("{ROOT}/src/{m}.rs")));
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let path = Path::new(ROOT).join("include/vidar.h");
    if std::env::var_os("UPDATE_HEADER").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    assert!(std::fs::read(&path).unwrap() == made, "UPDATE_HEADER=1 cargo test makes include/vidar.h again");
}

/// The folder of the shared library: that of the test, or the one above.
fn library_folder() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let name = format!("{}vidar_c{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    test.ancestors().skip(1).take(2).find(|folder| folder.join(&name).is_file()).unwrap().to_owned()
}

/// A flight of six seconds as the example reads it.
fn flight(folder: &Path) -> Recording {
    let config = SynthConfig {
        duration_secs: 6.0,
        camera_rate_hz: 20.0,
        depth: false,
        scan_spacing_m: 0.2,
        ..SynthConfig::default()
    };
    write_sequence(&folder.join("room"), &config, None, &|_, _| true).unwrap();
    let dataset = vidar::dataset::open(&folder.join("room"), &OpenOptions::default()).unwrap();
    let camera = &dataset.rig.cameras[0];
    let (p, q) = (camera.body_from_camera.translation, camera.body_from_camera.rotation.quaternion_xyzw());
    let model = CameraFlag(camera.model.clone());
    let (width, height) = (camera.model.width(), camera.model.height());
    let text =
        format!("{model} {width} {height} {} {} {} {} {} {} {}\n", p.x, p.y, p.z, q[0], q[1], q[2], q[3]);
    std::fs::write(folder.join("camera.txt"), text).unwrap();
    let (mut imu, mut frames) = (String::new(), String::new());
    for sample in &dataset.imu {
        let [w, a] = [sample.gyro.0, sample.accel.0];
        let time = sample.time.nanos();
        writeln!(imu, "{time},{},{},{},{},{},{}", w.x, w.y, w.z, a.x, a.y, a.z).unwrap();
    }
    for (i, entry) in dataset.images.iter().enumerate() {
        let mut pgm = format!("P5\n{width} {height}\n255\n").into_bytes();
        pgm.extend_from_slice(dataset.load_image(entry).unwrap().to_gray8().data());
        std::fs::write(folder.join(format!("{i}.pgm")), pgm).unwrap();
        writeln!(frames, "{} {i}.pgm", entry.time.nanos()).unwrap();
    }
    std::fs::write(folder.join("imu.csv"), imu).unwrap();
    std::fs::write(folder.join("frames.txt"), frames).unwrap();
    dataset
}

/// The states that the Rust library makes of the same events, in the example's order.
fn states(dataset: &Recording) -> Vec<OdometryOutput> {
    let config = OdometryConfig { max_landmarks: 120, ..OdometryConfig::default() };
    let mut rig = dataset.rig.clone();
    rig.imu = Some(ImuNoise::EUROC);
    // As the library makes it of the quaternion that it is given.
    let mount = &mut rig.cameras[0].body_from_camera;
    let [x, y, z, w] = mount.rotation.quaternion_xyzw();
    mount.rotation = So3::from_quaternion(x, y, z, w).unwrap();
    let mut odometry = Odometry::new(&rig, CameraId(0), &config).unwrap();
    let mut imu = dataset.imu.iter().peekable();
    let (mut outputs, mut newest) = (Vec::new(), Timestamp::from_nanos(0));
    for (i, entry) in dataset.images.iter().enumerate() {
        while newest <= entry.time {
            let Some(sample) = imu.next() else { break };
            newest = sample.time;
            outputs.extend(odometry.push(SensorEvent::Imu(*sample)).unwrap());
        }
        let image = FrameImage::Gray8(dataset.load_image(entry).unwrap().to_gray8());
        let id = vidar::core::FrameId(i as u32);
        let frame = vidar::core::Frame { id, time: entry.time, camera: CameraId(0), image };
        outputs.extend(odometry.push(SensorEvent::Image(frame)).unwrap());
    }
    outputs.extend(odometry.finish());
    outputs
}

#[test]
fn the_example_has_the_bits_of_the_library() {
    if Command::new("c++").arg("--version").output().is_err() {
        eprintln!("skipped: there is no C++ compiler");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let dataset = flight(folder.path());
    let (program, libraries) = (folder.path().join("live"), library_folder());
    let built = Command::new("c++")
        .args(["-std=c++17", "-Wall", "-Wextra", "-Werror"])
        .arg(format!("{ROOT}/examples/live.cpp"))
        .args([format!("-I{ROOT}/include"), format!("-L{}", libraries.display()), "-lvidar_c".into()])
        .arg(format!("-Wl,-rpath,{}", libraries.display()))
        .arg("-o")
        .arg(&program)
        .output()
        .unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let ran = Command::new(&program).arg(folder.path()).output().unwrap();
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    let said = String::from_utf8(ran.stdout).unwrap();
    let lines: Vec<Vec<f64>> =
        said.lines().map(|l| l.split(' ').map(|v| v.parse().unwrap()).collect()).collect();

    let states = states(&dataset);
    let metric = states.iter().filter(|s| s.health().is_metric()).count();
    let last = states.last().unwrap().tracking().unwrap();
    let position = last.state.world_from_body.translation;
    assert!(2 * metric > states.len(), "{metric} of {}", states.len());
    // Seventeen digits are all bits.
    assert_eq!(lines[0][..5], [states.len() as f64, metric as f64, position.x, position.y, position.z]);

    let options = Da3Options { head_precision: Some(Precision::F32), ..Da3Options::default() };
    let mut infer = InferOptions::default();
    infer.preprocess.process_size_px = 112;
    let image = dataset.load_image(dataset.images.last().unwrap()).unwrap().to_rgb8();
    let depth = bundled::open(&options).unwrap().infer(&Inputs::images(&[image]), &infer).unwrap().depth;
    let (width, height) = (depth[0].width(), depth[0].height());
    assert_eq!((lines[1][0], lines[1][1]), (width as f64, height as f64));
    assert_eq!(lines[1][2] as f32, depth[0][(width / 2, height / 2)]);
}

#[test]
fn what_cannot_be_used_is_an_error_with_its_code() {
    if Command::new("c++").arg("--version").output().is_err() {
        eprintln!("skipped: there is no C++ compiler");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (source, program) = (folder.path().join("wrong.cpp"), folder.path().join("wrong"));
    let text = r#"
        #include <cstdio>
        #include "vidar.h"
        static void tell(VidarError *&error) {
            std::puts(error ? vidar_error_code(error) : "none");
            vidar_error_free(error);
            error = nullptr;
        }
        int main() {
            VidarError *error = nullptr;
            vidar_odometry_new(nullptr, nullptr, nullptr, &error); tell(error);
            VidarCamera camera{"pinhole:1,2", 64, 48, {0, 0, 0}, {0, 0, 0, 1}, 0};
            vidar_odometry_new(&camera, nullptr, nullptr, &error); tell(error);
            camera.model = "pinhole:60,60,31.5,23.5";
            const char *settings[] = {"odometry.max_landmark=100", nullptr};
            vidar_odometry_new(&camera, nullptr, settings, &error); tell(error);
            VidarOdometry *odometry = vidar_odometry_new(&camera, nullptr, nullptr, &error); tell(error);
            unsigned char pixels[32 * 32] = {};
            VidarImage image{pixels, 32, 32, 1, 32};
            VidarState state{};
            vidar_odometry_push_image(odometry, 0, 0, &image, &state, &error); tell(error);
            image.row_bytes = 8;
            vidar_odometry_push_image(odometry, 0, 0, &image, nullptr, &error); tell(error);
            vidar_odometry_push_imu(nullptr, 0, nullptr, nullptr, nullptr, &error); tell(error);
            vidar_odometry_free(odometry);
            vidar_depth_open("da3-enormous", &error); tell(error);
            vidar_depth_predict(nullptr, nullptr, 0, 0, nullptr);
            vidar_odometry_free(nullptr); vidar_depth_free(nullptr); vidar_depth_close(nullptr);
        }"#;
    std::fs::write(&source, text).unwrap();
    let libraries = library_folder();
    let built = Command::new("c++")
        .arg("-std=c++17")
        .arg(&source)
        .args([format!("-I{ROOT}/include"), format!("-L{}", libraries.display()), "-lvidar_c".into()])
        .arg(format!("-Wl,-rpath,{}", libraries.display()))
        .arg("-o")
        .arg(&program)
        .output()
        .unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let ran = Command::new(&program).output().unwrap();
    assert!(ran.status.success(), "{:?}", ran.status);
    let codes = "E0105\nE0105\nE0101\nnone\nE0310\nE0105\nE0105\nE0105\n";
    assert_eq!(String::from_utf8(ran.stdout).unwrap(), codes);
}
