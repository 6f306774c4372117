//! Calibration files that a recording is given, and those beside it that are not read.

use super::{ASSUMED_MOUNT, Draft};
use crate::error::DatasetError;
use crate::parse::{self, Source};
use crate::recording::CalibrationSource;
use crate::source::read_file_up_to;
use std::path::Path;
use vidar_core::{Se3, Warning};

impl Draft {
    /// Names the files next to the images that look like a calibration and are not read.
    pub(super) fn report_unread_calibrations(&mut self) {
        for name in crate::folder::names_in(&self.root).unwrap_or_default() {
            let path = self.root.join(&name);
            if self.text_files.contains(&path) || !looks_like_calibration(&name) || !path.is_file() {
                continue;
            }
            self.warnings.push(
                Warning::new("calibration-ignored", format!("{name} looks like a calibration and is not read"))
                    .at(path.display())
                    .hint(
                        "--calibration FILE reads EuRoC's and Kalibr's yaml; --camera-model pinhole:fx,fy,cx,cy gives \
                         the values",
                    ),
            );
        }
    }

    /// Applies a calibration file, EuRoC's or Kalibr's.
    pub(crate) fn apply_calibration(&mut self, path: &Path) -> Result<(), DatasetError> {
        let bytes = read_file_up_to(path, parse::yaml::MAX_YAML_BYTES as u64)?;
        self.text_files.push(path.to_path_buf());
        let source = Source { path, bytes: &bytes };
        let (sensor, notes) = parse::euroc_sensor_yaml(&source)?;
        let is_euroc = sensor.camera.is_some() || sensor.imu.is_some() || sensor.body_from_sensor.is_some();
        if is_euroc {
            self.warnings.extend(notes);
            if sensor.imu.is_some() {
                self.imu_noise = sensor.imu;
            }
            if let Some(calibration) = sensor.camera {
                self.use_calibration(self.chosen, calibration, sensor.body_from_sensor, path);
            }
            return Ok(());
        }
        let (file, notes) = parse::kalibr_yaml(&source)?;
        self.warnings.extend(notes);
        if let Some(imu) = file.imu {
            self.imu_noise = Some(imu.noise);
        }
        let single = file.cameras.len() == 1 && self.cameras.len() == 1;
        for camera in file.cameras {
            let index = self.cameras.iter().position(|c| c.number == camera.number || single);
            let body_from_camera = camera.camera_from_imu.map(|m| vidar_core::LieGroup::inverse(&m));
            if let Some(index) = index {
                self.use_calibration(index, camera.calibration, body_from_camera, path);
            }
        }
        Ok(())
    }

    fn use_calibration(
        &mut self,
        index: usize,
        calibration: parse::CameraCalibration,
        body_from_camera: Option<Se3>,
        path: &Path,
    ) {
        let camera = &mut self.cameras[index];
        if body_from_camera.is_none() && !self.imu.is_empty() {
            self.warnings.push(
                Warning::new(
                    "extrinsics-missing",
                    format!("no extrinsics of cam{}; {}", camera.number, "the earlier ones are kept"),
                )
                .at(path.display())
                .hint("Kalibr writes T_cam_imu after its camera-imu calibration"),
            );
        }
        camera.model = Some(calibration.model);
        camera.time_offset = calibration.time_offset;
        camera.readout = calibration.readout;
        camera.rate_hz = calibration.rate_hz.or(camera.rate_hz);
        if let Some(given) = body_from_camera {
            camera.body_from_camera = given;
            // A reader's assumption holds no more.
            self.warnings.retain(|w| w.kind != ASSUMED_MOUNT);
        }
        camera.source = CalibrationSource::File(path.to_path_buf());
    }
}

/// Names under which programs write calibrations.
fn looks_like_calibration(name: &str) -> bool {
    let lower = name.to_ascii_lowercase();
    let words = ["calib", "intrinsic", "camchain", "camera", "extrinsic"];
    let endings = [".txt", ".yaml", ".yml", ".json", ".xml", ".ini"];
    words.iter().any(|w| lower.contains(w)) && endings.iter().any(|e| lower.ends_with(e))
}
