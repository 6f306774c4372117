//! What the result is compared with: a scan, or the depth sensor's own images.

use super::plan::ReferenceSource;
use crate::config::Config;
use crate::error::Error;
use crate::events::Events;
use crate::input::truth_in_camera;
use vidar_core::{
    AlignedView, Confidence, Duration, FrameId, MetricDepth, Pinhole, PointCloud, Se3, Trajectory, Warning,
};
use vidar_dataset::{DepthEntry, DepthSensor, Recording};
use vidar_fusion::{FusionConfig, TsdfVolume};

/// Longest time between a depth image and the pose it is given, and between a depth image and its colour image.
const MAX_STAMP_DIFFERENCE: Duration = Duration::from_millis(20);

/// Reads or makes the reference cloud, in the world of ground truth, metres.
pub fn cloud(
    source: &ReferenceSource,
    dataset: &Recording,
    config: &Config,
    events: &Events,
) -> Result<Option<PointCloud>, Error> {
    match source {
        ReferenceSource::None => Ok(None),
        ReferenceSource::Cloud(path) => {
            let bytes = crate::system::read_up_to(path, crate::system::MAX_CLOUD_BYTES)
                .map_err(|e| Error::io("read", path, e))?;
            Ok(Some(vidar_export::read_ply(&bytes)?.cloud))
        }
        ReferenceSource::DepthSensor => fused_sensor_depth(dataset, config, events).map(Some),
    }
}

/// The depth sensor's images fused with ground-truth poses, by the same fusion as the result.
fn fused_sensor_depth(dataset: &Recording, config: &Config, events: &Events) -> Result<PointCloud, Error> {
    let (Some(sensor), Some(truth)) = (&dataset.depth_sensor, truth_in_camera(dataset)?) else {
        return Ok(PointCloud::default());
    };
    // A depth sensor's pixels are equally sure; everything else is as for the result.
    let fusion = FusionConfig { min_confidence: 0.0, ..config.fusion.clone() };
    let mut volume = TsdfVolume::new(&fusion)?;
    for (index, entry) in dataset.depths.iter().enumerate() {
        let Some(world_from_depth) = world_from_depth(entry, sensor, &truth) else { continue };
        match dataset.load_depth(entry) {
            Ok(depth) => {
                let id = FrameId(u32::try_from(index).unwrap_or(u32::MAX));
                let k = sensor.intrinsics;
                let confidence = Confidence::full(k.width, k.height);
                match AlignedView::new(id, entry.time, world_from_depth, k, depth, confidence) {
                    Ok(view) => {
                        volume.integrate(&view)?;
                    }
                    Err(e) => {
                        events.warn(&Warning::degraded("depth-unreadable", e.to_string()).at(&entry.location))
                    }
                }
            }
            Err(e) => events.warn(&Warning::degraded("depth-unreadable", e.to_string()).at(&entry.location)),
        }
    }
    Ok(super::evaluate::sampled(&volume.extract_mesh(), config)?)
}

fn world_from_depth(entry: &DepthEntry, sensor: &DepthSensor, truth: &Trajectory) -> Option<Se3> {
    let world_from_color = truth
        .nearest(entry.time, MAX_STAMP_DIFFERENCE)
        .map(|p| p.world_from_body)
        .or_else(|| truth.interpolate(entry.time, Duration::from_millis(200)))?;
    Some(world_from_color * sensor.color_from_depth)
}

/// The sensor's depth registered to the colour view.
///
/// `None` when no depth image was taken at that time.
pub fn sensor_depth_in_view(
    dataset: &Recording,
    time: vidar_core::Timestamp,
    view: &Pinhole,
) -> Option<Result<MetricDepth, vidar_dataset::DatasetError>> {
    let sensor = dataset.depth_sensor.as_ref()?;
    let entry = dataset.depth_for(time).filter(|e| (e.time - time).abs() <= MAX_STAMP_DIFFERENCE)?;
    Some(
        dataset.load_depth(entry).map(|depth| {
            vidar_eval::register_depth(&depth, &sensor.intrinsics, &sensor.color_from_depth, view)
        }),
    )
}
