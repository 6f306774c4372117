//! Completes the output of a reader to a consistent dataset: calibration, order, sizes, cuts, external trajectory.

mod calibration;
mod depth;

use crate::assemble::{cut, guessed_model, keep_existing, keep_one_size, name_of};
use crate::camera_flag::with_size;
use crate::checks::{self, IMAGE_GAP_FLOOR};
use crate::error::DatasetError;
use crate::location::{Location, Media};
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::Source;
use crate::recording::{CalibrationSource, ExternalTrajectory, ImageEntry, Recording};
use crate::rig_checks;
use crate::trajectory_file::{self, ReadPoses};
use crate::tum_rgbd;
use nalgebra::Vector3;
use std::path::{Path, PathBuf};
use vidar_core::{
    BodyFrame, CameraId, CameraModel, Duration, FrameId, ImuNoise, ImuSample, Rig, RigCamera, Se3, So3,
    StampedPose, Timestamp, Trajectory, Warning,
};

/// The warning that the camera's mount is an assumption of the reader.
pub(crate) const ASSUMED_MOUNT: &str = "extrinsics-assumed";

/// A camera of the dataset whose calibration is not complete yet.
pub(crate) struct DraftCamera {
    /// N of `camN`.
    pub number: u32,
    /// The model; size 0×0 = that of the images.
    pub model: Option<CameraModel>,
    pub source: CalibrationSource,
    pub body_from_camera: Se3,
    pub time_offset: Duration,
    pub readout: Option<Duration>,
    pub rate_hz: Option<f64>,
}

impl DraftCamera {
    pub(crate) fn unknown(number: u32) -> Self {
        Self {
            number,
            model: None,
            source: CalibrationSource::Guessed,
            body_from_camera: Se3::IDENTITY,
            time_offset: Duration::ZERO,
            readout: None,
            rate_hz: None,
        }
    }
}

/// The depth camera, as a reader found it.
pub(crate) struct DraftDepth {
    pub intrinsics: Option<[f64; 4]>,
    /// The depth camera with its distortion, if the dataset has one.
    pub distorted: Option<CameraModel>,
    pub units_per_metre: Option<f64>,
    /// Raw units of this kind of dataset, used when no file states them.
    pub default_units: f64,
    pub body_from_depth: Option<Se3>,
    pub invalid: Vec<u16>,
    /// Whether depth is registered to the colour camera.
    pub is_registered: bool,
}

/// The output of a reader.
pub(crate) struct Draft {
    pub kind: RecordingKind,
    pub reason: String,
    pub root: PathBuf,
    pub cameras: Vec<DraftCamera>,
    /// Which of `cameras` the images are of.
    pub chosen: usize,
    /// The file or folder that lists the images.
    pub image_list: PathBuf,
    pub images: Vec<(Timestamp, Location)>,
    pub imu: Vec<ImuSample>,
    pub imu_noise: Option<ImuNoise>,
    pub accelerometer: Vec<crate::recording::AccelSample>,
    pub depths: Vec<(Timestamp, Location)>,
    pub depth: Option<DraftDepth>,
    pub ground_truth: Option<(Trajectory, PathBuf)>,
    /// A metric trajectory inside the recording that the user names.
    pub trajectory: Option<(Trajectory, PathBuf)>,
    pub reference_cloud: Option<PathBuf>,
    pub warnings: Vec<Warning>,
    pub text_files: Vec<PathBuf>,
    /// Image times are made from frame numbers.
    pub times_are_invented: bool,
    /// The open recording that images lie in.
    pub media: Media,
}

impl Draft {
    pub(crate) fn new(kind: RecordingKind, root: &Path, reason: String) -> Self {
        Self {
            kind,
            reason,
            root: root.to_path_buf(),
            cameras: vec![DraftCamera::unknown(0)],
            chosen: 0,
            image_list: root.to_path_buf(),
            images: Vec::new(),
            imu: Vec::new(),
            imu_noise: None,
            accelerometer: Vec::new(),
            depths: Vec::new(),
            depth: None,
            ground_truth: None,
            trajectory: None,
            reference_cloud: None,
            warnings: Vec::new(),
            text_files: Vec::new(),
            times_are_invented: false,
            media: Media::default(),
        }
    }

    /// Reads a text file and lists it among the files of the dataset.
    pub(crate) fn read(&mut self, path: &Path) -> Result<Vec<u8>, DatasetError> {
        let bytes = crate::source::read_text_file(path)?;
        self.text_files.push(path.to_path_buf());
        Ok(bytes)
    }

    /// Uses EuRoC's noise densities at the samples' rate for an IMU of which `what` states none.
    pub(crate) fn assume_imu_noise(&mut self, what: &str, rate_hz: f64, place: &str) {
        let message =
            format!("{what} states no noise densities of its IMU; those of EuRoC's ADIS16448 are used");
        let warning = Warning::new("imu-noise", message).at(place);
        self.warnings.push(warning.hint("--calibration imu.yaml (Kalibr)"));
        self.imu_noise = Some(ImuNoise { rate_hz, ..ImuNoise::EUROC });
    }

    /// Uses the mount `body_from_camera` that is usual for cameras of this kind, at the IMU's position, until a calibration gives another.
    pub(crate) fn assume_mount(&mut self, body_from_camera: So3, message: &str) {
        if let Some(camera) = self.cameras.get_mut(self.chosen) {
            camera.body_from_camera = Se3::new(body_from_camera, Vector3::zeros());
        }
        let warning = Warning::new(ASSUMED_MOUNT, message).at(self.root.display());
        self.warnings.push(warning.hint("`vidar calibrate` finds the rotation; --calibration FILE gives it"));
    }

    /// Completes the dataset. The order of the steps follows their dependencies.
    pub(crate) fn finish(mut self, options: &OpenOptions) -> Result<Recording, DatasetError> {
        for path in &options.calibration {
            self.apply_calibration(path)?;
        }
        let mut images = self.complete_images()?;
        self.complete_model(options, &mut images)?;
        self.report_unread_calibrations();
        let chosen = CameraId(self.chosen as u32);
        let mut dataset = Recording {
            name: name_of(&self.root),
            kind: self.kind,
            reason: self.reason.clone(),
            root: self.root.clone(),
            calibration: self.cameras[self.chosen].source.clone(),
            rig: self.rig(),
            camera: chosen,
            readout: self.cameras[self.chosen].readout,
            images,
            imu: std::mem::take(&mut self.imu),
            accelerometer: std::mem::take(&mut self.accelerometer),
            depths: Vec::new(),
            depth_sensor: None,
            ground_truth: None,
            external_trajectory: None,
            reference_cloud: self.reference_cloud.take(),
            warnings: std::mem::take(&mut self.warnings),
            text_files: std::mem::take(&mut self.text_files),
            times_are_invented: self.times_are_invented,
            media: self.media.clone(),
        };
        let root = self.root.clone();
        let notes = &mut dataset.warnings;
        checks::put_in_order(&mut dataset.imu, |s| s.time, "IMU samples", &root, notes);
        if !dataset.imu.is_empty() {
            checks::check_imu(&dataset.imu, &root, notes);
            checks::check_imu_coverage(&dataset.images, &dataset.imu, &root, notes);
        }
        let place = match &dataset.calibration {
            CalibrationSource::File(path) => path,
            _ => &root,
        };
        rig_checks::check_rig(&dataset.rig, self.chosen, &dataset.imu, place, notes);
        checks::put_in_order(&mut dataset.accelerometer, |s| s.time, "accelerometer samples", &root, notes);
        let norms: Vec<_> = dataset.accelerometer.iter().map(|s| (s.time, s.accel.0.norm())).collect();
        checks::check_gravity(&norms, &root, notes);
        self.complete_depth(options, &mut dataset)?;
        self.read_external_trajectory(options, &mut dataset)?;
        let range = image_range(&dataset.images);
        if let Some((truth, place)) = self.ground_truth.take() {
            checks::check_overlap(range, &truth, "ground truth", &place, &mut dataset.warnings);
            dataset.ground_truth = Some(truth);
        }
        cut(&mut dataset, options)?;
        Ok(dataset)
    }

    /// Existing images in the order of time, numbered.
    fn complete_images(&mut self) -> Result<Vec<ImageEntry>, DatasetError> {
        let listed = self.images.len();
        let list = self.image_list.clone();
        let mut images = std::mem::take(&mut self.images);
        keep_existing(&mut images, "images", &list, &mut self.warnings)?;
        if images.is_empty() {
            let found = format!("{listed} files listed, none of them exists with content");
            let expected = "to read (PNG or JPEG)".to_string();
            return Err(DatasetError::NoImages { path: list, found, expected });
        }
        checks::put_in_order(&mut images, |i| i.0, "images", &list, &mut self.warnings);
        let times = images.iter().map(|i| i.0);
        checks::find_gaps(times, IMAGE_GAP_FLOOR, "image-gap", "the images", &list, &mut self.warnings);
        let camera = CameraId(self.chosen as u32);
        let numbered = images.into_iter().enumerate();
        Ok(numbered
            .map(|(i, (time, location))| ImageEntry { frame_id: FrameId(i as u32), time, camera, location })
            .collect())
    }

    /// The chosen camera's model at the size of its images.
    fn complete_model(
        &mut self,
        options: &OpenOptions,
        images: &mut Vec<ImageEntry>,
    ) -> Result<(), DatasetError> {
        let size = keep_one_size(images, &self.media, &self.image_list, &mut self.warnings)?;
        let Some(first) = images.first() else { return Ok(()) };
        let camera = &mut self.cameras[self.chosen];
        if let Some(model) = &options.camera_model {
            (camera.model, camera.source) = (Some(model.clone()), CalibrationSource::Flags);
        }
        let model = match camera.model.take() {
            Some(model) => model,
            None => {
                let (model, source, warning) = tum_rgbd::published_model(&self.root, self.kind, size)
                    .map_or_else(|| guessed_model(size, first.location.path()), Ok)?;
                self.warnings.push(warning);
                camera.source = source;
                model
            }
        };
        let place = match &camera.source {
            CalibrationSource::File(path) => path.clone(),
            CalibrationSource::Flags => PathBuf::from("--camera-model"),
            _ => self.root.clone(),
        };
        let model = if model.width() == 0 {
            let key = "size of the first image".to_string();
            with_size(&model, size.0, size.1).map_err(|source| DatasetError::BadCamera {
                path: place.clone(),
                key,
                source,
            })?
        } else {
            model
        };
        if (model.width(), model.height()) != size {
            return Err(DatasetError::WrongImageSize {
                path: first.location.place(),
                found_width: size.0,
                found_height: size.1,
                expected_width: model.width(),
                expected_height: model.height(),
            });
        }
        camera.model = Some(model);
        Ok(())
    }

    /// The rig of all cameras whose model is known; the caller checked that the chosen one's is.
    fn rig(&mut self) -> Rig {
        let mut rig = Rig { cameras: Vec::new(), imu: self.imu_noise };
        for camera in &self.cameras {
            // A camera without model or size cannot project; only the chosen one must have both.
            let fallback = || self.cameras[self.chosen].model.clone();
            if let Some(model) = camera.model.clone().or_else(fallback) {
                rig.cameras.push(RigCamera {
                    model,
                    body_from_camera: camera.body_from_camera,
                    time_offset: camera.time_offset,
                    rate_hz: camera.rate_hz,
                });
            }
        }
        rig
    }

    fn read_external_trajectory(
        &mut self,
        options: &OpenOptions,
        dataset: &mut Recording,
    ) -> Result<(), DatasetError> {
        let Some(path) = &options.trajectory else {
            if let Some((trajectory, source)) = self.trajectory.take() {
                let range = image_range(&dataset.images);
                checks::check_overlap(range, &trajectory, "trajectory", &source, &mut dataset.warnings);
                dataset.external_trajectory = Some(ExternalTrajectory { trajectory, source });
            }
            return Ok(());
        };
        let bytes = crate::source::read_text_file(path)?;
        let read = crate::TrajectoryReadOptions {
            format: options.trajectory_format,
            body: options.trajectory_body,
            time_unit: None,
            times: Some(dataset.images.iter().map(|i| i.time).collect()),
        };
        let mut found = trajectory_file::read_poses(&Source { path, bytes: &bytes }, &read)?;
        dataset.warnings.append(&mut found.notes);
        let trajectory = with_known_body(found, path, dataset)?;
        checks::check_overlap(
            image_range(&dataset.images),
            &trajectory,
            "trajectory",
            path,
            &mut dataset.warnings,
        );
        dataset.external_trajectory = Some(ExternalTrajectory { trajectory, source: path.clone() });
        dataset.text_files.push(path.clone());
        Ok(())
    }
}

/// Without an IMU there is no IMU frame: poses that a format calls the IMU's are then the chosen camera's.
fn with_known_body(
    found: ReadPoses,
    path: &Path,
    dataset: &mut Recording,
) -> Result<Trajectory, DatasetError> {
    if !found.body_is_assumed {
        return Ok(found.trajectory);
    }
    let has_imu = !dataset.imu.is_empty() || dataset.rig.imu.is_some();
    let body = match found.trajectory.body() {
        BodyFrame::Imu if !has_imu => BodyFrame::Camera(dataset.camera),
        known => known,
    };
    dataset.warnings.push(trajectory_file::assumed_body(body, path));
    let poses: Vec<StampedPose> = found.trajectory.poses().to_vec();
    Trajectory::new(body, poses)
        .map_err(|e| DatasetError::NoPoses { path: path.to_path_buf(), found: e.to_string() })
}

pub(crate) fn image_range(images: &[ImageEntry]) -> Option<(Timestamp, Timestamp)> {
    Some((images.first()?.time, images.last()?.time))
}
