//! What the result is judged against: a scan, or the depth sensor's own images.

use super::plan::ReferenceSource;
use crate::config::Config;
use crate::error::Error;
use crate::events::Events;
use crate::input::truth_in_camera;
use nalgebra::Vector3;
use vidar_core::{
    AlignedView, Confidence, Duration, FrameId, Image, LieGroup, MetricDepth, Pinhole, PointCloud, Se3,
    Trajectory, Warning,
};
use vidar_dataset::{Dataset, DepthEntry, DepthSensor};
use vidar_fusion::{FusionConfig, TsdfVolume};

/// Longest time between a depth image and the pose it is given, and between a depth image and its colour image.
const MAX_STAMP_DIFFERENCE: Duration = Duration::from_millis(20);

/// Reads or makes the reference cloud, in the world of ground truth, metres.
pub fn cloud(
    source: &ReferenceSource,
    dataset: &Dataset,
    config: &Config,
    events: &Events,
) -> Result<Option<PointCloud>, Error> {
    match source {
        ReferenceSource::None => Ok(None),
        ReferenceSource::Cloud(path) => {
            let bytes = std::fs::read(path).map_err(|e| Error::io("read", path, e))?;
            Ok(Some(vidar_export::read_ply(&bytes)?.cloud))
        }
        ReferenceSource::DepthSensor => fused_sensor_depth(dataset, config, events).map(Some),
    }
}

/// The depth sensor's images fused with ground-truth poses, by the same fusion as the result.
fn fused_sensor_depth(dataset: &Dataset, config: &Config, events: &Events) -> Result<PointCloud, Error> {
    let (Some(sensor), Some(truth)) = (&dataset.depth_sensor, truth_in_camera(dataset)) else {
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
                        events.warn(&Warning::new("depth-unreadable", e.to_string()).at(entry.path.display()))
                    }
                }
            }
            Err(e) => events.warn(&Warning::new("depth-unreadable", e.to_string()).at(entry.path.display())),
        }
    }
    Ok(super::judge::sampled(&volume.extract_mesh(), config)?)
}

fn world_from_depth(entry: &DepthEntry, sensor: &DepthSensor, truth: &Trajectory) -> Option<Se3> {
    let world_from_color = truth
        .nearest(entry.time, MAX_STAMP_DIFFERENCE)
        .map(|p| p.world_from_body)
        .or_else(|| truth.interpolate(entry.time, Duration::from_millis(200)))?;
    Some(world_from_color * sensor.color_from_depth)
}

/// The sensor's depth as the colour view sees it: every depth pixel is carried over, the nearest one wins.
///
/// `None` when no depth image was taken at that time.
pub fn sensor_depth_in_view(
    dataset: &Dataset,
    time: vidar_core::Timestamp,
    view: &Pinhole,
) -> Option<Result<MetricDepth, vidar_dataset::DatasetError>> {
    let sensor = dataset.depth_sensor.as_ref()?;
    let entry = dataset.depth_for(time).filter(|e| (e.time - time).abs() <= MAX_STAMP_DIFFERENCE)?;
    Some(dataset.load_depth(entry).map(|depth| register(&depth, sensor, view)))
}

fn register(depth: &MetricDepth, sensor: &DepthSensor, view: &Pinhole) -> MetricDepth {
    let mut registered = Image::filled(view.width, view.height, f32::NAN);
    let k = &sensor.intrinsics;
    let image = depth.image();
    for y in 0..image.height().min(k.height) {
        for x in 0..image.width().min(k.width) {
            let z = f64::from(image[(x, y)]);
            if z.is_nan() {
                continue;
            }
            let in_color: Vector3<f64> = sensor.color_from_depth.act(&(k.ray(x as f64, y as f64) * z));
            let Some(pixel) = view.project(&in_color) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            if u >= 0.0 && v >= 0.0 && u < view.width as f64 && v < view.height as f64 {
                let target = &mut registered[(u as usize, v as usize)];
                if target.is_nan() || f64::from(*target) > in_color.z {
                    *target = in_color.z as f32;
                }
            }
        }
    }
    MetricDepth::new(registered)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registration_keeps_the_nearest_surface_and_the_metric_depth() {
        let intrinsics = Pinhole::new(100.0, 100.0, 15.5, 11.5, 32, 24).unwrap();
        let sensor = DepthSensor {
            intrinsics,
            distorted: None,
            units_per_metre: 1000.0,
            color_from_depth: Se3::from_translation(Vector3::new(0.02, 0.0, 0.5)),
            invalid: vec![0],
        };
        // Left half at 1 m, right half at 2 m; seen from half a metre further back.
        let depth = MetricDepth::new(Image::from_fn(32, 24, |x, _| if x < 16 { 1.0 } else { 2.0 }));
        let view = intrinsics.resized(16, 12).unwrap();
        let seen = register(&depth, &sensor, &view);
        let values: Vec<f32> = seen.image().data().iter().copied().filter(|z| !z.is_nan()).collect();
        assert!(values.iter().all(|&z| (z - 1.5).abs() < 1e-6 || (z - 2.5).abs() < 1e-6));
        assert!((seen.image()[(4, 6)] - 1.5).abs() < 1e-6);
        assert!((seen.image()[(12, 6)] - 2.5).abs() < 1e-6);
    }
}
