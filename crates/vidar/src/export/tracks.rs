//! Tracks for COLMAP: which keyframes see which point of the map.
//!
//! A point is seen in a view where it projects into the image and the view's depth there is the point's own: nearer surfaces hide
//! it. The pixels are projections of the map, not matches of features, so their reprojection error says nothing.

use super::{ExportView, StoredViews, pose_of};
use crate::error::Error;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use vidar_core::camera::Pixel;
use vidar_core::{LieGroup, MetricDepth, Pinhole, PointCloud, Se3};
use vidar_export::Observation;

/// Most points that get tracks: each is seen in some ten views, which COLMAP keeps in memory at some 100 bytes each.
const MAX_POINTS: usize = 200_000;
/// How far the depth of a view may be off a point of the fused surface, relative. Depths of one surface in several views differ
/// by about a hundredth, those across an edge by more than a tenth of the distance.
const DEPTH_TOLERANCE: f64 = 0.03;

/// Every n-th point, at most [`MAX_POINTS`].
pub(super) fn thinned(cloud: PointCloud) -> PointCloud {
    let step = cloud.len().div_ceil(MAX_POINTS).max(1);
    fn every<T: Clone>(values: &[T], step: usize) -> Vec<T> {
        values.iter().step_by(step).cloned().collect()
    }
    PointCloud {
        positions: every(&cloud.positions, step),
        normals: every(&cloud.normals, step),
        colors: every(&cloud.colors, step),
        confidences: every(&cloud.confidences, step),
    }
}

/// Where the points are seen, view by view. `views` may have other sizes than the depth.
pub(super) fn observations(
    run: &Path,
    stored: &StoredViews,
    cloud: &PointCloud,
    views: &[ExportView],
) -> Result<Vec<Observation>, Error> {
    let Some(units_per_metre) = super::depth_units(run)? else {
        let reason = "depth/depth.json is missing; tracks need output.depth_png = true".to_owned();
        return Err(Error::NotARun { path: run.to_owned(), reason });
    };
    let stored: BTreeMap<u32, _> = stored.views.iter().map(|v| (v.frame, v)).collect();
    let of_view = |(index, view): (usize, &ExportView)| {
        let Some(own) = stored.get(&view.frame_id.0) else { return Ok(Vec::new()) };
        let (Some(file), Some(pose)) = (&own.depth, pose_of(own)) else { return Ok(Vec::new()) };
        let path = run.join(file);
        let bytes = std::fs::read(&path).map_err(|e| Error::io("read", &path, e))?;
        let depth = vidar_export::read_depth_png(&bytes, units_per_metre)?;
        let seen = seen(cloud, &depth, &own.intrinsics, &pose);
        // The same rays in an image of another size.
        let observation = |(point, pixel): (u32, Pixel)| {
            let ray = own.intrinsics.ray(pixel.x, pixel.y);
            let pixel = view.intrinsics.project(&ray)?.into();
            Some(Observation { point, view: index as u32, pixel })
        };
        Ok(seen.into_iter().filter_map(observation).collect())
    };
    let found: Result<Vec<Vec<Observation>>, Error> = views.par_iter().enumerate().map(of_view).collect();
    Ok(found?.concat())
}

/// Points that a view sees, with their pixels.
fn seen(
    cloud: &PointCloud,
    depth: &MetricDepth,
    intrinsics: &Pinhole,
    world_from_camera: &Se3,
) -> Vec<(u32, Pixel)> {
    let camera_from_world = world_from_camera.inverse();
    let image = depth.image();
    let pixel_of = |position: &[f32; 3]| {
        let p = camera_from_world * nalgebra::Vector3::from(position.map(f64::from));
        let pixel = intrinsics.project(&p).filter(|pixel| pixel.x > -0.5 && pixel.y > -0.5)?;
        let (column, row) = (pixel.x.round() as usize, pixel.y.round() as usize);
        let is_inside = column < image.width() && row < image.height();
        let measured = f64::from(is_inside.then(|| image[(column, row)])?);
        ((measured - p.z).abs() < DEPTH_TOLERANCE * p.z).then_some(pixel)
    };
    let points = cloud.positions.iter().enumerate();
    points.filter_map(|(i, p)| Some((i as u32, pixel_of(p)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Image;

    #[test]
    fn a_point_is_seen_unless_it_is_hidden_behind_the_camera_or_outside() {
        let intrinsics = Pinhole::new(100.0, 100.0, 49.5, 39.5, 100, 80).unwrap();
        // A wall at 2 m, its left half hidden by another at 1 m.
        let depth = MetricDepth::new(Image::from_fn(100, 80, |x, _| if x < 50 { 1.0 } else { 2.0 }));
        let pose = Se3::new(vidar_core::So3::IDENTITY, nalgebra::Vector3::new(0.0, 0.0, 5.0));
        let positions = vec![
            [0.5, 0.0, 7.0],
            [-0.5, 0.0, 7.0],
            [-0.2, 0.1, 6.0],
            [0.5, 0.0, 3.0],
            [2.0, 0.0, 7.0],
            [0.5, 0.0, 7.07],
        ];
        let cloud = PointCloud { positions, ..PointCloud::default() };
        let seen = seen(&cloud, &depth, &intrinsics, &pose);
        assert_eq!(seen.iter().map(|(i, _)| *i).collect::<Vec<_>>(), [0, 2]);
        assert!((seen[0].1[0] - 74.5).abs() < 1e-5 && (seen[0].1[1] - 39.5).abs() < 1e-5, "{seen:?}");
    }

    #[test]
    fn a_large_cloud_is_thinned_evenly() {
        let positions: Vec<[f32; 3]> = (0..450_000).map(|i| [i as f32, 0.0, 0.0]).collect();
        let thin = thinned(PointCloud { positions, ..PointCloud::default() });
        assert_eq!((thin.len(), thin.positions[1]), (150_000, [3.0, 0.0, 0.0]));
    }
}
