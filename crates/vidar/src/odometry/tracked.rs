//! What the odometry made of a recording: every image's state, spans without one, and what is warned of.

use super::map::MapUse;
use super::{NEVER_STARTED, adjusted};
use crate::input::UnseenScale;
use crate::quality::{TrackQuality, carrier_in_view};
use crate::verdict::{ScaleSource, StatedScale};
use std::collections::{BTreeMap, BTreeSet};
use vidar_core::{BodyFrame, FrameId, OdometryKeyframe, RevisedPose, StampedPose, Trajectory, Warning};
use vidar_odometry::bundle_adjustment::Adjusted;
use vidar_odometry::{InputCounts, Joined, OdometryOutput, SavedMap, Status};

/// Fewest images that are worth a result of their own: half a second at 20 Hz.
const MIN_APART_IMAGES: usize = 10;

/// One image as the odometry left it.
#[derive(Clone, Debug)]
pub struct TrackedFrame {
    /// The output for it; landmarks, keyframe and revisions are kept elsewhere.
    pub output: OdometryOutput,
    /// Wall time that it took, s, decoding left out.
    pub seconds: f64,
}

/// A span of images without a state, after there had been one.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct LostSpan {
    /// First image of the span, ns.
    pub from_ns: i64,
    /// First image with a state again, ns; `None` when there was none.
    pub until_ns: Option<i64>,
    /// Why the state was given up.
    pub reason: String,
    /// Image at which the place was found again, ns: the states after the span are in the world of those before it. `None` where it was not.
    pub found_again_ns: Option<i64>,
}

/// Images whose live states are in another world than the final ones.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct ApartSpan {
    /// Its segment.
    pub segment: u32,
    /// First image, ns.
    pub from_ns: i64,
    /// Last image, ns.
    pub until_ns: i64,
    /// Images with a state.
    pub images: usize,
}

/// All outputs of the odometry on a recording.
#[derive(Clone, Debug, Default)]
pub struct Tracked {
    /// Every image, in order.
    pub frames: Vec<TrackedFrame>,
    /// Keyframes with their last poses.
    pub keyframes: Vec<OdometryKeyframe>,
    /// Spans without a state.
    pub lost: Vec<LostSpan>,
    /// What was taken and left out.
    pub counts: InputCounts,
    /// Share of the image that moves with the camera.
    pub carrier_share: f64,
    /// Errors of images that could not be read; they are skipped.
    pub unreadable: Vec<String>,
    /// Whether the calibration is what the recording itself showed.
    pub is_self_calibrated: bool,
    /// Whether camera and IMU were used together; else the trajectory is known up to scale.
    pub with_imu: bool,
    /// Health, coverage and scale over the whole recording.
    pub quality: TrackQuality,
    /// All states adjusted together after the end, where that was asked for and camera and IMU agree in it.
    pub adjusted: Option<Adjusted>,
    /// Why there are none.
    pub not_adjusted: Option<String>,
    /// Focal length (pixels) that the recording's own calibration gave and the one that the adjustment found, where all was tracked again with it.
    pub calibrated_again: Option<[f64; 2]>,
    /// How the map of an earlier recording served, where one was given.
    pub map: Option<MapUse>,
    /// The map for a later one.
    pub saved_map: SavedMap,
}

impl Tracked {
    pub(super) fn keep(&mut self, mut output: OdometryOutput, seconds: f64) {
        let time_ns = output.time.nanos();
        self.quality.add(&output);
        match &mut output.status {
            Status::Tracking(tracking) => {
                if let Some(open) = self.lost.last_mut().filter(|l| l.until_ns.is_none()) {
                    open.until_ns = Some(time_ns);
                }
                tracking.joined.iter().for_each(|joined| self.join(joined, time_ns));
                self.keyframes.extend(tracking.keyframe.take().map(|k| *k));
                let (revised, settled) =
                    (std::mem::take(&mut tracking.revised), std::mem::take(&mut tracking.settled));
                revised.iter().chain(&settled).for_each(|r| self.revise(r));
                tracking.landmarks.clear();
            }
            Status::Lost(reason) => {
                let reason = reason.to_string();
                self.lost.push(LostSpan { from_ns: time_ns, until_ns: None, reason, found_again_ns: None });
            }
            Status::Waiting(_) => {}
        }
        self.frames.push(TrackedFrame { output, seconds });
    }

    /// States of a segment that turns out to be of the same world as another one go there.
    fn join(&mut self, joined: &Joined, time_ns: i64) {
        for frame in &mut self.frames {
            if let Status::Tracking(tracking) = &mut frame.output.status {
                joined.apply(&mut tracking.segment, &mut tracking.state);
            }
        }
        self.keyframes.iter_mut().for_each(|k| joined.apply_to_keyframe(k));
        if let Some(map) = self.map.as_mut().filter(|_| joined.into == SavedMap::SEGMENT) {
            map.found_live_ns.get_or_insert(time_ns);
        }
        let segment_at = |frames: &[TrackedFrame], ns: i64| {
            let at = frames.partition_point(|f| f.output.time.nanos() < ns);
            frames.get(at)?.output.tracking().map(|t| t.segment)
        };
        for lost in self.lost.iter_mut().filter(|l| l.found_again_ns.is_none()) {
            let before = self.frames.iter().rev().filter(|f| f.output.time.nanos() < lost.from_ns);
            let before = before.filter_map(|f| f.output.tracking()).map(|t| t.segment).next();
            let after = lost.until_ns.and_then(|ns| segment_at(&self.frames, ns));
            if after.is_some() && before == after {
                lost.found_again_ns = Some(time_ns);
            }
        }
    }

    fn revise(&mut self, revised: &RevisedPose) {
        if let Some(keyframe) = self.keyframes.iter_mut().rev().find(|k| k.id == revised.id) {
            keyframe.world_from_camera = revised.world_from_camera;
        }
    }

    /// The segment with the most images; of equally long ones the first.
    fn longest_segment_id(&self) -> Option<u32> {
        let mut counts = BTreeMap::<u32, usize>::new();
        let with_state = self.frames.iter().filter_map(|f| f.output.tracking());
        with_state.for_each(|t| *counts.entry(t.segment).or_default() += 1);
        let (segment, _) = counts.iter().max_by_key(|(segment, n)| (**n, std::cmp::Reverse(**segment)))?;
        Some(*segment)
    }

    /// Poses of the body in the segment with the most images; `None` when there are fewer than two.
    pub fn longest_segment(&self) -> Option<Trajectory> {
        let segment = self.longest_segment_id()?;
        let with_state = self.frames.iter().filter_map(|f| Some((f.output.time, f.output.tracking()?)));
        let poses: Vec<StampedPose> = with_state
            .filter(|(_, t)| t.segment == segment)
            .map(|(time, t)| StampedPose { time, world_from_body: t.state.world_from_body })
            .collect();
        (poses.len() >= 2).then(|| Trajectory::new(BodyFrame::Imu, poses).ok()).flatten()
    }

    /// The segments that are not in the world of the result: of the adjustment, else of the longest segment.
    pub fn apart(&self) -> Vec<ApartSpan> {
        let adjusted: Option<BTreeSet<FrameId>> =
            self.adjusted.as_ref().map(|a| a.images.iter().map(|(id, _)| *id).collect());
        let longest = self.longest_segment_id();
        let mut spans: BTreeMap<u32, ApartSpan> = BTreeMap::new();
        for frame in &self.frames {
            let Some(tracking) = frame.output.tracking() else { continue };
            let is_in_result = match &adjusted {
                Some(adjusted) => adjusted.contains(&frame.output.frame_id),
                None => longest == Some(tracking.segment),
            };
            if is_in_result {
                continue;
            }
            let time_ns = frame.output.time.nanos();
            let first =
                ApartSpan { segment: tracking.segment, from_ns: time_ns, until_ns: time_ns, images: 0 };
            let span = spans.entry(tracking.segment).or_insert(first);
            (span.until_ns, span.images) = (time_ns, span.images + 1);
        }
        spans.into_values().filter(|span| span.images >= MIN_APART_IMAGES).collect()
    }

    /// Seconds from the first image to the first state.
    pub fn first_state_secs(&self) -> Option<f64> {
        let first = self.frames.first()?.output.time;
        let state = self.frames.iter().find(|f| f.output.tracking().is_some())?;
        Some((state.output.time - first).as_secs_f64())
    }

    /// What is said of the scale; `unseen`: σ(ln s) of what its estimate does not see.
    pub fn stated_scale(&self, unseen: UnseenScale) -> StatedScale {
        let source = match self.with_imu {
            true => unseen.source(&self.quality),
            false => ScaleSource::None,
        };
        StatedScale::new(source, None)
    }

    /// What was adjusted, where that explains the recording.
    pub(super) fn explained(&self) -> Option<&Adjusted> {
        self.adjusted.as_ref().filter(|a| a.report.is_explained())
    }

    /// Whether images and IMU contradict each other: the adjustment leaves more than noise explains, or there is none and most attempts to begin found so.
    pub(super) fn is_contradicted(&self) -> bool {
        let contradicts = match &self.adjusted {
            Some(_) => self.explained().is_none(),
            None => self.quality.contradicts(),
        };
        self.with_imu && contradicts
    }

    /// Why it never had a state.
    pub(crate) fn why_not_started(&self) -> Option<String> {
        self.quality.why_not_started()
    }

    pub(crate) fn warnings(&self) -> Vec<Warning> {
        let mut warnings = Vec::new();
        if let Some(first) = self.unreadable.first() {
            let text = format!("{} images left out; the first: {first}", self.unreadable.len());
            warnings.push(Warning::new("odometry-image-unreadable", text));
        }
        for span in &self.lost {
            let at = vidar_core::Timestamp::from_nanos(span.from_ns);
            let hint = match span.found_again_ns.map(vidar_core::Timestamp::from_nanos) {
                Some(again) => format!(
                    "the place was found again at {again} s: one world; odometry/health.csv lists every image"
                ),
                None => {
                    "poses after it are a segment of their own; odometry/health.csv lists every image".into()
                }
            };
            warnings.push(Warning::degraded("track-lost", format!("at {at} s: {}", span.reason)).hint(hint));
        }
        for span in self.apart() {
            let [from, until] = [span.from_ns, span.until_ns].map(vidar_core::Timestamp::from_nanos);
            let text = format!(
                "{} images from {from} to {until} s are a world of their own and not in the result",
                span.images
            );
            let first = self.frames.first().map_or(span.from_ns, |f| f.output.time.nanos());
            let secs = |ns: i64| (ns - first) as f64 * 1e-9;
            let (start, end) = (secs(span.from_ns), secs(span.until_ns));
            let hint = format!(
                "the same command with --start {start:.1} --end {end:.1} and another folder makes them"
            );
            warnings.push(Warning::degraded("segment-apart", text).hint(hint));
        }
        if !self.frames.iter().any(|f| f.output.tracking().is_some()) {
            let why = self.why_not_started().unwrap_or_else(|| "no images".into());
            let text = format!("the odometry never started: {why}");
            let hint =
                "`vidar inspect` shows calibration and units in plain words; docs/failures.md lists causes";
            warnings.push(Warning::degraded(NEVER_STARTED, text).hint(hint));
        }
        warnings.extend(self.quality.warning());
        warnings.extend(self.quality.unexplained());
        warnings.extend(carrier_in_view(self.carrier_share));
        if let (Some(reason), true) = (&self.not_adjusted, self.quality.longest().is_some()) {
            warnings.push(Warning::degraded("not-adjusted", format!("the live states are final: {reason}")));
        }
        if let Some([before, after]) = self.calibrated_again {
            let text = format!(
                "with the calibration found first (focal length {before:.1} px) camera and IMU did not agree, or the track was lost; the recording was tracked once more \
                 with the one that their adjustment found ({after:.1} px)"
            );
            warnings.push(Warning::new("calibrated-again", text));
        }
        warnings.extend(self.adjusted.iter().flat_map(|a| adjusted::warnings(a, self.is_self_calibrated)));
        warnings.extend(self.map.iter().map(MapUse::warning));
        if !self.with_imu {
            let text =
                "one camera without an IMU: the trajectory is known up to scale, lengths are not metres";
            warnings.push(Warning::new("scale-unknown", text));
        }
        warnings
    }
}
