//! EuRoC's ASL layout: `mav0/{cam0,imu0,state_groundtruth_estimate0,…}/{data.csv,data/,sensor.yaml}`.
//!
//! `T_BS` of each `sensor.yaml` maps sensor coordinates to the body. VIDAR's body is the IMU, so all sensor poses are
//! converted to be relative to `imu0`, which in EuRoC's own recordings is the body.

use crate::draft::{Draft, DraftCamera, DraftDepth};
use crate::error::{DatasetError, io_error};
use crate::folder::{images_in, names_in};
use crate::location;
use crate::options::{OpenOptions, RecordingKind, TimeUnit, TrajectoryFormat, TrajectoryReadOptions};
use crate::parse::{self, EurocSensor, Source, UnitRule};
use crate::recording::CalibrationSource;
use crate::trajectory_file::{ReadPoses, read_poses};
use std::path::{Path, PathBuf};
use vidar_core::{
    BodyFrame, CameraModel, ImuNoise, LieGroup, Se3, StampedPose, Timestamp, Trajectory, Warning,
};

/// The folder of a detected layout and the camera that the path names.
pub(crate) struct EurocLayout {
    root: PathBuf,
    camera: Option<u32>,
    /// The path is one camera folder without other sensors next to it.
    is_single_camera: bool,
    reason: String,
}

/// Looks for the layout at `path`, in its subfolders and in its parent.
pub(crate) fn detect(path: &Path) -> Option<EurocLayout> {
    let found = |root: &Path, camera, is_single_camera, reason: String| {
        Some(EurocLayout { root: root.to_path_buf(), camera, is_single_camera, reason })
    };
    if is_camera(path) {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let number = camera_number(&name);
        return match path.parent() {
            Some(parent) if number.is_some() && parent.join("imu0").is_dir() => {
                found(parent, number, false, format!("{name} is next to imu0"))
            }
            _ => found(
                path,
                Some(number.unwrap_or(0)),
                true,
                "one camera folder with data.csv or data/".into(),
            ),
        };
    }
    if holds_cameras(path) {
        return found(path, None, false, "folders cam0 … with data.csv".into());
    }
    if holds_cameras(&path.join("mav0")) {
        return found(&path.join("mav0"), None, false, "a folder mav0 with cameras".into());
    }
    let inner: Vec<String> = names_in(path).ok()?;
    let mut holders = inner.iter().filter(|n| holds_cameras(&path.join(n).join("mav0")));
    match (holders.next(), holders.next()) {
        (Some(one), None) => {
            found(&path.join(one).join("mav0"), None, false, format!("its only sequence {one}/mav0"))
        }
        _ => None,
    }
}

fn is_camera(path: &Path) -> bool {
    let has_list = path.join("data.csv").is_file();
    let has_images = path.join("data").is_dir();
    let named = path.file_name().is_some_and(|n| camera_number(&n.to_string_lossy()).is_some());
    has_images && (has_list || named)
}

fn holds_cameras(path: &Path) -> bool {
    path.join("imu0").join("data.csv").is_file() && !camera_numbers(path).is_empty()
        || camera_numbers(path).iter().any(|n| is_camera(&path.join(format!("cam{n}"))))
}

fn camera_number(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("cam")?;
    (!digits.is_empty() && digits.len() < 4 && digits.bytes().all(|b| b.is_ascii_digit()))
        .then(|| digits.parse().ok())
        .flatten()
}

fn camera_numbers(root: &Path) -> Vec<u32> {
    let names = names_in(root).unwrap_or_default();
    names.iter().filter(|n| root.join(n).is_dir()).filter_map(|n| camera_number(n)).collect()
}

/// Reads the layout.
pub(crate) fn open(path: &Path, layout: EurocLayout, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::EurocAsl, &layout.root, layout.reason.clone());
    let body_from_imu = read_imu(&mut draft, options)?;
    read_cameras(&mut draft, path, &layout, &body_from_imu, options)?;
    read_tum_vi_calibration(&mut draft)?;
    read_truth(&mut draft, &body_from_imu)?;
    read_depth(&mut draft, &body_from_imu, options)?;
    draft.reference_cloud = Some(layout.root.join("pointcloud0").join("data.ply")).filter(|p| p.is_file());
    Ok(draft)
}

fn read_sensor(draft: &mut Draft, folder: &Path) -> Result<Option<(EurocSensor, PathBuf)>, DatasetError> {
    let path = folder.join("sensor.yaml");
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = draft.read(&path)?;
    let (sensor, notes) = parse::euroc_sensor_yaml(&Source { path: &path, bytes: &bytes })?;
    draft.warnings.extend(notes);
    Ok(Some((sensor, path)))
}

/// Reads the IMU and returns its pose on EuRoC's body.
fn read_imu(draft: &mut Draft, options: &OpenOptions) -> Result<Se3, DatasetError> {
    let folder = draft.root.join("imu0");
    let list = folder.join("data.csv");
    if !list.is_file() {
        return Ok(Se3::IDENTITY);
    }
    let rule = UnitRule::given_or(options.time_unit, TimeUnit::Nanoseconds);
    let (imu, notes) = parse::imu_file(&list, rule)?;
    draft.text_files.push(list);
    draft.warnings.extend(notes);
    draft.imu = imu;
    let sensor = read_sensor(draft, &folder)?.map(|(s, _)| s);
    draft.imu_noise = sensor.as_ref().and_then(|s| s.imu);
    if draft.imu_noise.is_none() {
        let message = "the IMU's noise densities are not given; those of EuRoC's ADIS16448 are used";
        draft.warnings.push(
            Warning::new("imu-noise", message).at(folder.display()).hint("--calibration imu.yaml (Kalibr)"),
        );
        draft.imu_noise = Some(ImuNoise::EUROC);
    }
    Ok(sensor.and_then(|s| s.body_from_sensor).unwrap_or(Se3::IDENTITY))
}

fn read_cameras(
    draft: &mut Draft,
    path: &Path,
    layout: &EurocLayout,
    body_from_imu: &Se3,
    options: &OpenOptions,
) -> Result<(), DatasetError> {
    let wanted = layout.camera.unwrap_or(options.camera.0);
    let numbers = if layout.is_single_camera { vec![wanted] } else { camera_numbers(&layout.root) };
    if !numbers.contains(&wanted) {
        return Err(DatasetError::MissingCamera {
            path: path.to_path_buf(),
            camera: options.camera,
            found: numbers.iter().map(|n| format!("cam{n}")).collect::<Vec<_>>().join(", "),
        });
    }
    draft.cameras.clear();
    for number in numbers {
        let folder = if layout.is_single_camera {
            layout.root.clone()
        } else {
            layout.root.join(format!("cam{number}"))
        };
        let chosen = number == wanted;
        match read_camera(draft, &folder, number, body_from_imu) {
            Ok(camera) if chosen || camera.model.is_some() => {
                if chosen {
                    draft.chosen = draft.cameras.len();
                    read_images(draft, &folder, options)?;
                }
                draft.cameras.push(camera);
            }
            Ok(_) => {}
            Err(e) if chosen => return Err(e),
            Err(e) => {
                let message = format!("cam{number} is left out of the rig: {e}");
                draft.warnings.push(Warning::new("camera-left-out", message).at(folder.display()));
            }
        }
    }
    if draft.cameras.get(draft.chosen).is_some_and(|c| c.number as usize != draft.chosen) {
        let message = format!(
            "cam{wanted} becomes camera {} of the rig, because cameras with lower numbers are missing",
            draft.chosen
        );
        draft.warnings.push(Warning::new("camera-renumbered", message).at(layout.root.display()));
    }
    Ok(())
}

fn read_camera(
    draft: &mut Draft,
    folder: &Path,
    number: u32,
    body_from_imu: &Se3,
) -> Result<DraftCamera, DatasetError> {
    let mut camera = DraftCamera::unknown(number);
    if let Some((sensor, path)) = read_sensor(draft, folder)? {
        if let Some(calibration) = sensor.camera {
            camera.model = Some(calibration.model);
            camera.time_offset = calibration.time_offset;
            camera.readout = calibration.readout;
            camera.rate_hz = calibration.rate_hz;
            camera.source = CalibrationSource::File(path);
        }
        if let Some(body_from_camera) = sensor.body_from_sensor {
            camera.body_from_camera = body_from_imu.inverse() * body_from_camera;
        }
    }
    Ok(camera)
}

fn read_images(draft: &mut Draft, folder: &Path, options: &OpenOptions) -> Result<(), DatasetError> {
    let list = folder.join("data.csv");
    let data = folder.join("data");
    draft.image_list = list.clone();
    let images = if list.is_file() {
        let bytes = draft.read(&list)?;
        let rule = UnitRule::given_or(options.time_unit, TimeUnit::Nanoseconds);
        let (files, notes) = parse::file_list(&Source { path: &list, bytes: &bytes }, rule)?;
        draft.warnings.extend(notes);
        files.into_iter().map(|f| (f.time, data.join(f.name))).collect()
    } else {
        list_by_names(draft, &data)?
    };
    draft.images = location::files(images);
    Ok(())
}

/// Without a list, the names of the images are their times in nanoseconds.
fn list_by_names(draft: &mut Draft, data: &Path) -> Result<Vec<(Timestamp, PathBuf)>, DatasetError> {
    if !data.is_dir() {
        let missing = std::io::Error::from(std::io::ErrorKind::NotFound);
        return Err(io_error(data)(missing));
    }
    draft.warnings.push(
        Warning::new("list-missing", "no data.csv; times are taken from the names of the images")
            .at(data.display()),
    );
    images_in(data)?
        .into_iter()
        .map(|name| {
            let time = Timestamp::parse_unit(crate::folder::stem(&name), 9).map_err(|_| {
                let (found, expected) = (crate::source::quoted(&name), "a name that is a time in ns".into());
                DatasetError::Malformed { path: data.to_path_buf(), line: 0, found, expected }
            })?;
            Ok((time, data.join(name)))
        })
        .collect()
}

/// TUM-VI: `dso/camchain.yaml` beside `mav0` (Kalibr's) calibrates the camera where its `sensor.yaml` does not.
fn read_tum_vi_calibration(draft: &mut Draft) -> Result<(), DatasetError> {
    let absolute = draft.root.canonicalize().unwrap_or_else(|_| draft.root.clone());
    let Some(folder) = absolute.parent().map(|p| p.join("dso")) else { return Ok(()) };
    let is_known = draft.cameras.get(draft.chosen).is_none_or(|c| c.model.is_some());
    let chain = folder.join("camchain.yaml");
    if !is_known && chain.is_file() {
        draft.apply_calibration(&chain)?;
    }
    let imu = folder.join("imu_config.yaml");
    let states_noise = draft.warnings.iter().all(|w| w.kind != "imu-noise");
    if !states_noise && imu.is_file() {
        draft.apply_calibration(&imu)?;
        draft.warnings.retain(|w| w.kind != "imu-noise");
    }
    Ok(())
}

/// Reference poses, best first: estimated states, mocap, laser tracker.
const TRUTHS: [&str; 4] = ["state_groundtruth_estimate0", "mocap0", "vicon0", "leica0"];

fn read_truth(draft: &mut Draft, body_from_imu: &Se3) -> Result<(), DatasetError> {
    let Some(folder) = TRUTHS.iter().map(|n| draft.root.join(n)).find(|f| f.join("data.csv").is_file())
    else {
        return Ok(());
    };
    let list = folder.join("data.csv");
    let bytes = draft.read(&list)?;
    let options = TrajectoryReadOptions { format: Some(TrajectoryFormat::EurocCsv), ..Default::default() };
    let ReadPoses { trajectory, notes, .. } = read_poses(&Source { path: &list, bytes: &bytes }, &options)?;
    draft.warnings.extend(notes);
    if trajectory.body() != BodyFrame::Imu {
        draft.ground_truth = Some((trajectory, list));
        return Ok(());
    }
    // The file holds poses of its own sensor: world_from_sensor · sensor_from_body · body_from_imu.
    let sensor = read_sensor(draft, &folder)?;
    let body_from_sensor = sensor.and_then(|(s, _)| s.body_from_sensor).unwrap_or(Se3::IDENTITY);
    let sensor_from_imu = body_from_sensor.inverse() * *body_from_imu;
    let moved =
        |p: &StampedPose| StampedPose { time: p.time, world_from_body: p.world_from_body * sensor_from_imu };
    // A product with the identity would still round.
    let trajectory = if sensor_from_imu == Se3::IDENTITY {
        trajectory
    } else {
        Trajectory::new(BodyFrame::Imu, trajectory.poses().iter().map(moved).collect())
            .map_err(|e| DatasetError::NoPoses { path: list.clone(), found: e.to_string() })?
    };
    draft.ground_truth = Some((trajectory, list));
    Ok(())
}

fn read_depth(draft: &mut Draft, body_from_imu: &Se3, options: &OpenOptions) -> Result<(), DatasetError> {
    let folder = draft.root.join("depth0");
    let list = folder.join("data.csv");
    if !list.is_file() {
        return Ok(());
    }
    let bytes = draft.read(&list)?;
    let rule = UnitRule::given_or(options.time_unit, TimeUnit::Nanoseconds);
    let (files, notes) = parse::file_list(&Source { path: &list, bytes: &bytes }, rule)?;
    draft.warnings.extend(notes);
    let data = folder.join("data");
    draft.depths = files.into_iter().map(|f| (f.time, data.join(f.name).into())).collect();
    let sensor = read_sensor(draft, &folder)?.map(|(s, _)| s);
    let model = sensor.as_ref().and_then(|s| s.camera.as_ref()).map(|c| c.model.clone());
    let body_from_depth = sensor.as_ref().and_then(|s| s.body_from_sensor);
    draft.depth = Some(DraftDepth {
        distorted: model.clone().filter(|m| !matches!(m, CameraModel::Pinhole(_))),
        intrinsics: model.map(|m| m.intrinsics().to_owned()).map(|p| [p.fx, p.fy, p.cx, p.cy]),
        units_per_metre: sensor.as_ref().and_then(|s| s.units_per_metre),
        default_units: 1000.0,
        body_from_depth: body_from_depth.map(|b| body_from_imu.inverse() * b),
        invalid: vec![0, u16::MAX],
        is_registered: false,
    });
    Ok(())
}
