//! Track: calibration, timing and poses of a recording from its own camera and IMU, before it is mapped. The result is kept in the
//! run folder until the map is made, so that a run that was killed does not track twice.

use super::scene::SceneWriter;
use crate::calibrate;
use crate::camera_timing::{self, Settled};
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input;
use crate::odometry::{self, EarlierMap, TrackedPoses, TrackingInput, adjusted, map};
use crate::run_folder::{OutputLocation, RunFolder};
use crate::system::read_up_to;
use serde::{Deserialize, Serialize};
use vidar_core::{Rig, Warning};
use vidar_dataset::{CalibrationSource, Recording};
use vidar_odometry::OdometryConfig;
use vidar_odometry::bundle_adjustment::{CalibrationSigmas, ImagePrior};

/// Where the result lies in the run folder: CBOR (RFC 8949) of [`Kept`].
pub(super) const FILE: &str = "odometry/tracked.cbor";
/// Largest result that is read, bytes; an hour of keyframes with 200 landmarks each takes some 100 MiB.
const MAX_BYTES: u64 = 1 << 30;

/// What is known of rig and settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Calibrated {
    rig: Rig,
    source: CalibrationSource,
    settings: OdometryConfig,
    warnings: Vec<Warning>,
}

impl Calibrated {
    fn of(dataset: &Recording, config: &Config) -> Self {
        Self {
            rig: dataset.rig.clone(),
            source: dataset.calibration.clone(),
            settings: config.odometry.clone(),
            warnings: dataset.warnings.clone(),
        }
    }

    fn apply(&self, dataset: &mut Recording, config: &mut Config) {
        dataset.rig = self.rig.clone();
        dataset.calibration = self.source.clone();
        dataset.warnings = self.warnings.clone();
        config.odometry = self.settings.clone();
    }
}

/// The result of an earlier attempt.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Kept {
    /// What it was made of; another key means another result.
    key: String,
    /// After [`Tracking::calibrate`], and after everything.
    calibrated: Calibrated,
    tracked: Calibrated,
    timing: Option<Warning>,
    poses: TrackedPoses,
}

/// The stage, in two steps: the run is planned between them.
pub(super) struct Tracking {
    key: String,
    /// What the adjustment may change; none where the states of the live odometry are mapped as they come.
    sigmas: Option<CalibrationSigmas>,
    calibrated: Option<Calibrated>,
    kept: Option<Kept>,
    map: Option<EarlierMap>,
}

impl Tracking {
    /// `dataset` and `config` as the user gave them; `place` may hold the result of an earlier attempt.
    ///
    /// # Errors
    /// The map of an earlier recording cannot be read.
    pub fn new(
        dataset: &Recording,
        fingerprint: &str,
        config: &Config,
        place: &OutputLocation,
    ) -> Result<Self, Error> {
        let map = EarlierMap::of(config)?;
        let map_sha256 = map.as_ref().map(|m| &m.sha256);
        let settings =
            serde_json::json!({ "version": crate::VERSION, "odometry": config.odometry, "map": map_sha256 });
        let key = format!("{fingerprint} {:?} {settings}", dataset.rig);
        let key = vidar_hub::sha256_hex(key.as_bytes());
        let kept = place.resumed().and_then(|folder| read(&folder.join(FILE), &key));
        Ok(Self { sigmas: adjusted::adjustable(dataset, config), calibrated: None, kept, key, map })
    }

    /// Calibrates a recording that has no calibration.
    pub fn calibrate(
        &mut self,
        dataset: &mut Recording,
        config: &mut Config,
        events: &Events,
        cancel: &CancelToken,
    ) -> Result<(), Error> {
        match &self.kept {
            Some(kept) => kept.calibrated.apply(dataset, config),
            None if !input::needs_calibration(config) => {}
            None => {
                let images = calibrate::complete(dataset, &mut config.odometry, events, cancel)?;
                self.knows(images);
            }
        }
        self.calibrated = Some(Calibrated::of(dataset, config));
        Ok(())
    }

    /// Settles the camera's timing and tracks; none where the engine is to track while it maps.
    pub fn track(
        mut self,
        dataset: &mut Recording,
        config: &mut Config,
        folder: &RunFolder,
        scene: Option<&SceneWriter>,
        events: &Events,
        cancel: &CancelToken,
    ) -> Result<Option<TrackedPoses>, Error> {
        if let Some(kept) = self.kept {
            kept.tracked.apply(dataset, config);
            kept.timing.iter().for_each(|w| events.warn(w));
            let text = "poses of an earlier attempt at this run are used";
            events.warn(&Warning::new("odometry-resumed", text).at(FILE));
            if let Ok(file) = std::fs::metadata(folder.path().join(map::FILE)) {
                events.emit(&Event::ArtifactWritten { path: map::FILE.into(), bytes: file.len() });
            }
            return Ok(Some(kept.poses));
        }
        let Settled { warning: timing, images } = events
            .stage(camera_timing::STAGE, 0, || camera_timing::settle(dataset, config, events, cancel))?;
        timing.iter().for_each(|w| events.warn(w));
        self.knows(images);
        let Some(sigmas) = &self.sigmas else { return Ok(None) };
        let recording = TrackingInput { dataset, config, map: self.map.as_ref() };
        let tracked = odometry::track(&recording, Some(sigmas), events, cancel, None)?;
        if let Some(scene) = scene {
            scene.tracked(&tracked.frames, events);
        }
        if let Some((name, bytes)) = map::write(folder, &tracked.saved_map)? {
            events.emit(&Event::ArtifactWritten { path: name.into(), bytes });
        }
        let poses = TrackedPoses::new(&tracked, &dataset.rig, dataset.camera);
        if let Some(adjusted) = &tracked.adjusted {
            adjusted::apply(adjusted, dataset);
            config.odometry.readout_ms = Some(1e3 * adjusted::shown_readout_secs(&adjusted.calibration));
        }
        if let (Some(calibrated), false) = (self.calibrated, cancel.is_cancelled()) {
            let after = Calibrated::of(dataset, config);
            let kept = Kept { key: self.key, calibrated, tracked: after, timing, poses };
            write(folder, &kept)?;
            return Ok(Some(kept.poses));
        }
        Ok(Some(poses))
    }

    /// What was found of the images before tracking.
    fn knows(&mut self, images: ImagePrior) {
        self.sigmas.iter_mut().for_each(|sigmas| sigmas.images = sigmas.images.or(images));
    }
}

/// The result in a file, if it was made of what `key` stands for. One that a power cut left half written is as good as none.
fn read(path: &std::path::Path, key: &str) -> Option<Kept> {
    let bytes = read_up_to(path, MAX_BYTES).ok()?;
    let kept: Kept = ciborium::from_reader(bytes.as_slice()).ok()?;
    (kept.key == key).then_some(kept)
}

fn write(folder: &RunFolder, kept: &Kept) -> Result<(), Error> {
    let mut bytes = Vec::new();
    ciborium::into_writer(kept, &mut bytes)
        .map_err(|e| Error::io("write", &folder.path().join(FILE), std::io::Error::other(e.to_string())))?;
    folder.write(FILE, &bytes).map(|_| ())
}

/// Removes the result: the map is made.
pub(super) fn forget(folder: &RunFolder) {
    let path = folder.path().join(FILE);
    // What cannot be removed is only left behind, and so is a folder with other files.
    let _ = std::fs::remove_file(&path);
    let _ = path.parent().map(std::fs::remove_dir);
}
