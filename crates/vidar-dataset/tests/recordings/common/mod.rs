//! Small datasets written into temporary folders.

use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use vidar_dataset::{DatasetError, OpenOptions, Recording, open};

/// A folder that is removed when dropped.
pub struct Folder(TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::Builder::new().prefix("vidar räume 1 ").tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn join(&self, part: &str) -> PathBuf {
        self.path().join(part)
    }

    /// Writes a file and the folders it lies in.
    pub fn write(&self, part: &str, content: impl AsRef<[u8]>) -> &Self {
        let path = self.join(part);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
        self
    }

    pub fn edit(&self, part: &str, change: impl FnOnce(String) -> String) -> &Self {
        let text = fs::read_to_string(self.join(part)).unwrap();
        self.write(part, change(text))
    }

    pub fn open(&self) -> Result<Recording, DatasetError> {
        open(self.path(), &OpenOptions::default())
    }

    pub fn open_with(&self, options: &OpenOptions) -> Result<Recording, DatasetError> {
        open(self.path(), options)
    }
}

/// A grey 8-bit PNG of one value.
pub fn gray_png(width: u32, height: u32, value: u8) -> Vec<u8> {
    png(
        width,
        height,
        png::ColorType::Grayscale,
        png::BitDepth::Eight,
        &vec![value; (width * height) as usize],
    )
}

/// A grey 16-bit PNG.
pub fn gray16_png(width: u32, height: u32, values: &[u16]) -> Vec<u8> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
    png(width, height, png::ColorType::Grayscale, png::BitDepth::Sixteen, &bytes)
}

pub fn png(width: u32, height: u32, color: png::ColorType, depth: png::BitDepth, data: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == png::ColorType::Indexed {
        encoder.set_palette(vec![10, 20, 30, 200, 100, 50]);
    }
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    out
}

/// Nanoseconds of frame `i` at 20 Hz in the dataset's clock.
pub fn frame_ns(i: i64) -> i64 {
    1_403_636_580_000_000_000 + i * 50_000_000
}

pub const CAM0: &str = "%YAML:1.0\n---\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [0.0, -1.0, 0.0, 0.1,\n         1.0, 0.0, 0.0, 0.2,\n         0.0, 0.0, 1.0, 0.3,\n         0.0, 0.0, 0.0, 1.0]\nrate_hz: 20\nresolution: [16, 12]\ncamera_model: pinhole\nintrinsics: [10.0, 11.0, 7.5, 5.5] #fu, fv, cu, cv\ndistortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0.0, 1e-05]\n";
pub const IMU0: &str = "%YAML:1.0\nsensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nrate_hz: 200\ngyroscope_noise_density: 1.6968e-04\ngyroscope_random_walk: 1.9393e-05\naccelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n";

/// Ten frames at 20 Hz, 120 IMU samples at 200 Hz, eleven reference poses, in EuRoC's layout.
pub fn euroc() -> Folder {
    let f = Folder::new();
    let mut list = String::from("#timestamp [ns],filename\n");
    let mut truth = String::from("#timestamp, p_RS_R_x [m], …, q_RS_w [], …\n");
    for i in 0..10 {
        let t = frame_ns(i);
        list += &format!("{t},{t}.png\n");
        truth += &format!("{t},{},0,1,1,0,0,0,0,0,0,0,0,0,0,0,0\n", 0.1 * i as f64);
        f.write(&format!("mav0/cam0/data/{t}.png"), gray_png(16, 12, 10 * i as u8));
    }
    let mut imu = String::from("#timestamp [ns],w x,w y,w z,a x,a y,a z\n");
    for i in 0..120 {
        imu += &format!("{},0.01,0,-0.01,0.1,0,9.8\n", frame_ns(0) - 50_000_000 + i * 5_000_000);
    }
    f.write("mav0/cam0/data.csv", list).write("mav0/cam0/sensor.yaml", CAM0);
    f.write("mav0/imu0/data.csv", imu).write("mav0/imu0/sensor.yaml", IMU0);
    f.write("mav0/state_groundtruth_estimate0/data.csv", truth);
    f
}

/// Five frames of TUM RGB-D.
pub fn tum() -> Folder {
    let f = Folder::new();
    let (mut rgb, mut depth, mut truth) = (
        String::from("# color images\n"),
        String::from("# depth maps\n"),
        String::from("# timestamp tx ty tz qx qy qz qw\n"),
    );
    for i in 0..5 {
        let t = format!("130503110{i}.5");
        rgb += &format!("{t} rgb/{t}.png\n");
        depth += &format!("130503110{i}.51 depth/{t}.png\n");
        truth += &format!("{t} {i} 0 0 0 0 0 1\n");
        f.write(&format!("rgb/{t}.png"), gray_png(640, 480, 9));
        f.write(&format!("depth/{t}.png"), gray16_png(640, 480, &vec![5000; 640 * 480]));
    }
    f.write("rgb.txt", rgb).write("depth.txt", depth).write("groundtruth.txt", truth);
    let accel: String =
        (0..40).map(|i| format!("130503110{}.{:02} 0.1 -9.7 0.3\n", i / 10, 9 * (i % 10))).collect();
    f.write("accelerometer.txt", accel);
    f
}

/// Four frames of 7-Scenes.
pub fn seven_scenes() -> Folder {
    let f = Folder::new();
    for i in 0..4 {
        let base = format!("seq-01/frame-00000{}", 2 * i);
        f.write(&format!("{base}.color.png"), gray_png(8, 6, 50));
        f.write(
            &format!("{base}.depth.png"),
            gray16_png(8, 6, &[[0, 65535, 1500].as_slice(), &[2000; 45]].concat()),
        );
        f.write(
            &format!("{base}.pose.txt"),
            format!("1 0 0 {}\n0 1 0 2\n0 0 1 3\n0 0 0 1\n", 0.1 * i as f64 + 1.0),
        );
    }
    f.write("camera-intrinsics.txt", "585 0 320\n0 585 240\n0 0 1\n");
    f
}

/// Four images, poses and depth.
pub fn posed() -> Folder {
    let f = Folder::new();
    let mut poses = String::new();
    for i in 0..4 {
        f.write(&format!("images/0000{}.png", i + 3), gray_png(8, 6, 50));
        f.write(&format!("depth/0000{}.png", i + 3), gray16_png(8, 6, &[1500; 48]));
        poses += &format!("1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1\n");
    }
    f.write("poses.txt", poses).write("K.txt", "9 0 3.5\n0 9 2.5\n0 0 1\n");
    f
}

/// The kinds of a dataset's warnings.
pub fn kinds(dataset: &Recording) -> Vec<&str> {
    dataset.warnings.iter().map(|w| w.kind.as_str()).collect()
}

/// The one warning of a kind.
#[track_caller]
pub fn warning<'a>(dataset: &'a Recording, kind: &str) -> &'a vidar_core::Warning {
    dataset
        .warnings
        .iter()
        .find(|w| w.kind == kind)
        .unwrap_or_else(|| panic!("no {kind} in {:#?}", dataset.warnings))
}
