//! Calibration of a recording from the recording itself: `vidar calibrate`, and what `odometry` and `run` do where there is
//! no calibration.

mod look;
mod missing;
mod report;
mod yaml;

pub(crate) use look::of_given_camera;
pub use missing::MissingCalibration;

use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::imu_noise::believed_noise;
use std::path::{Path, PathBuf};
use vidar_core::{CameraModel, Duration, ImuNoise, Pinhole, RigCamera, Se3, Warning};
use vidar_dataset::{CalibrationSource, OpenOptions, Recording};
use vidar_odometry::OdometryConfig;
use vidar_odometry::bundle_adjustment::{IMAGE_SHIFT_RAD, ImagePrior};
use vidar_odometry::calibration::{Calibration, SensorNoise, sensor_noise};

/// The stage's name in events.
pub(crate) const STAGE: &str = "calibrate";

/// Clock offsets that are known better than this are kept by the odometry, s: a rendered slow phone, found within 0.1 ms,
/// was lost when the odometry corrected it by 10 ms from a few seconds.
const SETTLED_OFFSET_SECS: f64 = 0.0015;
/// Largest relative σ of the focal length and σ of the clock offset of a calibration that is used without being asked for. Eleven
/// rendered recordings of 20 s had 0.3 to 0.5 % and 0.1 to 0.7 ms. The odometry looks for the clock itself within 150 ms; one that went round a room had 62.
const MAX_FOCAL_SIGMA: f64 = 0.04;
const MAX_CLOCK_SIGMA_MS: f64 = 100.0;
/// Largest σ of a found mount that is used with a given lens, rad: the other choice is that the camera's axes are the IMU's, of which nobody said anything (a
/// stabilised phone at 10 Hz whose mount was found to 7° never began with that).
const MAX_ROTATION_SIGMA: f64 = 0.15;
/// A given value that is this many standard deviations from what was found is contradicted.
pub(crate) const CONTRADICTING_SIGMAS: f64 = 3.0;

/// Warnings of reading that complain of values which nobody gave.
const OF_A_GUESS: [&str; 6] = [
    "intrinsics-guessed",
    "imu-noise",
    "imu-noise-from-samples",
    "extrinsics-identity",
    ASSUMED_MOUNT,
    "imu-rate",
];
/// The warning of readers that know how cameras of a kind are mounted.
const ASSUMED_MOUNT: &str = "extrinsics-assumed";

/// What to calibrate.
#[derive(Clone, Debug)]
pub struct CalibrateRequest {
    /// The recording.
    pub path: PathBuf,
    /// How to read it.
    pub open: OpenOptions,
    /// Where the calibration is written, if anywhere.
    pub output: Option<PathBuf>,
}

/// What was found, beside what the recording states.
#[derive(Clone, Debug)]
pub struct CalibrateOutcome {
    /// Name of the recording.
    pub name: String,
    /// Camera, clock and mount.
    pub calibration: Calibration,
    /// Noise of the sensors as the data show it.
    pub noise: Option<SensorNoise>,
    /// What the recording's own files state; `None` where the camera is only guessed from the images' size.
    pub stated: Option<Stated>,
    /// Noise that the recording's files state.
    pub stated_noise: Option<ImuNoise>,
    /// Columns and rows.
    pub size: (usize, usize),
    /// The file that was written.
    pub file: Option<PathBuf>,
    /// Warnings of reading.
    pub warnings: Vec<Warning>,
}

/// A given calibration.
#[derive(Clone, Debug)]
pub struct Stated {
    /// How the camera projects.
    pub model: CameraModel,
    /// Its pose on the body.
    pub body_from_camera: Se3,
    /// `t_imu = t_camera + time_offset`.
    pub time_offset: Duration,
}

/// Calibrates a recording and writes what was found.
///
/// # Errors
/// The recording cannot be read, it does not show its calibration, or the file cannot be written.
pub fn calibrate(
    request: &CalibrateRequest,
    events: &Events,
    cancel: &CancelToken,
) -> Result<CalibrateOutcome, Error> {
    let dataset = events.stage("read", 0, || vidar_dataset::open(&request.path, &request.open))?;
    let calibration = look::everything(&dataset, events, cancel)?;
    let camera = dataset.rig.camera(dataset.camera);
    let is_stated = dataset.calibration != CalibrationSource::Guessed;
    let stated = camera.filter(|_| is_stated).map(|c| Stated {
        model: c.model.clone(),
        body_from_camera: c.body_from_camera,
        time_offset: c.time_offset,
    });
    // The reader of EuRoC's layout takes EuRoC's own where no file gives any, and says so.
    let is_assumed =
        dataset.rig.imu == Some(ImuNoise::EUROC) && dataset.warnings.iter().any(|w| w.kind == "imu-noise");
    let mut outcome = CalibrateOutcome {
        name: dataset.name.clone(),
        size: size_of(&dataset),
        noise: sensor_noise(&dataset.imu),
        calibration,
        stated,
        stated_noise: dataset.rig.imu.filter(|_| !is_assumed),
        file: None,
        warnings: dataset.warnings.clone(),
    };
    if outcome.stated.is_none() {
        outcome.warnings.retain(|w| !OF_A_GUESS.contains(&w.kind.as_str()));
    }
    if let Some(path) = &request.output {
        write(path, &outcome.to_yaml())?;
        outcome.file = Some(path.clone());
    }
    Ok(outcome)
}

fn write(path: &Path, text: &str) -> Result<(), Error> {
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| Error::io("create", folder, e))?;
    }
    std::fs::write(path, text).map_err(|e| Error::io("write", path, e))
}

/// Whether nothing says how the camera is mounted on the IMU: a lens is given (by flags, or a file with intrinsics alone), and the
/// readers took the IMU's own pose for it, or the usual one of such cameras.
pub(crate) fn has_no_mount(dataset: &Recording) -> bool {
    dataset.calibration != CalibrationSource::Guessed
        && !dataset.imu.is_empty()
        && (dataset.rig.camera(dataset.camera).is_some_and(RigCamera::has_no_mount)
            || look::assumed_mount(dataset).is_some())
}

/// Whether a lens is given by its focal length and principal point alone: nobody measured it.
pub(crate) fn is_plain(dataset: &Recording) -> bool {
    dataset.rig.camera(dataset.camera).is_some_and(|camera| camera.model.is_undistorted())
}

/// Whether what is found of the lens takes the place of a given one without distortion, which the recording contradicts: by its focal length or by the
/// distortion that it shows.
fn replaces(found: &Calibration, given: &CameraModel) -> bool {
    if vague_focal(found).is_some() {
        return false;
    }
    let focal = found.focal_px;
    let is_other = |shown: f64, sigma: f64| shown.abs() > CONTRADICTING_SIGMAS * sigma;
    is_other(focal.value - given.intrinsics().fx, focal.sigma)
        || found.radial.iter().any(|k| k.is_observable && is_other(k.value, k.sigma))
}

/// For a plan, which tracks nothing: the recording as if [`complete`] had found what is missing, with the values that were read or
/// guessed. Says what is missing.
pub(crate) fn assume_complete(dataset: &mut Recording) -> Option<MissingCalibration> {
    let missing = MissingCalibration::of(dataset)?;
    dataset.rig.imu.get_or_insert_with(|| believed_noise(None));
    dataset.calibration = CalibrationSource::Recording;
    Some(missing)
}

/// Where `dataset` has a gyroscope but no calibration, or a lens whose place on the IMU nothing tells: finds what is missing, puts it into
/// the rig, and says so. The settings of the odometry follow from what is known then. A given lens stays unless it is a plain pinhole that
/// the recording contradicts; where a recording does not show the mount, what was read stays.
///
/// # Errors
/// The recording does not show its calibration, and none was given.
pub(crate) fn complete(
    dataset: &mut Recording,
    settings: &mut OdometryConfig,
    events: &Events,
    cancel: &CancelToken,
) -> Result<ImagePrior, Error> {
    let nothing = ImagePrior::default();
    let Some(missing) = MissingCalibration::of(dataset) else { return Ok(nothing) };
    let has_lens = missing == MissingCalibration::Mount;
    let found = match look::what_is_missing(missing, dataset, events, cancel) {
        Err(Error::NotCalibrated { .. }) if has_lens => return Ok(nothing),
        found => found?,
    };
    match too_uncertain(&found, has_lens) {
        Some(_) if has_lens => return Ok(nothing),
        Some(reason) => return Err(Error::NotCalibrated { name: dataset.name.clone(), reason }),
        None => {}
    }
    let size = size_of(dataset);
    let is_noise_given = has_lens && !dataset.warnings.iter().any(|w| w.kind == "imu-noise");
    let noise = dataset.rig.imu.filter(|_| is_noise_given);
    let noise = noise.unwrap_or_else(|| believed_noise(sensor_noise(&dataset.imu)));
    let model = model_of(&found, size)?;
    let is_lens_plain = is_plain(dataset);
    let Some(camera) = dataset.rig.cameras.get_mut(dataset.camera.index()) else { return Ok(nothing) };
    if !has_lens || is_lens_plain && replaces(&found, &camera.model) {
        camera.model = model;
    }
    camera.body_from_camera = Se3::new(found.body_from_camera, nalgebra::Vector3::zeros());
    camera.time_offset = Duration::from_secs_f64(found.time_offset_secs.value);
    if found.readout_secs.is_observable {
        settings.readout_ms = settings.readout_ms.or(Some(used_readout_ms(&found)));
        // Half a minute shows the clock better than the odometry's last seconds do.
        settings.estimate_time_offset &= found.time_offset_secs.sigma > SETTLED_OFFSET_SECS;
        settings.align_timing &= found.time_offset_secs.sigma > look::MOST_CLOCK_SIGMA_SECS;
    }
    // The lever arm is not known at all (six rendered recordings: 0.009 to 0.074 m of error without,
    // 0.011 to 0.054 m with it estimated).
    settings.estimate_extrinsics = true;
    dataset.rig.imu = Some(noise);
    dataset.calibration = CalibrationSource::Recording;
    // What these said is no longer so.
    dataset.warnings.retain(|w| !OF_A_GUESS.contains(&w.kind.as_str()));
    dataset.warnings.push(
        Warning::new("calibrated-from-recording", report::sentence(&found, has_lens))
            .hint("`vidar calibrate` writes it to a file; --calibration FILE gives a better one"),
    );
    Ok(image_prior(&found, settings))
}

/// Images that a calibration finds shifted by more than this (root mean square, rad) are known to be: it finds 0.008 to 0.014 in rendered stabilised phones, and 0.0045 where stamps scatter.
const STABILISED_RAD: f64 = 0.006;

/// What a calibration found of the images, where `settings` leave that open.
pub(crate) fn image_prior(found: &Calibration, settings: &OdometryConfig) -> ImagePrior {
    let is_open = settings.image_shift_deg.is_none();
    let is_shifted = is_open && found.image_shift_rad.is_some_and(|shift| shift > STABILISED_RAD);
    ImagePrior { shift: is_shifted.then_some(IMAGE_SHIFT_RAD), ..ImagePrior::default() }
}

/// What calibrating `dataset` gives, as a sentence; the error is why it gives nothing that would be used unasked.
pub(crate) fn found_in_words(
    dataset: &Recording,
    events: &Events,
    cancel: &CancelToken,
) -> Result<String, String> {
    let missing = MissingCalibration::of(dataset).unwrap_or(MissingCalibration::Camera);
    let found = look::what_is_missing(missing, dataset, events, cancel).map_err(|e| e.to_string())?;
    let has_lens = missing == MissingCalibration::Mount;
    match too_uncertain(&found, has_lens) {
        Some(reason) => {
            Err(format!("{}; too uncertain to be used unasked: {reason}", report::values(&found)))
        }
        None => Ok(report::values(&found)),
    }
}

fn size_of(dataset: &Recording) -> (usize, usize) {
    dataset.rig.camera(dataset.camera).map_or((0, 0), |c| (c.model.width(), c.model.height()))
}

/// The camera that was found.
pub(crate) fn model_of(found: &Calibration, (width, height): (usize, usize)) -> Result<CameraModel, Error> {
    let f = found.focal_px.value;
    let [cx, cy] = found.centre_px.map(|c| c.value);
    let pinhole = Pinhole::new(f, f, cx, cy, width, height)?;
    Ok(found.lens.camera(pinhole, found.radial.map(|k| k.value))?)
}

/// Why a calibration that was found is too uncertain to be used without being asked for: rotation and focal length (unless a lens is given) not known
/// well enough for tracks and gyroscope to agree within a few pixels, or the clock not within a tenth of a second's motion.
fn too_uncertain(found: &Calibration, has_lens: bool) -> Option<String> {
    let clock_ms = 1e3 * found.time_offset_secs.sigma;
    let is_mount_shown =
        found.rotation_is_observable || has_lens && found.rotation_sigma() < MAX_ROTATION_SIGMA;
    if !is_mount_shown {
        Some("the camera turns too little to show how it is mounted on the IMU".into())
    } else if let Some(vague) = vague_focal(found).filter(|_| !has_lens) {
        Some(vague)
    } else {
        let is_vague = clock_ms > MAX_CLOCK_SIGMA_MS;
        is_vague.then(|| format!("its clock offset is shown to {clock_ms:.0} ms only"))
    }
}

/// That the focal length is not known well enough to be used, in words.
fn vague_focal(found: &Calibration) -> Option<String> {
    let share = found.focal_px.sigma / found.focal_px.value;
    let is_vague = !found.focal_px.is_observable || share > MAX_FOCAL_SIGMA;
    is_vague.then(|| format!("its focal length is shown to {:.0} % only", 100.0 * share))
}

/// A readout that is not there within three standard deviations and below 4 ms is a global shutter's.
pub(crate) fn used_readout_ms(found: &Calibration) -> f64 {
    let readout = found.readout_secs;
    let is_global = readout.value < (3.0 * readout.sigma).min(0.004);
    if is_global { 0.0 } else { 1e3 * readout.value.clamp(0.0, 0.05) }
}
