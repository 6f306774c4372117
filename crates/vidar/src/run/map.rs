//! The map of a run, collected from the engine's events.

use super::evaluate::DepthScorer;
use crate::engine::{FrameState, MapEvent, MapKeyframe, Surface};
use crate::error::Error;
use crate::input::{MetricTrajectory, PosePlan, TrajectorySource};
use crate::quality::TrackQuality;
use crate::run_folder::StoredView;
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::sync::Arc;
use vidar_align::aligner::PoseCorrection;
use vidar_align::{CouplingMode, Placement};
use vidar_core::{AlignedView, BodyFrame, CameraId, StampedPose, Trajectory};
use vidar_dataset::Recording;
use vidar_solve::statistics::median_upper;
use vidar_stereo::PoseStd;

/// The fused world.
#[derive(Debug, Default)]
pub struct MetricMap {
    /// The metric trajectory by which chunks were placed; none where there are no metric poses.
    pub trajectory: Option<MetricTrajectory>,
    /// The frames that carry geometry.
    pub keyframes: Vec<MapKeyframe>,
    /// Poses of chunks and keyframes, with their uncertainty.
    pub placement: Option<Arc<Placement>>,
    /// The surface.
    pub surface: Arc<Surface>,
    /// Keyframes that got depth.
    pub views: Vec<StoredView>,
    /// Depth against the depth sensor, where there is one.
    pub depth_scores: DepthScorer,
    /// What the odometry said of the recording, where it ran; also when its poses were not used.
    pub quality: Option<TrackQuality>,
    /// What the pose of each keyframe with depth is known to, where the images corrected it.
    pub pose_stds: Vec<PoseStd>,
    /// Whether poses changed after depth was predicted from them, as live ones do.
    pub is_revised: bool,
    /// Area that each fused view would see if all of its pixels had depth, m².
    pub view_areas_m2: Vec<f64>,
}

impl MetricMap {
    /// Where metric poses came from, in words.
    pub fn poses(&self) -> String {
        let source = self.trajectory.as_ref().map(|t| t.source.to_string());
        source.unwrap_or_else(|| "none: lengths are not metres".to_owned())
    }

    /// Where metric poses came from; null where there are none.
    pub fn poses_json(&self) -> serde_json::Value {
        serde_json::json!(self.trajectory.as_ref().map(|t| &t.source))
    }

    /// Whether the metric poses are ground truth.
    pub fn uses_ground_truth(&self) -> bool {
        self.trajectory.as_ref().is_some_and(|t| t.source == TrajectorySource::GroundTruth)
    }

    /// Whose world the map is in: that of the metric poses, where the coupling uses them; else the first chunk's.
    fn world(&self, mode: CouplingMode) -> Option<&TrajectorySource> {
        self.trajectory.as_ref().filter(|_| mode.uses_pose_priors()).map(|t| &t.source)
    }

    /// The map's world, in words for whoever opens its files.
    pub fn world_words(&self, mode: CouplingMode) -> String {
        let axes = match self.world(mode) {
            Some(TrajectorySource::Odometry) => "z up, gravity along -z",
            Some(_) => "axes as the given poses have them",
            None => "axes of the first chunk",
        };
        format!("frame: world, right-handed, {axes}")
    }

    /// Up in the map's world: z where the odometry levels it by gravity, however the camera was held; else as cameras are held.
    pub fn up(&self, mode: CouplingMode) -> Vector3<f64> {
        if self.world(mode) == Some(&TrajectorySource::Odometry) {
            return Vector3::z();
        }
        let given = self.trajectory.as_ref();
        let path = self.keyframe_trajectory();
        path.as_ref().or(given.map(|t| &t.camera_trajectory)).map_or_else(Vector3::z, vidar_view::up_of_world)
    }

    /// What the images changed of the poses that chunks were given, and what these are known to with the images; `None` where depth does
    /// not come from stereo, and where the poses changed later.
    pub fn pose_correction(&self) -> Option<(PoseCorrection, PoseStd)> {
        let correction = self.placement.as_ref()?.drift.pose_correction.filter(|_| !self.is_revised)?;
        let median =
            |of: fn(&PoseStd) -> f64| median_upper(&mut self.pose_stds.iter().map(of).collect::<Vec<f64>>());
        let std = PoseStd {
            rotation_rad: median(|s| s.rotation_rad)?,
            translation_m: median(|s| s.translation_m)?,
        };
        Some((correction, std))
    }

    /// What the surface is of the area that the median view sees; small where views contradict each other, so that hardly
    /// anything was fused.
    pub fn share_of_a_view(&self) -> Option<f64> {
        let mut areas = self.view_areas_m2.clone();
        let median = median_upper(&mut areas).filter(|a| *a > 0.0)?;
        Some(self.surface.coverage.surface_area_m2 / median)
    }

    /// The keyframes' poses in the map as a trajectory of the camera.
    pub fn keyframe_trajectory(&self) -> Option<Trajectory> {
        let stamps: BTreeMap<_, _> = self.keyframes.iter().map(|k| (k.stamp.frame_id, k.stamp)).collect();
        let pose = |k: &vidar_align::aligner::KeyframePlacement| {
            let stamp = stamps.get(&k.frame_id)?;
            Some(StampedPose { time: stamp.time, world_from_body: k.world_from_camera })
        };
        let poses = self.placement.as_ref()?.keyframes.iter().filter_map(pose).collect();
        Trajectory::new(BodyFrame::Camera(self.keyframes.first()?.stamp.camera), poses).ok()
    }
}

/// Collects the map from the events of the engine.
pub(super) struct MapCollector<'a> {
    dataset: &'a Recording,
    poses: &'a PosePlan,
    map: MetricMap,
    /// Tracked poses of each segment, and the segment that is mapped.
    states: BTreeMap<u32, Vec<FrameState>>,
    segment: u32,
    source: Option<TrajectorySource>,
}

impl<'a> MapCollector<'a> {
    /// Nothing yet.
    pub(super) fn new(dataset: &'a Recording, poses: &'a PosePlan) -> Self {
        Self { dataset, poses, map: MetricMap::default(), states: BTreeMap::new(), segment: 0, source: None }
    }

    /// The map so far.
    pub(super) fn map(&self) -> &MetricMap {
        &self.map
    }

    /// Takes an event.
    pub(super) fn read(&mut self, event: &MapEvent) -> Result<(), Error> {
        match event {
            MapEvent::State(state) => self.states.entry(state.segment).or_default().push(*state),
            MapEvent::World { source, segment } => {
                self.map = MetricMap { quality: self.map.quality.take(), ..MetricMap::default() };
                (self.source, self.segment) = (source.clone(), *segment);
            }
            MapEvent::ChunkPredicted { pose_std, .. } => self.map.pose_stds.extend(pose_std),
            MapEvent::RevisedStates(revised) => self.map.is_revised |= !revised.is_empty(),
            MapEvent::Keyframe(keyframe) => self.map.keyframes.push(keyframe.clone()),
            MapEvent::PlacementsRevised { placement, is_final: true } => {
                self.map.placement = Some(placement.clone());
            }
            MapEvent::SurfaceChanged { surface, is_final: true, .. } => self.map.surface = surface.clone(),
            MapEvent::ViewsFused(views) => {
                self.map.view_areas_m2.extend(views.iter().filter_map(area_in_view));
                self.map.depth_scores.add(self.dataset, views)?;
            }
            MapEvent::Tracked(quality) => self.map.quality = Some((**quality).clone()),
            _ => {}
        }
        Ok(())
    }

    /// Adds views that were written.
    pub(super) fn add_stored(&mut self, views: Vec<StoredView>) {
        self.map.views.extend(views);
    }

    /// The map, with its trajectory: the given one, or the states of the segment that was mapped.
    pub(super) fn finish(mut self, camera: CameraId) -> MetricMap {
        self.map.trajectory = match (&self.source, self.poses) {
            (None, _) => None,
            (Some(TrajectorySource::Odometry), _) => self.tracked(camera),
            (Some(_), PosePlan::Given(given)) => Some(given.clone()),
            (Some(_), PosePlan::Odometry { fallback }) => fallback.clone(),
            (Some(_), PosePlan::None) => None,
        };
        self.map
    }

    fn tracked(&self, camera: CameraId) -> Option<MetricTrajectory> {
        let pose = |s: &FrameState| StampedPose { time: s.time, world_from_body: s.world_from_camera };
        let poses = self.states.get(&self.segment)?.iter().map(pose).collect();
        let camera_trajectory = Trajectory::new(BodyFrame::Camera(camera), poses).ok()?;
        Some(MetricTrajectory { source: TrajectorySource::Odometry, camera_trajectory })
    }
}

/// Area of a view's pixels at their depths, facing the camera, m²; pixels without depth count as the mean of the others.
fn area_in_view(view: &AlignedView) -> Option<f64> {
    let k = view.intrinsics();
    let pixels = view.depth().image().data();
    let valid = || pixels.iter().filter(|z| z.is_finite()).map(|z| f64::from(*z));
    let count = valid().count();
    let area: f64 = valid().map(|z| z * z).sum::<f64>() / (k.fx * k.fy);
    (count > 0).then(|| area * pixels.len() as f64 / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{LieGroup, Se3, So3, Timestamp};

    #[test]
    fn a_phone_that_is_held_upright_does_not_lay_the_map_on_its_side() {
        // A level camera of a world with z up, turned by a quarter about its axis.
        let level = So3::exp(&(Vector3::x() * -std::f64::consts::FRAC_PI_2));
        let quarter = So3::exp(&(Vector3::z() * std::f64::consts::FRAC_PI_2));
        let pose = |i: i64| StampedPose {
            time: Timestamp::from_nanos(i),
            world_from_body: Se3::new(level * quarter, Vector3::new(i as f64, 0.0, 0.0)),
        };
        let path = Trajectory::new(BodyFrame::Camera(CameraId(0)), (0..5).map(pose).collect()).unwrap();
        let map_of = |source: TrajectorySource| {
            let trajectory = Some(MetricTrajectory { source, camera_trajectory: path.clone() });
            MetricMap { trajectory, ..MetricMap::default() }
        };
        let up_of = |source: TrajectorySource| map_of(source).up(CouplingMode::Coupled);
        assert_eq!(up_of(TrajectorySource::Odometry), Vector3::z());
        assert_eq!(up_of(TrajectorySource::GroundTruth).x.abs(), 1.0, "as cameras are held");
        assert_eq!(MetricMap::default().up(CouplingMode::Coupled), Vector3::z());

        // A coupling without metric poses has a world of its own, whatever the odometry found.
        let map = map_of(TrajectorySource::Odometry);
        assert_eq!(map.up(CouplingMode::PoseFree).x.abs(), 1.0);
        assert!(map.world_words(CouplingMode::Coupled).ends_with("gravity along -z"));
        assert!(map.world_words(CouplingMode::PoseFree).ends_with("axes of the first chunk"));
    }
}
