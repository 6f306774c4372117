//! The recording that every reader returns.

use crate::error::{DatasetError, io_error};
use crate::events::EventCursor;
use crate::location::{Location, Media, StoredDepth};
use crate::options::RecordingKind;
use std::io::Write;
use std::path::{Path, PathBuf};
use vidar_core::remap::RemapTable;
use vidar_core::{
    CameraId, CameraModel, Duration, FrameId, FrameImage, Image, ImuSample, MetricDepth, Pinhole, Rig, Se3,
    SensorEvent, SpecificForce, Timestamp, Trajectory, Warning,
};

/// One image of the chosen camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageEntry {
    /// Its number in the whole sequence, in the order of time; kept when the sequence is cut or thinned.
    pub frame_id: FrameId,
    /// When it was taken, in the dataset's clock.
    pub time: Timestamp,
    /// Which camera took it.
    pub camera: CameraId,
    /// Where its pixels lie.
    pub location: Location,
}

/// One depth image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DepthEntry {
    /// When it was taken, in the dataset's clock.
    pub time: Timestamp,
    /// Where it lies: a 16-bit grey PNG, or a message of 16-bit numbers or of metres.
    pub location: Location,
}

/// The depth camera.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthSensor {
    /// How its depth projects as [`Recording::load_depth`] returns it, without distortion.
    pub intrinsics: Pinhole,
    /// The camera as its files are, where these are distorted.
    pub distorted: Option<CameraModel>,
    /// Raw units per metre.
    pub units_per_metre: f64,
    /// Maps points in the depth camera to the chosen colour camera.
    pub color_from_depth: Se3,
    /// Raw values that mean "no depth"; 0 always does.
    pub invalid: Vec<u16>,
}

/// One sample of an accelerometer without gyroscope (TUM RGB-D's `accelerometer.txt`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AccelSample {
    /// When.
    pub time: Timestamp,
    /// Specific force, m/s², in the accelerometer's frame.
    pub accel: SpecificForce,
}

/// A metric trajectory given by the user.
#[derive(Clone, Debug, PartialEq)]
pub struct ExternalTrajectory {
    /// The poses.
    pub trajectory: Trajectory,
    /// Their file.
    pub source: PathBuf,
}

/// Where the chosen camera's model comes from.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum CalibrationSource {
    /// A calibration file.
    File(PathBuf),
    /// A topic of the recording, such as ROS's `CameraInfo`.
    Topic(String),
    /// The user's flags.
    Flags,
    /// What is published for this kind of dataset; a warning says so.
    DatasetDefault,
    /// The recording itself: estimated from its images and its gyroscope.
    Recording,
    /// A guess from the size of the images; a warning says so. It must not be used for metric results.
    Guessed,
}

/// A recording, ready to be streamed. Images and depth stay on disk until asked for.
#[derive(Clone, Debug)]
pub struct Recording {
    /// Name for people and for run folders.
    pub name: String,
    /// Its layout.
    pub kind: RecordingKind,
    /// Why this layout was chosen.
    pub reason: String,
    /// The folder that printed paths are relative to.
    pub root: PathBuf,
    /// Cameras and IMU.
    pub rig: Rig,
    /// The camera whose images are listed, an index into the rig.
    pub camera: CameraId,
    /// Where that camera's model comes from.
    pub calibration: CalibrationSource,
    /// Rolling shutter: time from the first to the last row, where the calibration states it.
    pub readout: Option<Duration>,
    /// Images, strictly increasing in time.
    pub images: Vec<ImageEntry>,
    /// IMU samples, strictly increasing in time.
    pub imu: Vec<ImuSample>,
    /// Accelerometer samples without gyroscope, strictly increasing in time.
    pub accelerometer: Vec<AccelSample>,
    /// Depth images, strictly increasing in time.
    pub depths: Vec<DepthEntry>,
    /// The depth camera, where there are depth images.
    pub depth_sensor: Option<DepthSensor>,
    /// Reference poses.
    pub ground_truth: Option<Trajectory>,
    /// The metric trajectory given by the user.
    pub external_trajectory: Option<ExternalTrajectory>,
    /// A reference cloud of the scene (PLY).
    pub reference_cloud: Option<PathBuf>,
    /// Problems that were found.
    pub warnings: Vec<Warning>,
    /// Every text file that was read (lists, calibration, poses).
    pub text_files: Vec<PathBuf>,
    /// Whether image times are invented, because there are none: intervals and rates then mean nothing.
    pub times_are_invented: bool,
    /// The open recording that images lie in.
    pub(crate) media: Media,
}

/// An image and the depth image nearest in time count as one moment when no further apart than this: the
/// association tolerance that the TUM RGB-D tools use.
pub const DEPTH_TOLERANCE: Duration = Duration::from_millis(20);

impl Recording {
    /// Reads the pixels of an image; its size must be its camera's.
    pub fn load_image(&self, entry: &ImageEntry) -> Result<FrameImage, DatasetError> {
        self.media.image_of_size(&entry.location, self.size_of(entry))
    }

    /// Columns and rows that an image must have: its camera's.
    pub(crate) fn size_of(&self, entry: &ImageEntry) -> Option<(usize, usize)> {
        self.rig.camera(entry.camera).map(|camera| (camera.model.width(), camera.model.height()))
    }

    /// Reads a depth image as z-depth in metres, NaN where there is none, in the depth camera's pixels; distortion
    /// is taken out.
    pub fn load_depth(&self, entry: &DepthEntry) -> Result<MetricDepth, DatasetError> {
        let raw = self.media.depth(&entry.location)?;
        let Some(sensor) = &self.depth_sensor else {
            return Err(DatasetError::BadImage {
                path: entry.location.place(),
                reason: "the dataset has no depth camera to interpret it with".into(),
            });
        };
        let expected = (sensor.intrinsics.width, sensor.intrinsics.height);
        check_size(&entry.location, raw.size(), expected)?;
        let metres = match raw {
            StoredDepth::Units(raw) => sensor.to_metres(&raw),
            // ROS marks what is too near or too far by infinities, other writers by zero.
            StoredDepth::Metres(raw) => raw.map(|&m| if m.is_finite() && m > 0.0 { m } else { f32::NAN }),
        };
        Ok(MetricDepth::new(sensor.rectified(metres)))
    }

    /// The depth image of the moment `time`: the nearest within [`DEPTH_TOLERANCE`].
    pub fn depth_for(&self, time: Timestamp) -> Option<&DepthEntry> {
        let after = self.depths.partition_point(|d| d.time < time);
        [after.checked_sub(1), Some(after)]
            .into_iter()
            .flatten()
            .filter_map(|i| self.depths.get(i))
            .min_by_key(|d| (d.time - time).abs())
            .filter(|d| (d.time - time).abs() <= DEPTH_TOLERANCE)
    }

    /// All sensors in the order of time, images decoded ahead of their turn ([`Recording::images_ahead`]).
    ///
    /// At equal times: IMU, ground truth, depth, image; so that everything with an image's time is known when the image arrives.
    pub fn events(&self) -> impl Iterator<Item = Result<SensorEvent, DatasetError>> + '_ {
        let (mut cursor, mut images) = (EventCursor::default(), self.images_ahead(self.images.iter()));
        std::iter::from_fn(move || {
            let pixels =
                |entry: &ImageEntry| images.next().map_or_else(|| self.load_image(entry), |(_, image)| image);
            self.event_after(&mut cursor, pixels)
        })
    }

    /// Writes the bytes to hash for a fingerprint of the dataset: name and size of every image and depth image, and every byte
    /// of every text file that was read; of bags and videos name and size, and every IMU sample. Two datasets with equal
    /// fingerprints give the same data, but for images of equal size in files of equal size.
    pub fn write_fingerprint(&self, out: &mut dyn Write) -> Result<(), DatasetError> {
        let say = |out: &mut dyn Write, text: String, path: &Path| {
            out.write_all(text.as_bytes()).map_err(io_error(path))
        };
        say(out, format!("vidar-dataset 1 {} camera {}\n", self.kind, self.camera), &self.root)?;
        let media = self.media.fingerprint()?;
        if !media.is_empty() {
            say(out, media, &self.root)?;
            for s in &self.imu {
                let [w, a] = [s.gyro.0, s.accel.0];
                say(
                    out,
                    format!("{} {} {} {} {} {} {}\n", s.time, w.x, w.y, w.z, a.x, a.y, a.z),
                    &self.root,
                )?;
            }
        }
        let images = self.images.iter().map(|e| (e.time, &e.location));
        let depths = self.depths.iter().map(|e| (e.time, &e.location));
        for (time, location) in images.chain(depths) {
            let line = match location {
                Location::File(path) => {
                    let size = std::fs::metadata(path).map_err(io_error(path))?.len();
                    format!("{} {size} {time}\n", self.relative(path))
                }
                Location::Message { topic, number, .. } => format!("{topic} {number} {time}\n"),
                Location::Frame { number, .. } => format!("frame {number} {time}\n"),
            };
            say(out, line, &self.root)?;
        }
        for path in &self.text_files {
            let mut file = std::fs::File::open(path).map_err(io_error(path))?;
            let size = file.metadata().map_err(io_error(path))?.len();
            say(out, format!("{} {size}\n", self.relative(path)), path)?;
            std::io::copy(&mut file, out).map_err(io_error(path))?;
        }
        Ok(())
    }

    /// The path as printed: relative to the root if it lies inside.
    pub fn relative(&self, path: &Path) -> String {
        path.strip_prefix(&self.root).unwrap_or(path).display().to_string()
    }
}

impl DepthSensor {
    /// The same depth without distortion. Takes the nearest pixel, because depths must not be mixed across an edge. The
    /// z-depth of a ray does not change, so values are copied.
    fn rectified(&self, metres: Image<f32>) -> Image<f32> {
        match &self.distorted {
            Some(model) => RemapTable::new(model, &self.intrinsics).apply_nearest(&metres, f32::NAN),
            None => metres,
        }
    }

    /// Raw values as metres, NaN where invalid.
    pub fn to_metres(&self, raw: &Image<u16>) -> Image<f32> {
        let metres_per_unit = 1.0 / self.units_per_metre;
        raw.map(|&value| {
            if value == 0 || self.invalid.contains(&value) {
                f32::NAN
            } else {
                (f64::from(value) * metres_per_unit) as f32
            }
        })
    }
}

pub(crate) fn check_size(
    location: &Location,
    found: (usize, usize),
    expected: (usize, usize),
) -> Result<(), DatasetError> {
    if found == expected {
        return Ok(());
    }
    Err(DatasetError::WrongImageSize {
        path: location.place(),
        found_width: found.0,
        found_height: found.1,
        expected_width: expected.0,
        expected_height: expected.1,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::camera::RadTan;

    #[test]
    fn distortion_of_a_depth_camera_is_removed() {
        let intrinsics = Pinhole::new(110.0, 110.0, 79.5, 51.5, 160, 104).unwrap();
        let model = CameraModel::RadTan(RadTan::new(intrinsics, [-0.28, 0.07, 2e-4, 1.8e-5]).unwrap());
        let depth_along = |ray: &nalgebra::Vector3<f64>| 2.0 + ray.x + 0.5 * ray.y;
        let as_stored = Image::from_fn(160, 104, |x, y| {
            let ray = model.unproject(&nalgebra::Vector2::new(x as f64, y as f64));
            ray.map_or(f32::NAN, |ray| depth_along(&(ray / ray.z)) as f32)
        });
        let sensor = |distorted| DepthSensor {
            intrinsics,
            distorted,
            units_per_metre: 1000.0,
            color_from_depth: Se3::IDENTITY,
            invalid: vec![0],
        };
        let worst = |image: &Image<f32>| {
            let error = |x: usize, y: usize| {
                f64::from(image[(x, y)]) - depth_along(&intrinsics.ray(x as f64, y as f64))
            };
            let pixels = (0..104).flat_map(|y| (0..160).map(move |x| (x, y)));
            pixels.map(|(x, y)| error(x, y).abs()).filter(|e| !e.is_nan()).fold(0.0, f64::max)
        };
        // Half a stored pixel, which the lens stretches up to 1.8 times in the corners, along both slopes.
        let bound = 0.5 * 1.8 * (1.0 + 0.5) / 110.0;
        let found = worst(&sensor(Some(model)).rectified(as_stored.clone()));
        assert!(found < bound, "{found} < {bound}");
        assert!(worst(&sensor(None).rectified(as_stored)) > 0.05, "without the model the corners are wrong");
    }
}
