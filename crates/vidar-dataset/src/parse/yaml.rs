//! Calibration files: EuRoC `sensor.yaml` and Kalibr's camchain and imu YAML.
//!
//! OpenCV's dialect (`%YAML:1.0`, `!!opencv-matrix`) is converted to plain YAML before parsing. Documents are parsed
//! into a small tree, so that an error names the key and its value.

mod node;

use crate::calibration::{departure, model_from_parts};
use crate::error::DatasetError;
use crate::source::Source;
use nalgebra::Matrix4;
use node::Node;
use vidar_core::{CameraModel, Duration, ImuNoise, LieGroup, Se3, Warning};

/// A calibration file has a few kilobytes; a megabyte is something else.
pub const MAX_YAML_BYTES: usize = 1 << 20;
/// Longest readout of a rolling shutter that is believed, s.
const MAX_READOUT_SECS: f64 = 0.1;

/// A document with the lines of its keys, for messages.
struct Document<'a> {
    source: Source<'a>,
    text: String,
    root: Node,
}

impl<'a> Document<'a> {
    fn parse(source: &Source<'a>, notes: &mut Vec<Warning>) -> Result<Self, DatasetError> {
        if source.bytes.len() > MAX_YAML_BYTES {
            let found = format!("{} bytes", source.bytes.len());
            return Err(source.malformed(0, found, format!("at most {MAX_YAML_BYTES} bytes of YAML")));
        }
        let text = plain_yaml(source.text(notes)?);
        let root: Node = serde_saphyr::from_str(&text).map_err(|e| {
            let line = e.location().map_or(0, |l| l.line() as usize);
            let reason = e.without_snippet().to_string();
            let reason: String = reason.lines().next().unwrap_or_default().chars().take(200).collect();
            source.malformed(line, reason, "YAML")
        })?;
        match root {
            Node::Map(_) => Ok(Self { source: *source, text, root }),
            other => Err(source.malformed(1, other.description(), "YAML keys and values")),
        }
    }

    /// The first line that begins with this key.
    fn line_of(&self, key: &str) -> usize {
        let starts =
            |l: &str| l.trim_start().strip_prefix(key).is_some_and(|rest| rest.trim_start().starts_with(':'));
        self.text.lines().position(starts).map_or(0, |i| i + 1)
    }

    fn wrong(&self, key: &str, found: &str, expected: &str) -> DatasetError {
        self.source.malformed(self.line_of(key), format!("{key}: {found}"), expected)
    }

    fn number(&self, map: &Node, key: &str) -> Result<Option<f64>, DatasetError> {
        match map.get(key) {
            None => Ok(None),
            Some(Node::Number(v)) if v.is_finite() => Ok(Some(*v)),
            Some(other) => Err(self.wrong(key, &other.description(), "a finite number")),
        }
    }

    fn text(&self, map: &Node, key: &str) -> Result<Option<String>, DatasetError> {
        match map.get(key) {
            None => Ok(None),
            Some(Node::Text(t)) => Ok(Some(t.trim().to_ascii_lowercase())),
            Some(other) => Err(self.wrong(key, &other.description(), "a word")),
        }
    }

    fn numbers(&self, node: &Node, key: &str) -> Result<Vec<f64>, DatasetError> {
        let Node::List(list) = node else {
            return Err(self.wrong(key, &node.description(), "a list of numbers"));
        };
        list.iter()
            .map(|n| match n {
                Node::Number(v) => Ok(*v),
                other => Err(self.wrong(key, &other.description(), "a number in the list")),
            })
            .collect()
    }

    fn list(&self, map: &Node, key: &str) -> Result<Option<Vec<f64>>, DatasetError> {
        map.get(key).map(|n| self.numbers(n, key)).transpose()
    }

    /// A rigid motion: a list of rows (Kalibr) or `data` with 16 numbers (EuRoC).
    fn motion(&self, map: &Node, key: &str) -> Result<Option<Se3>, DatasetError> {
        let Some(node) = map.get(key) else { return Ok(None) };
        let numbers = match node.get("data").unwrap_or(node) {
            Node::List(rows) if rows.iter().any(|r| matches!(r, Node::List(_))) => {
                let rows: Vec<_> = rows.iter().map(|r| self.numbers(r, key)).collect::<Result<_, _>>()?;
                rows.concat()
            }
            flat => self.numbers(flat, key)?,
        };
        if numbers.len() != 16 {
            return Err(self.wrong(key, &format!("{} numbers", numbers.len()), "16 numbers of a 4x4 matrix"));
        }
        let m = Matrix4::from_row_iterator(numbers);
        let last_row = [m[(3, 0)], m[(3, 1)], m[(3, 2)], m[(3, 3)] - 1.0];
        let is_affine = last_row.iter().all(|v| v.abs() < 1e-6);
        match Se3::from_matrix(&m) {
            Some(motion) if is_affine => Ok(Some(motion)),
            _ => Err(DatasetError::NotRigid {
                path: self.source.path.to_path_buf(),
                key: format!("{key} (line {})", self.line_of(key)),
                found: departure(&m),
            }),
        }
    }

    /// Kalibr's `T_cam_imu`, or OpenVINS' `T_imu_cam`, its inverse; both only when they agree.
    fn camera_from_imu(&self, map: &Node) -> Result<Option<Se3>, DatasetError> {
        let kalibr = self.motion(map, "T_cam_imu")?;
        let open_vins = self.motion(map, "T_imu_cam")?.map(|m| m.inverse());
        if let (Some(one), Some(other)) = (kalibr, open_vins) {
            let apart = (one.inverse() * other).log();
            if !(apart.amax() < 1e-3) {
                let found =
                    format!("a transform that differs by {:.3} from the inverse of T_cam_imu", apart.amax());
                return Err(self.wrong("T_imu_cam", &found, "the inverse of T_cam_imu, or only one of them"));
            }
        }
        Ok(kalibr.or(open_vins))
    }

    fn resolution(&self, map: &Node) -> Result<Option<(usize, usize)>, DatasetError> {
        let Some(list) = self.list(map, "resolution")? else { return Ok(None) };
        match list[..] {
            [w, h] if (1.0..=65535.0).contains(&w) && (1.0..=65535.0).contains(&h) => {
                Ok(Some((w as usize, h as usize)))
            }
            _ => Err(self.wrong("resolution", &format!("{list:?}"), "[columns, rows], each 1 to 65535")),
        }
    }

    fn noise(&self, map: &Node) -> Result<Option<ImuNoise>, DatasetError> {
        let n = |key| self.number(map, key);
        let (Some(gyro_noise_density), Some(accel_noise_density)) =
            (n("gyroscope_noise_density")?, n("accelerometer_noise_density")?)
        else {
            return Ok(None);
        };
        let positive = |key: &str, v: Option<f64>, default: f64| match v {
            Some(v) if v < 0.0 => Err(self.wrong(key, &format!("{v}"), "zero or more")),
            other => Ok(other.unwrap_or(default)),
        };
        Ok(Some(ImuNoise {
            gyro_noise_density: positive("gyroscope_noise_density", Some(gyro_noise_density), 0.0)?,
            gyro_random_walk: positive("gyroscope_random_walk", n("gyroscope_random_walk")?, 0.0)?,
            accel_noise_density: positive("accelerometer_noise_density", Some(accel_noise_density), 0.0)?,
            accel_random_walk: positive("accelerometer_random_walk", n("accelerometer_random_walk")?, 0.0)?,
            rate_hz: match n("rate_hz")? {
                Some(v) => v,
                None => n("update_rate")?.unwrap_or(200.0),
            },
        }))
    }

    fn camera(&self, map: &Node, name: &str) -> Result<Option<CameraCalibration>, DatasetError> {
        let Some(camera_model) = self.text(map, "camera_model")? else { return Ok(None) };
        let distortion_model = self.text(map, "distortion_model")?.unwrap_or_else(|| "none".into());
        let intrinsics = self
            .list(map, "intrinsics")?
            .ok_or_else(|| self.wrong("intrinsics", "nothing", "a list of numbers"))?;
        let distortion = match self.list(map, "distortion_coefficients")? {
            Some(d) => d,
            None => self.list(map, "distortion_coeffs")?.unwrap_or_default(),
        };
        let size = self.resolution(map)?;
        let key = format!("{name}{camera_model}-{distortion_model}");
        let model = model_from_parts(
            self.source.path,
            &key,
            (&camera_model, &distortion_model),
            &intrinsics,
            &distortion,
            size,
        )?;
        let shift = self.number(map, "timeshift_cam_imu")?;
        let shift = shift.map_or(Duration::ZERO, Duration::from_secs_f64);
        let readout = match self.number(map, "readout_secs")? {
            Some(secs) if !(0.0..=MAX_READOUT_SECS).contains(&secs) => {
                return Err(self.wrong("readout_secs", &secs.to_string(), "0 to 0.1 s"));
            }
            secs => secs.map(Duration::from_secs_f64),
        };
        let rate_hz = self.number(map, "rate_hz")?;
        Ok(Some(CameraCalibration { model, rate_hz, time_offset: shift, readout }))
    }
}

/// Converts OpenCV's dialect to plain YAML, line by line.
fn plain_yaml(text: &str) -> String {
    let mut out = String::with_capacity(text.len() + 1);
    for line in text.lines() {
        if !line.starts_with('%') {
            out.push_str(&line.replace("!!opencv-matrix", ""));
        }
        out.push('\n');
    }
    out
}

/// A camera of a calibration file. Size 0×0 when the file has no resolution.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraCalibration {
    /// How it projects.
    pub model: CameraModel,
    /// Nominal rate, Hz.
    pub rate_hz: Option<f64>,
    /// `t_imu = t_camera + time_offset`.
    pub time_offset: Duration,
    /// Rolling shutter: time from the first to the last row (`readout_secs`, an addition to Kalibr's keys).
    pub readout: Option<Duration>,
}

/// An IMU of a calibration file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuCalibration {
    /// Its noise.
    pub noise: ImuNoise,
}

/// An EuRoC `sensor.yaml`.
#[derive(Clone, Debug, PartialEq)]
pub struct EurocSensor {
    /// `T_BS`: maps sensor coordinates to the body; `None` when absent.
    pub body_from_sensor: Option<Se3>,
    /// The camera, when it is one.
    pub camera: Option<CameraCalibration>,
    /// The noise, when it is an IMU.
    pub imu: Option<ImuNoise>,
    /// Raw units per metre, when it is a depth camera.
    pub units_per_metre: Option<f64>,
}

/// Reads an EuRoC `sensor.yaml` (with or without its `%YAML:1.0` header).
pub fn euroc_sensor_yaml(source: &Source<'_>) -> Result<(EurocSensor, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let doc = Document::parse(source, &mut notes)?;
    let units_per_metre = doc.number(&doc.root, "units_per_metre")?;
    if let Some(units) = units_per_metre
        && !(units > 0.0)
    {
        return Err(doc.wrong("units_per_metre", &units.to_string(), "a positive number"));
    }
    let sensor = EurocSensor {
        body_from_sensor: doc.motion(&doc.root, "T_BS")?,
        camera: doc.camera(&doc.root, "")?,
        imu: doc.noise(&doc.root)?,
        units_per_metre,
    };
    Ok((sensor, notes))
}

/// One camera of a Kalibr camchain.
#[derive(Clone, Debug, PartialEq)]
pub struct KalibrCamera {
    /// N of `camN`.
    pub number: u32,
    /// The camera.
    pub calibration: CameraCalibration,
    /// `T_cam_imu`, the inverse of `T_imu_cam` (OpenVINS), or composed from `T_cn_cnm1`: maps IMU coordinates to the camera.
    pub camera_from_imu: Option<Se3>,
}

/// What a Kalibr file holds; either part may be empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KalibrFile {
    /// Cameras in the order of their numbers.
    pub cameras: Vec<KalibrCamera>,
    /// The first IMU.
    pub imu: Option<ImuCalibration>,
}

/// Reads a Kalibr camchain (`cam0:`, `cam1:`, …) or imu YAML (`imu0:` or its keys at the top).
pub fn kalibr_yaml(source: &Source<'_>) -> Result<(KalibrFile, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let doc = Document::parse(source, &mut notes)?;
    let mut file = KalibrFile::default();
    let Node::Map(entries) = &doc.root else { return Ok((file, notes)) };
    let mut numbered: Vec<(u32, &String, &Node)> = entries
        .iter()
        .filter_map(|(key, node)| Some((key.strip_prefix("cam")?.parse().ok()?, key, node)))
        .collect();
    numbered.sort_by_key(|(number, ..)| *number);
    let mut previous: Option<(u32, Option<Se3>)> = None;
    for (number, key, node) in numbered {
        let Some(calibration) = doc.camera(node, &format!("{key}: "))? else {
            return Err(doc.wrong(key, &node.description(), "a camera with camera_model and intrinsics"));
        };
        let chained = match (doc.motion(node, "T_cn_cnm1")?, previous) {
            (Some(camera_from_previous), Some((n, Some(previous_from_imu)))) if n + 1 == number => {
                Some(camera_from_previous * previous_from_imu)
            }
            _ => None,
        };
        let camera_from_imu = doc.camera_from_imu(node)?.or(chained);
        previous = Some((number, camera_from_imu));
        file.cameras.push(KalibrCamera { number, calibration, camera_from_imu });
    }
    let imu_map = entries.iter().find(|(k, _)| k == "imu0").map_or(&doc.root, |(_, node)| node);
    file.imu = doc.noise(imu_map)?.map(|noise| ImuCalibration { noise });
    if file.cameras.is_empty() && file.imu.is_none() {
        let keys: Vec<&str> = entries.iter().take(8).map(|(k, _)| k.as_str()).collect();
        let expected = if entries.iter().any(|(k, _)| k.starts_with("relative_config_")) {
            "the files that relative_config_imucam and relative_config_imu name"
        } else {
            "cam0: …, or imu0: / gyroscope_noise_density and accelerometer_noise_density"
        };
        return Err(source.malformed(1, format!("the keys {}", keys.join(", ")), expected));
    }
    Ok((file, notes))
}
