//! The camera of a bag: `CameraInfo`, and what VIDAR's own conversions leave beside it.

use crate::convert::facts::{self, Facts};
use crate::draft::Draft;
use crate::error::DatasetError;
use crate::recording::CalibrationSource;
use crate::topics::Choice;
use nalgebra::{Matrix3, Vector3};
use vidar_bag::{Bag, CameraInfo, Message, Role, Topic, role_of};
use vidar_core::camera::{Equidistant, RadTan};
use vidar_core::{CameraModel, LieGroup, Pinhole, Se3, So3, Warning};

/// Takes the camera's model from the topic of calibrations that belongs to the images.
pub(crate) fn read_calibration(
    draft: &mut Draft,
    bag: &Bag,
    choice: &Choice<'_>,
    camera_frame: &str,
) -> Result<(), DatasetError> {
    let infos: Vec<&Topic> = bag
        .topics()
        .iter()
        .filter(|t| !t.messages.is_empty() && role_of(&t.message_type, t.encoding) == Some(Role::CameraInfo))
        .collect();
    let beside = |t: &&&Topic| is_beside(&choice.image.name, &t.name);
    let same_frame = |t: &&&Topic| {
        let header = t.messages.first().and_then(|m| bag.header(m).ok());
        header.is_some_and(|h| !h.frame.is_empty() && h.frame == camera_frame)
    };
    let Some(topic) = infos.iter().find(beside).or_else(|| infos.iter().find(same_frame)) else {
        return Ok(());
    };
    let Some(Message::CameraInfo(info)) = topic.messages.first().map(|m| bag.read(m)).transpose()? else {
        return Ok(());
    };
    if info.k[0] == 0.0 {
        let message = format!("{} states no calibration (its K is zero); it is not used", topic.name);
        draft.warnings.push(Warning::new("calibration-empty", message).at(bag.path().display()));
        return Ok(());
    }
    let is_rectified = choice.image.name.contains("rect");
    let camera = &mut draft.cameras[0];
    camera.model = Some(model_of(&info, is_rectified, bag, topic)?);
    camera.source = CalibrationSource::Topic(topic.name.clone());
    if is_rectified && let Some(rotation) = So3::from_matrix(&Matrix3::from_row_slice(&info.r)) {
        // The rectified camera is the camera turned by R; completed with the mount by `read_extrinsics`.
        camera.body_from_camera = Se3::new(rotation.inverse(), Vector3::zeros());
    }
    Ok(())
}

/// Completes the camera with what `CameraInfo` has no fields for.
pub(crate) fn use_facts(draft: &mut Draft, facts: &Facts) {
    let camera = &mut draft.cameras[0];
    if let Some(model) = &facts.model {
        camera.model = Some(model.clone());
        camera.source = CalibrationSource::Topic(format!("metadata {}", facts::NAME));
    }
    camera.time_offset = facts.time_offset.unwrap_or(camera.time_offset);
    camera.readout = facts.readout;
    camera.rate_hz = facts.rate_hz;
}

/// Whether a topic of calibrations lies beside a topic of images: the same name but for its last part (two for `/compressed`).
pub(crate) fn is_beside(image: &str, info: &str) -> bool {
    let Some((folder, _)) = info.rsplit_once('/') else { return false };
    let mut parent = image.rsplit_once('/').map(|(p, _)| p);
    for _ in 0..2 {
        if parent == Some(folder) {
            return true;
        }
        parent = parent.and_then(|p| p.rsplit_once('/')).map(|(p, _)| p);
    }
    false
}

/// The model that a calibration of ROS states (`image_geometry`; REP 104).
fn model_of(
    info: &CameraInfo,
    is_rectified: bool,
    bag: &Bag,
    topic: &Topic,
) -> Result<CameraModel, DatasetError> {
    let (path, key) = (bag.path(), topic.name.as_str());
    let bad = |source| DatasetError::BadCamera { path: path.to_path_buf(), key: key.into(), source };
    let unsupported = |found: String| DatasetError::UnsupportedCamera {
        path: path.to_path_buf(),
        key: key.into(),
        found,
        expected: "plumb_bob, rational_polynomial with k4 = k5 = k6 = 0, equidistant",
    };
    let (width, height) = (info.width as usize, info.height as usize);
    let [fx, fy, cx, cy] = match is_rectified {
        true => [info.p[0], info.p[5], info.p[2], info.p[6]],
        false => [info.k[0], info.k[4], info.k[2], info.k[5]],
    };
    let pinhole = Pinhole::new(fx, fy, cx, cy, width, height).map_err(bad)?;
    let at = |i: usize| info.distortion.get(i).copied().unwrap_or(0.0);
    if is_rectified || info.distortion.iter().all(|&d| d == 0.0) {
        return Ok(CameraModel::Pinhole(pinhole));
    }
    match info.distortion_model.to_ascii_lowercase().as_str() {
        "plumb_bob" | "radtan" | "rational_polynomial" | "" => {
            if (5..info.distortion.len()).any(|i| at(i) != 0.0) {
                return Err(unsupported(format!(
                    "{} with {} coefficients",
                    info.distortion_model,
                    info.distortion.len()
                )));
            }
            let coefficients = [at(0), at(1), at(2), at(3)];
            RadTan::with_k3(pinhole, coefficients, at(4)).map(CameraModel::RadTan).map_err(bad)
        }
        "equidistant" | "fisheye" | "kannala_brandt" | "kannala_brandt4" => {
            let coefficients = [at(0), at(1), at(2), at(3)];
            Equidistant::new(pinhole, coefficients).map(CameraModel::Equidistant).map_err(bad)
        }
        other => Err(unsupported(vidar_core::printable(other).to_string())),
    }
}
