//! What the odometry said of a whole recording, in figures: how much of it has a state, how the states are, how well the scale
//! is known. One collector for `vidar odometry` and `vidar run`.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use vidar_core::{Health, LieGroup, Timestamp, Warning};
use vidar_odometry::bundle_adjustment::{Adjusted, AdjustmentFinding, AdjustmentReport};
use vidar_odometry::initialization::InitFailureReason;
use vidar_odometry::{Joined, LossReason, OdometryOutput, Status, Tracking};

/// States that come after contradictions are doubted where less than this share has health OK.
const DOUBTFUL_HEALTH: f64 = 0.5;

/// χ² per degree of freedom of the IMU that its stated noise explains. Healthy recordings have 0.04 to 0.7.
const SETTLED_CHI2: f64 = 1.0;

/// Statements of the odometry, summed up image by image.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct TrackQuality {
    /// Images that the odometry answered.
    pub images: usize,
    /// Those with a state, in any segment.
    pub with_state: usize,
    /// Times that a state was given up.
    pub losses: usize,
    times: Option<(Timestamp, Timestamp)>,
    /// Failures to initialise, each kind with its count and its last text.
    initialization_failures: BTreeMap<String, (usize, String)>,
    /// How many of them found that images and IMU contradict each other.
    contradictions: usize,
    waits: usize,
    segments: BTreeMap<u32, SegmentQuality>,
    adjusted: Option<AdjustedQuality>,
}

/// What the adjustment after the recording's end made of the states.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct AdjustedQuality {
    images: usize,
    first: Timestamp,
    last: Timestamp,
    scale_std: f64,
    inertial_chi2: f64,
    /// Whether it found what was given of the calibration wrong.
    #[serde(default)]
    contradicts_given: bool,
    /// See [`vidar_odometry::bundle_adjustment::AdjustmentReport::noise_ratio`].
    #[serde(default)]
    noise_ratio: f64,
}

/// States of one segment.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SegmentQuality {
    /// Images with a state.
    pub images: usize,
    /// How many of them have which health.
    pub health: BTreeMap<String, usize>,
    first: Timestamp,
    last: Timestamp,
    last_position: Vector3<f64>,
    last_scale_std: f64,
    /// ∫ σ(ln s) over the path, and the path's length, m.
    weighted: (f64, f64),
}

impl TrackQuality {
    /// Takes the answer to one image.
    pub fn add(&mut self, output: &OdometryOutput) {
        self.images += 1;
        let (first, _) = self.times.unwrap_or((output.time, output.time));
        self.times = Some((first, output.time));
        match &output.status {
            Status::Tracking(tracking) => {
                self.with_state += 1;
                tracking.joined.iter().for_each(|joined| self.join(joined));
                let add = |s: &mut SegmentQuality| s.add(output.time, tracking);
                let new = || SegmentQuality::new(output.time, tracking);
                self.segments.entry(tracking.segment).and_modify(add).or_insert_with(new);
            }
            Status::Lost(reason) => {
                self.losses += 1;
                self.contradictions += usize::from(matches!(reason, LossReason::Diverged { .. }));
            }
            Status::Waiting(failure) => {
                // Too little recorded for an attempt says nothing of the sensors.
                let is_attempt =
                    !matches!(failure.reason, InitFailureReason::Frames | InitFailureReason::Seconds);
                self.waits += usize::from(is_attempt);
                let kind = kind_of(&failure.reason);
                self.contradictions += usize::from(kind.is_contradiction);
                let (count, text) = self.initialization_failures.entry(kind.name.into()).or_default();
                *count += 1;
                *text = failure.to_string();
            }
        }
    }

    /// One segment becomes part of another.
    fn join(&mut self, joined: &Joined) {
        let Some(mut segment) = self.segments.remove(&joined.segment) else { return };
        segment.last_position = joined.into_from_segment.act(&segment.last_position);
        match self.segments.entry(joined.into) {
            Entry::Occupied(mut into) => into.get_mut().append(segment),
            Entry::Vacant(into) => drop(into.insert(segment)),
        }
    }

    /// The adjusted states replace those of the longest segment.
    pub fn adjust(&mut self, adjusted: &Adjusted) {
        let (Some(first), Some(last)) = (adjusted.images.first(), adjusted.images.last()) else { return };
        self.adjusted = Some(AdjustedQuality {
            images: adjusted.images.len(),
            first: first.1.time,
            last: last.1.time,
            scale_std: adjusted.scale_std,
            inertial_chi2: adjusted.report.inertial_chi2_per_dof,
            contradicts_given: adjusted.findings.iter().any(AdjustmentFinding::contradicts_given),
            noise_ratio: adjusted.report.noise_ratio,
        });
    }

    /// χ² per degree of freedom that the adjustment left of the IMU; `None` for live states.
    pub fn inertial_chi2(&self) -> Option<f64> {
        self.adjusted.map(|a| a.inertial_chi2)
    }

    /// Images with a state in the one world that is mapped.
    pub fn mapped_images(&self) -> usize {
        self.adjusted.map_or_else(|| self.longest().map_or(0, |s| s.images), |a| a.images)
    }

    /// Why the odometry never started: the failure that was found most often, of the kind that was found more often. The last one
    /// alone may be an accident of where the recording ends.
    pub fn why_not_started(&self) -> Option<String> {
        let contradicts = 2 * self.contradictions > self.waits;
        let of_kind = self
            .initialization_failures
            .iter()
            .filter(|(name, _)| CONTRADICTIONS.contains(&name.as_str()) == contradicts);
        let (count, most) = of_kind.map(|(_, failure)| failure).max_by_key(|(count, _)| *count)?;
        Some(match contradicts {
            false if most.starts_with("std(log scale)") => format!(
                "{most}. If the camera does speed up and slow down, images and IMU contradict each other: signs or axes of the \
                 accelerometer, camera's orientation, or a clock that is far off"
            ),
            false => most.clone(),
            true => format!(
                "images and IMU contradict each other in {} of {} attempts ({most}; {count}x). {LIKELY_CAUSES}",
                self.contradictions, self.waits
            ),
        })
    }

    /// Whether most of what the odometry found is contradiction of the sensors, so that its states are doubtful as well.
    pub fn contradicts(&self) -> bool {
        self.contradictions > 0 && 2 * self.contradictions > self.waits + self.losses
    }

    /// The segment with the most images, the first of equally long ones: the one that is mapped.
    pub fn longest(&self) -> Option<&SegmentQuality> {
        let longest = self.segments.iter().max_by_key(|(id, s)| (s.images, std::cmp::Reverse(**id)));
        longest.map(|(_, s)| s).filter(|s| s.images >= 2)
    }

    /// Whether the adjustment leaves of the IMU no more than its stated noise, and nothing that was given stands against it:
    /// contradictions before the start were then those of a clock, readout or rotation that had still to be found.
    pub fn contradictions_are_settled(&self) -> bool {
        self.adjusted.is_some_and(|a| a.inertial_chi2 < SETTLED_CHI2 && !a.contradicts_given)
    }

    /// Whether sensors contradicted each other, nothing has checked the states since (no adjustment), and they are not healthy either: a
    /// clock 200 ms off once gave a scale 37 % off like that.
    pub fn is_doubtful(&self) -> bool {
        self.contradicts() && !self.is_adjusted() && self.healthy() < DOUBTFUL_HEALTH
    }

    /// The degradation that it is where noise does not explain what the adjustment left between camera and IMU.
    pub(crate) fn unexplained(&self) -> Option<Warning> {
        let ratio =
            self.adjusted.map(|a| a.noise_ratio).filter(|r| *r > AdjustmentReport::EXPLAINED_NOISE)?;
        let text = format!(
            "camera and IMU differ by {ratio:.1} times the IMU's own noise: something about the recording is not as it is taken to be; what is stated of the scale is multiplied by that"
        );
        Some(Warning::degraded("motion-unexplained", text).hint(
            "a camera that is loose on the IMU, things that move with it or fill the view, stabilisation, a wrong calibration; docs/failures.md lists causes",
        ))
    }

    /// The degradation that doubtful states are.
    pub(crate) fn warning(&self) -> Option<Warning> {
        let is_told = self.is_doubtful() && self.longest().is_some();
        let why = self.why_not_started().filter(|_| is_told)?;
        let hint = "`vidar calibrate` finds what a recording shows of its calibration; docs/failures.md lists causes";
        Some(Warning::degraded("sensors-contradict", format!("before it started: {why}")).hint(hint))
    }

    /// σ(ln s) of the longest segment, without what no estimate sees; infinite where it is not observed.
    pub fn scale_std(&self) -> f64 {
        let live = || self.longest().map_or(f64::INFINITY, SegmentQuality::scale_std);
        self.adjusted.map_or_else(live, |a| a.scale_std)
    }

    /// Share of the recording's time within the longest segment, 0…1.
    pub fn covered(&self) -> f64 {
        let segment = self.longest().map(|s| (s.first, s.last));
        let (Some((first, last)), Some((from, until))) =
            (self.times, self.adjusted.map(|a| (a.first, a.last)).or(segment))
        else {
            return 0.0;
        };
        let total = (last - first).as_secs_f64();
        if total > 0.0 { (until - from).as_secs_f64() / total } else { 0.0 }
    }

    /// Share of the longest segment's images whose health is OK, 0…1. Where states were adjusted afterwards, a scale that had still to
    /// converge is none of their faults.
    pub fn healthy(&self) -> f64 {
        let converging = |s: &SegmentQuality| match self.adjusted {
            Some(_) => s.count(Health::ScaleConverging),
            None => 0,
        };
        self.longest().map_or(0.0, |s| (s.count(Health::Ok) + converging(s)) as f64 / s.images.max(1) as f64)
    }

    /// In words: "193 of 220 images, health OK in 97 % of them".
    pub fn words(&self) -> String {
        let tracked = self.mapped_images();
        if tracked == 0 {
            return format!("0 of {} images", self.images);
        }
        let mut text = format!(
            "{tracked} of {} images, health OK in {:.0} % of them",
            self.images,
            100.0 * self.healthy()
        );
        if self.losses > 0 {
            text += &format!(", lost {}x", self.losses);
        }
        text
    }

    /// Whether it is of the states adjusted after the end.
    pub fn is_adjusted(&self) -> bool {
        self.adjusted.is_some()
    }

    /// For manifests.
    pub fn json(&self) -> Value {
        json!({
            "images": self.images, "with_state": self.with_state, "losses": self.losses,
            "mapped_images": self.mapped_images(), "is_adjusted": self.is_adjusted(),
            "covered_time_ratio": self.covered(), "healthy_ratio": self.healthy(),
            "health": self.longest().map(|s| &s.health),
            "scale_std": Some(self.scale_std()).filter(|s| s.is_finite()),
        })
    }
}

/// What ends most attempts where calibration, clock or units are wrong, in the order in which they are usually found.
const LIKELY_CAUSES: &str = "Most likely the calibration is not this recording's: the camera's rotation and position on the IMU \
    (T_BS), the clock offset, the focal length or the distortion, axes, signs and units of the IMU, a stabilised picture, or image stamps that scatter";

/// Failures that say that images and IMU contradict each other. The others say that something is missing yet.
const CONTRADICTIONS: [&str; 8] = [
    "outliers",
    "image residual",
    "inertial residual",
    "speed",
    "accelerometer bias",
    "gyroscope bias",
    "specific force",
    "camera orientation",
];

struct FailureKind {
    name: &'static str,
    is_contradiction: bool,
}

fn kind_of(reason: &InitFailureReason) -> FailureKind {
    use InitFailureReason as R;
    let name = match reason {
        R::OutlierShare => "outliers",
        R::ImageChi2 => "image residual",
        R::ImuChi2 => "inertial residual",
        R::Speed => "speed",
        R::AccelBias => "accelerometer bias",
        R::GyroBias => "gyroscope bias",
        R::SpecificForce => "specific force",
        R::CameraOrientation => "camera orientation",
        R::Frames | R::Seconds => "too short",
        R::Tracks => "tracks",
        R::Parallax => "parallax",
        R::ScaleUncertainty | R::ScaleAgreement => "scale",
        R::SceneDistance => "distance",
        R::GyroStd | R::AccelStd | R::ImageMotion => "neither at rest nor moving",
        _ => "other",
    };
    FailureKind { name, is_contradiction: CONTRADICTIONS.contains(&name) }
}

/// Share of the image from which what moves with the camera is told: single cells may be chance.
const TOLD_CARRIER_SHARE: f64 = 0.05;

/// What is said of the share of the image that moves with the camera.
pub(crate) fn carrier_in_view(share: f64) -> Option<Warning> {
    (share >= TOLD_CARRIER_SHARE).then(|| {
        let text = format!(
            "{:.0} % of the picture moves with the camera: its carrier, a finger, something on the lens; no features are taken there",
            100.0 * share
        );
        Warning::new("carrier-in-view", text)
            .hint("depth there is not the scene's; mount the camera so that it sees the scene alone, or give `--masks`")
    })
}

impl SegmentQuality {
    fn new(time: Timestamp, tracking: &Tracking) -> Self {
        Self {
            images: 1,
            health: [(tracking.health.as_str().into(), 1)].into(),
            first: time,
            last: time,
            last_position: tracking.state.world_from_body.translation,
            last_scale_std: tracking.scale_std,
            weighted: (0.0, 0.0),
        }
    }

    fn add(&mut self, time: Timestamp, tracking: &Tracking) {
        self.images += 1;
        *self.health.entry(tracking.health.as_str().into()).or_default() += 1;
        let position = tracking.state.world_from_body.translation;
        let step = (position - self.last_position).norm();
        self.weighted.0 += step * tracking.scale_std;
        self.weighted.1 += step;
        (self.last, self.last_position, self.last_scale_std) = (time, position, tracking.scale_std);
    }

    /// Takes in the states of another segment of the same world.
    fn append(&mut self, other: Self) {
        self.images += other.images;
        other.health.into_iter().for_each(|(word, count)| *self.health.entry(word).or_default() += count);
        self.weighted.0 += other.weighted.0;
        self.weighted.1 += other.weighted.1;
        self.first = self.first.min(other.first);
        if other.last > self.last {
            (self.last, self.last_position, self.last_scale_std) =
                (other.last, other.last_position, other.last_scale_std);
        }
    }

    fn count(&self, health: Health) -> usize {
        self.health.get(health.as_str()).copied().unwrap_or(0)
    }

    /// σ of ln(scale) of the whole path: errors of its pieces go one way, so their σ add up with the pieces' lengths. At least
    /// that of the newest state.
    pub fn scale_std(&self) -> f64 {
        match self.weighted.1 > 0.0 {
            true => (self.weighted.0 / self.weighted.1).max(self.last_scale_std),
            false => self.last_scale_std,
        }
    }
}
