//! How a recording is tracked: once, and once more where the first result asks for other settings.

use super::{EarlierMap, MapUse, Tracked, adjusted, dump};
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement};
use std::convert::Infallible;
use std::ops::ControlFlow;
use std::time::Instant;
use vidar_dataset::{CalibrationSource, Recording};
use vidar_odometry::bundle_adjustment::{
    Adjusted, AdjustmentFinding, CalibrationSigmas, IMAGE_SHIFT_RAD, Progress, STAMP_SCATTER_SECS,
};
use vidar_odometry::{ImuUse, Odometry};

/// The stage of the adjustment, in events.
const ADJUSTMENT: &str = "adjustment";

/// What is tracked.
pub(crate) struct TrackingInput<'a> {
    pub dataset: &'a Recording,
    pub config: &'a Config,
    /// The map to look in.
    pub map: Option<&'a EarlierMap>,
}

/// Noise of the gyroscope, as a multiple of the data sheet's, with which images that are shifted by half a degree against it are followed. With 30, 60 and 100
/// six rendered phones began 1 to 13, 1 to 4 and 1 to 2 s after the first image; once they were adjusted, their errors were the same.
const DOUBTED_GYRO_NOISE_FACTOR: f64 = 60.0;

/// Standard deviation of ln(scale) up to which shifted images explain a recording that contradicted itself. Twelve rendered recordings with a stabiliser had 0.003 to 0.04, an
/// accelerometer with the opposite sign 0.20: it wants a path of no length.
const MOST_SCALE_STD: f64 = 0.1;

/// Feeds a recording to the odometry, and adjusts all states after its end where `adjustable` says what may change. Where images and IMU contradict
/// each other, all of it happens once more with images that a stabiliser may shift, and then with a gyroscope that is hardly believed, whose gain may be off. A result stands
/// where its adjustment explains the recording with the noise that the IMU has. Where image stamps scatter, or images are shifted, it happens once more with an odometry that knows.
pub(crate) fn track(
    recording: &TrackingInput<'_>,
    adjustable: Option<&CalibrationSigmas>,
    events: &Events,
    cancel: &CancelToken,
    dump: Option<&mut dump::Dump>,
) -> Result<Tracked, Error> {
    let mut passes = Passes { adjustable, events, cancel, dump, has_tried_shifts: false };
    let mut config = recording.config.clone();
    if adjustable.is_some() {
        // The adjustment tells scattering stamps from stabilised images better than the window does, which is not asked.
        config.odometry.stamp_scatter_ms.get_or_insert(0.0);
        config.odometry.image_shift_deg.get_or_insert(0.0);
    }
    let tracked = passes.calibrated(&TrackingInput { config: &config, ..*recording })?;
    let tracked = passes.with_images_of_their_own(recording, tracked)?;
    if adjustable.is_none() || !tracked.is_contradicted() || cancel.is_cancelled() {
        return Ok(tracked);
    }
    if recording.config.odometry.image_shift_deg.is_none() && !passes.has_tried_shifts {
        let mut config = config.clone();
        config.odometry.image_shift_deg = Some(IMAGE_SHIFT_RAD.to_degrees());
        let again = passes.calibrated(&TrackingInput { config: &config, ..*recording })?;
        if again.explained().is_some_and(|a| a.scale_std < MOST_SCALE_STD) {
            return Ok(again);
        }
    }
    if cancel.is_cancelled() {
        return Ok(tracked);
    }
    let factor = &mut config.odometry.gyro_noise_factor;
    *factor = factor.max(DOUBTED_GYRO_NOISE_FACTOR);
    let again = passes.calibrated(&TrackingInput { config: &config, ..*recording })?;
    Ok(if again.explained().is_some() { again } else { tracked })
}

/// Images that a result may lack and another has: what is at either end depends on the clock that was found.
const AT_THE_ENDS: usize = 5;

/// Whether a result takes the place of an earlier one: it follows as many images, explains the recording as well and knows its scale better. Of five
/// rendered stabilised phones that were tracked by a window that knows of shifts two were worse for it, by factors of 6 and 100, and stated so.
fn is_better(again: &Tracked, first: &Tracked) -> bool {
    let followed = |t: &Tracked| t.adjusted.as_ref().map_or(0, |a| a.images.len());
    let scale_std = |t: &Tracked| t.adjusted.as_ref().map_or(f64::INFINITY, |a| a.scale_std);
    followed(again) + AT_THE_ENDS >= followed(first)
        && again.lost.len() <= first.lost.len()
        && again.explained().is_some() >= first.explained().is_some()
        && scale_std(again) <= scale_std(first)
}

/// A recording and its settings with the calibration that an adjustment found.
fn as_adjusted(adjusted: &Adjusted, dataset: &Recording, config: &Config) -> (Recording, Config) {
    let (mut dataset, mut config) = (dataset.clone(), config.clone());
    adjusted::apply(adjusted, &mut dataset);
    // A global shutter's may come out a little below zero, which no setting is.
    config.odometry.readout_ms = Some(1e3 * adjusted.calibration.readout_secs.max(0.0));
    (dataset, config)
}

/// What every pass over a recording is done with.
struct Passes<'a> {
    /// What an adjustment after the end may change, where one is wanted.
    adjustable: Option<&'a CalibrationSigmas>,
    events: &'a Events,
    cancel: &'a CancelToken,
    /// Holds the last pass.
    dump: Option<&'a mut dump::Dump>,
    /// Whether images were taken to be shifted, with the calibration as it was before all passes.
    has_tried_shifts: bool,
}

impl Passes<'_> {
    /// Feeds a recording to the odometry, and adjusts all states after its end. Where that leaves camera and IMU apart, or the track was lost, and the calibration is the
    /// recording's own, all of it happens once more with the calibration as adjusted.
    fn calibrated(&mut self, recording: &TrackingInput<'_>) -> Result<Tracked, Error> {
        let tracked = self.once(recording)?;
        let TrackingInput { dataset, config, map } = *recording;
        let Some(first) = tracked.adjusted.as_ref().filter(|_| !self.cancel.is_cancelled()) else {
            return Ok(tracked);
        };
        let is_unchecked = input::leaves_calibration_unchecked(dataset, first);
        let is_lost = tracked.is_self_calibrated && !tracked.lost.is_empty() && first.report.is_explained();
        if !is_unchecked && !is_lost {
            return Ok(tracked);
        }
        let focal = |dataset: &Recording| dataset.rig.cameras[dataset.camera.index()].model.intrinsics().fx;
        let before = focal(dataset);
        let (dataset, config) = as_adjusted(first, dataset, config);
        let mut again = self.once(&TrackingInput { dataset: &dataset, config: &config, map })?;
        again.calibrated_again = Some([before, focal(&dataset)]);
        // The σ that a doubtful calibration led to is none to compare with.
        let stands = if is_unchecked { again.adjusted.is_some() } else { is_better(&again, &tracked) };
        Ok(if stands { again } else { tracked })
    }

    /// Where the adjustment finds that image stamps scatter or images are shifted, all of it happens once more with an odometry that knows, and with
    /// the calibration as adjusted where that is the recording's own and explains it. The better result stands.
    fn with_images_of_their_own(
        &mut self,
        recording: &TrackingInput<'_>,
        tracked: Tracked,
    ) -> Result<Tracked, Error> {
        let TrackingInput { dataset, config, map } = *recording;
        let settings = &config.odometry;
        let is_open = [settings.stamp_scatter_ms.is_none(), settings.image_shift_deg.is_none()];
        let finds = |what: fn(&AdjustmentFinding) -> bool| {
            tracked.adjusted.as_ref().is_some_and(|a| a.findings.iter().any(what))
        };
        let scatter = is_open[0] && finds(|f| matches!(f, AdjustmentFinding::StampsScatter { .. }));
        let shifted = is_open[1] && finds(|f| matches!(f, AdjustmentFinding::Shifted { .. }));
        let first = tracked.adjusted.as_ref().filter(|_| scatter || shifted);
        let Some(first) = first.filter(|_| !self.cancel.is_cancelled()) else {
            return Ok(tracked);
        };
        let is_adjusted = tracked.is_self_calibrated && first.report.is_explained();
        self.has_tried_shifts = shifted && !is_adjusted;
        let (dataset, mut config) =
            if is_adjusted { as_adjusted(first, dataset, config) } else { (dataset.clone(), config.clone()) };
        let settings = &mut config.odometry;
        if scatter {
            settings.stamp_scatter_ms = Some(1e3 * STAMP_SCATTER_SECS);
        }
        if shifted {
            settings.image_shift_deg = Some(IMAGE_SHIFT_RAD.to_degrees());
        }
        let mut again = self.once(&TrackingInput { dataset: &dataset, config: &config, map })?;
        again.calibrated_again = tracked.calibrated_again;
        Ok(if is_better(&again, &tracked) { again } else { tracked })
    }

    /// One pass.
    fn once(&mut self, recording: &TrackingInput<'_>) -> Result<Tracked, Error> {
        let Self { adjustable, events, cancel, .. } = *self;
        let total = recording.dataset.images.len();
        let (mut tracked, odometry) = events.stage("odometry", total, || self.push_all(recording))?;
        if let Some(sigmas) = adjustable.filter(|_| tracked.with_imu && !cancel.is_cancelled()) {
            let mut tell = |progress: Progress| {
                events.emit(&Event::Progress {
                    stage: ADJUSTMENT,
                    done: progress.states,
                    total: progress.of,
                });
                if cancel.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            // One that fails took its time, too.
            let Ok(adjusted) =
                events.stage(ADJUSTMENT, 0, || Ok::<_, Infallible>(odometry.adjust_with(sigmas, &mut tell)));
            match adjusted {
                Ok(mut adjusted) if adjusted.is_consistent() => {
                    if let Some(joined) = odometry.place_in_map(&adjusted) {
                        adjusted.join(&joined);
                        tracked.map.iter_mut().for_each(|map| map.matches = Some(joined.matches));
                    }
                    tracked.quality.adjust(&adjusted);
                    tracked.adjusted = Some(adjusted);
                }
                Ok(_) => tracked.not_adjusted = Some("camera and IMU contradict each other".into()),
                Err(reason) => tracked.not_adjusted = Some(reason.to_string()),
            }
        }
        tracked.saved_map = odometry.saved_map(tracked.adjusted.as_ref());
        Ok(tracked)
    }

    fn push_all(&mut self, recording: &TrackingInput<'_>) -> Result<(Tracked, Odometry), Error> {
        let TrackingInput { dataset, config, map } = *recording;
        if let Some(dump) = &mut self.dump {
            dump.begin()?;
        }
        let settings = &config.odometry;
        let mut odometry = Odometry::new(&dataset.rig, dataset.camera, settings)?;
        if let Some(earlier) = map {
            odometry = odometry.with_map(&earlier.map);
        }
        let with_imu = settings.imu != ImuUse::Off && dataset.rig.imu.is_some();
        if self.adjustable.is_some() && with_imu {
            odometry.keep_log();
        }
        let map = map.map(|m| MapUse { file: m.path.clone(), found_live_ns: None, matches: None });
        let is_self_calibrated = dataset.calibration == CalibrationSource::Recording;
        let mut tracked = Tracked { with_imu, is_self_calibrated, map, ..Tracked::default() };
        let total = dataset.images.len();
        let mut spent = 0.0;
        for measurement in input::measurements(dataset, true) {
            if self.cancel.is_cancelled() {
                break;
            }
            let event = match measurement {
                Measurement::Event(event) => event,
                // A broken image is a gap in the stream, not the end of the flight.
                Measurement::Unreadable(_, error) => {
                    tracked.unreadable.push(error.to_string());
                    continue;
                }
                Measurement::Stamp(_) => continue,
            };
            let clock = Instant::now();
            let output = odometry.push(event)?;
            spent += clock.elapsed().as_secs_f64();
            if let Some(output) = output {
                if let Some(dump) = &mut self.dump {
                    dump.add(&output, &odometry.tracks())?;
                }
                tracked.keep(output, std::mem::take(&mut spent));
                let done = tracked.frames.len();
                self.events.emit(&Event::Progress { stage: "odometry", done, total });
            }
        }
        for output in odometry.finish() {
            tracked.keep(output, 0.0);
        }
        tracked.counts = odometry.counts();
        tracked.carrier_share = odometry.carrier_share();
        Ok((tracked, odometry))
    }
}
