//! Records of Spectacular AI's and AaltoML's `data.jsonl`, and `calibration.json`.
//!
//! After "Data format" of SpectacularAI/docs: one JSON object a line, times in seconds, m/s², rad/s; `imuToCamera` maps points of the IMU
//! to the camera.

use crate::calibration::{departure, model_from_parts};
use crate::error::DatasetError;
use crate::source::{MAX_ROWS, Source};
use nalgebra::{Matrix4, Vector3};
use serde::Deserialize;
use vidar_core::{CameraModel, Se3, So3, TimedVector, Timestamp, Warning};

/// Largest JSON calibration, bytes.
const MAX_JSON_BYTES: usize = 1 << 20;
/// Trackers whose poses are those of the recording, in the order of preference.
const TRACKERS: [&str; 4] = ["arkit", "arcore", "arengine", "output"];

/// A pose in a JSON record.
pub type JsonPose = (Timestamp, Option<Se3>);

/// What a `data.jsonl` holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JsonRecording {
    /// Gyroscope, rad/s.
    pub gyro: Vec<TimedVector>,
    /// Accelerometer as written, m/s² by the format.
    pub accel: Vec<TimedVector>,
    /// For every frame of the camera asked for: its time and number.
    pub frames: Vec<(Timestamp, Option<u64>)>,
    /// The first calibration that a frame states.
    pub calibration: Option<JsonCamera>,
    /// `groundTruth`; `None` where a pose is no rigid motion or has no orientation.
    pub truth: Vec<JsonPose>,
    /// Poses of a tracker that ran on the device, and its name.
    pub tracked: Option<(String, Vec<JsonPose>)>,
    /// Lines that are no JSON object: how many, and the first.
    pub unread: Option<(usize, usize)>,
    rows: usize,
}

#[derive(Deserialize)]
struct Record {
    time: Option<f64>,
    number: Option<u64>,
    sensor: Option<Sensor>,
    frames: Option<Vec<Frame>>,
    #[serde(rename = "groundTruth")]
    truth: Option<Pose>,
    arkit: Option<Pose>,
    arcore: Option<Pose>,
    arengine: Option<Pose>,
    output: Option<Pose>,
}

#[derive(Deserialize)]
struct Sensor {
    #[serde(rename = "type")]
    kind: String,
    values: Vec<f64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Frame {
    #[serde(default)]
    camera_ind: u32,
    time: Option<f64>,
    #[serde(default)]
    missing_bitmap: bool,
    camera_parameters: Option<JsonCamera>,
    imu_to_camera: Option<Vec<Vec<f64>>>,
}

#[derive(Deserialize)]
struct Pose {
    position: Option<Xyz>,
    orientation: Option<Xyzw>,
}

#[derive(Deserialize)]
struct Xyz {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Deserialize)]
struct Xyzw {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

/// A camera as the format states it.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct JsonCamera {
    focal_length_x: f64,
    focal_length_y: f64,
    principal_point_x: Option<f64>,
    principal_point_y: Option<f64>,
    #[serde(alias = "distortionModel")]
    model: String,
    distortion_coefficients: Vec<f64>,
    #[serde(alias = "imuToCameraMatrix")]
    imu_to_camera: Option<Vec<Vec<f64>>>,
    image_width: Option<f64>,
    image_height: Option<f64>,
}

#[derive(Deserialize)]
struct Calibration {
    cameras: Vec<JsonCamera>,
}

fn timestamp(secs: f64) -> Option<Timestamp> {
    // 2^63 ns are 292 years; a time beyond is no time.
    (secs.is_finite() && secs.abs() < 9e9).then(|| Timestamp::from_nanos((secs * 1e9).round() as i64))
}

impl JsonRecording {
    /// Takes a block of lines with `lines_before` before it; `camera` is the index of the camera whose frames are listed.
    pub fn add(&mut self, source: &Source<'_>, lines_before: usize, camera: u32) -> Result<(), DatasetError> {
        // A calibration of every frame repeats itself; the format of a byte-order mark is reported by other readers.
        let lines = source.lines_after(lines_before, &mut Vec::new())?;
        for row in lines.rows {
            self.rows += 1;
            if self.rows > 2 * MAX_ROWS {
                return Err(source.too_many_rows(row.line, 2 * MAX_ROWS));
            }
            match serde_json::from_str::<Record>(row.text) {
                Ok(record) => self.take(record, camera),
                Err(_) => self.unread.get_or_insert((0, row.line)).0 += 1,
            }
        }
        Ok(())
    }

    fn take(&mut self, record: Record, camera: u32) {
        let Some(time) = record.time.and_then(timestamp) else { return };
        if let Some(Sensor { kind, values }) = &record.sensor
            && let &[x, y, z] = values.as_slice()
            && [x, y, z].iter().all(|v| v.is_finite())
        {
            match kind.as_str() {
                "gyroscope" => self.gyro.push((time, Vector3::new(x, y, z))),
                "accelerometer" => self.accel.push((time, Vector3::new(x, y, z))),
                _ => {}
            }
        }
        for frame in record.frames.into_iter().flatten() {
            if frame.camera_ind != camera || frame.missing_bitmap {
                continue;
            }
            self.frames.push((frame.time.and_then(timestamp).unwrap_or(time), record.number));
            if self.calibration.is_none()
                && let Some(mut stated) = frame.camera_parameters
            {
                stated.imu_to_camera = stated.imu_to_camera.or(frame.imu_to_camera);
                self.calibration = Some(stated);
            }
        }
        if let Some(pose) = &record.truth {
            self.truth.push((time, pose.rigid()));
        }
        let found = [record.arkit, record.arcore, record.arengine, record.output];
        if let Some((name, pose)) = TRACKERS.iter().zip(found).find_map(|(name, pose)| Some((*name, pose?))) {
            let (kept, poses) = self.tracked.get_or_insert_with(|| (name.to_string(), Vec::new()));
            if *kept == name {
                poses.push((time, pose.rigid()));
            }
        }
    }
}

impl Pose {
    fn rigid(&self) -> Option<Se3> {
        let (p, q) = (self.position.as_ref()?, self.orientation.as_ref()?);
        let norm = (q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w).sqrt();
        let rotation = So3::from_quaternion(q.x, q.y, q.z, q.w).filter(|_| (norm - 1.0).abs() < 0.05)?;
        let pose = Se3::new(rotation, Vector3::new(p.x, p.y, p.z));
        pose.is_finite().then_some(pose)
    }
}

/// Reads the cameras of a `calibration.json`.
pub fn json_calibration(source: &Source<'_>) -> Result<Vec<JsonCamera>, DatasetError> {
    let calibration: Calibration = from_json(source, "an object with a list \"cameras\"")?;
    Ok(calibration.cameras)
}

/// The camera of Replica's rendering.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReplicaCamera {
    /// `[fx, fy, cx, cy]`, pixels.
    pub intrinsics: [f64; 4],
    /// Raw units of depth per metre.
    pub units_per_metre: f64,
}

/// Reads `cam_params.json`: `{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}`.
pub fn replica_camera(source: &Source<'_>) -> Result<ReplicaCamera, DatasetError> {
    #[derive(Deserialize)]
    struct File {
        camera: Parameters,
    }
    #[derive(Deserialize)]
    struct Parameters {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        scale: f64,
    }
    let File { camera } = from_json(source, "an object \"camera\" with fx, fy, cx, cy, scale")?;
    if !(camera.scale.is_finite() && camera.scale > 0.0) {
        return Err(source.malformed(0, format!("scale: {}", camera.scale), "a positive number"));
    }
    let intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy];
    Ok(ReplicaCamera { intrinsics, units_per_metre: camera.scale })
}

fn from_json<'a, T: Deserialize<'a>>(source: &Source<'a>, expected: &str) -> Result<T, DatasetError> {
    if source.bytes.len() > MAX_JSON_BYTES {
        let found = format!("{} bytes", source.bytes.len());
        return Err(source.malformed(0, found, format!("at most {MAX_JSON_BYTES} bytes of JSON")));
    }
    let text = source.text(&mut Vec::<Warning>::new())?;
    serde_json::from_str(text).map_err(|e| source.malformed(e.line(), e.to_string(), expected))
}

impl JsonCamera {
    /// How it projects; size 0×0 where it states none.
    pub fn model(&self, source: &Source<'_>) -> Result<CameraModel, DatasetError> {
        let side = |v: Option<f64>| v.filter(|v| (1.0..=65535.0).contains(v)).map(|v| v as usize);
        let size = side(self.image_width).zip(side(self.image_height));
        let centre = |given: Option<f64>, side: Option<usize>| {
            given.or_else(|| side.map(|s| 0.5 * s as f64 - 0.5)).ok_or_else(|| {
                source.malformed(
                    0,
                    "no principal point and no image size",
                    "principalPointX and principalPointY",
                )
            })
        };
        let cx = centre(self.principal_point_x, size.map(|s| s.0))?;
        let cy = centre(self.principal_point_y, size.map(|s| s.1))?;
        let d = self.distortion_coefficients.as_slice();
        let name = self.model.to_ascii_lowercase().replace('_', "-");
        let (distortion, coefficients) = match (name.as_str(), d) {
            (_, []) if name != "kannala-brandt4" => ("none", Vec::new()),
            // Radial terms only.
            ("pinhole" | "", &[k1, k2, k3]) => ("radtan", vec![k1, k2, 0.0, 0.0, k3]),
            ("brown-conrady", &[k1, k2, p1, p2]) => ("radtan", vec![k1, k2, p1, p2]),
            // OpenCV's order; the denominator's terms must vanish.
            ("brown-conrady", &[k1, k2, p1, p2, k3, ref rest @ ..]) if rest.iter().all(|v| *v == 0.0) => {
                ("radtan", vec![k1, k2, p1, p2, k3])
            }
            ("kannala-brandt4", _) => ("equidistant", d.to_vec()),
            (other, _) => (other, d.to_vec()),
        };
        let intrinsics = [self.focal_length_x, self.focal_length_y, cx, cy];
        model_from_parts(source.path, "cameras", ("pinhole", distortion), &intrinsics, &coefficients, size)
    }

    /// Maps points of the IMU to the camera.
    pub fn camera_from_imu(&self, source: &Source<'_>) -> Result<Option<Se3>, DatasetError> {
        let Some(rows) = &self.imu_to_camera else { return Ok(None) };
        let numbers = rows.concat();
        if rows.len() != 4 || numbers.len() != 16 {
            let found = format!("imuToCamera: {} rows, {} numbers", rows.len(), numbers.len());
            return Err(source.malformed(0, found, "4 rows of 4 numbers"));
        }
        let matrix = Matrix4::from_row_slice(&numbers);
        match Se3::from_matrix(&matrix) {
            Some(motion) => Ok(Some(motion)),
            None => Err(DatasetError::NotRigid {
                path: source.path.to_path_buf(),
                key: "imuToCamera".into(),
                found: departure(&matrix),
            }),
        }
    }
}
