//! What a run gives to the three-dimensional view of its report and of comparisons: small pictures of keyframes, and the standard
//! deviation of depth where the run knows it.

use crate::run::pose_of;
use crate::run_folder::StoredView;
use crate::system::read_up_to;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{FilterType, resize};
use rayon::prelude::*;
use std::path::Path;
use vidar_core::{Image, LieGroup, PointCloud, Se3, Sim3, StampedPose, Trajectory, TriangleMesh};
use vidar_export::STD_STEP;
use vidar_view::{DepthThumbnail, Field, FieldKind, FieldValues, PaneScale, PosedThumbnail};

/// Keyframes with pictures in a view: with about 12 kB each they take half a megabyte of the page.
pub(crate) const MAX_THUMBNAILS: usize = 40;
/// Columns of a small picture: twice those that a card in the page shows on an ordinary screen would be wasted.
const THUMBNAIL_COLUMNS: usize = 192;
/// Quality of the small JPEGs, where blocks are not yet seen at that size.
const JPEG_QUALITY: u8 = 72;
/// Every n-th column and row of a depth image takes part in the standard deviation of the surface.
const SIGMA_STRIDE: usize = 3;
/// Keyframes that take part in it, spread evenly: on a long recording the samples of all would not fit into memory.
const MOST_SIGMA_VIEWS: usize = 300;
/// Images of a run are smaller.
const MAX_IMAGE_BYTES: u64 = 64 << 20;
/// Part of the samples below the end of a colour scale.
const SCALE_SHARE: f64 = 0.95;

/// The keyframes of a run with small pictures, spread evenly; `pane_from_world` brings them into the view's world.
pub(crate) fn thumbnails(
    run: &Path,
    views: &[StoredView],
    units_per_metre: Option<f64>,
    pane_from_world: &Sim3,
    most: usize,
) -> Vec<PosedThumbnail> {
    let n = most.min(views.len());
    let chosen: Vec<&StoredView> = (0..n).map(|i| &views[i * views.len() / n]).collect();
    let one = |view: &&StoredView| {
        Some(PosedThumbnail {
            frame: view.frame,
            time_ns: view.time_ns,
            world_from_camera: pane_from_world.transform_pose(&pose_of(view)?),
            intrinsics: view.intrinsics,
            image_jpeg: view.image.as_ref().and_then(|file| small_jpeg(&run.join(file))),
            depth: small_depth(run, view, units_per_metre),
        })
    };
    let made: Vec<Option<PosedThumbnail>> = chosen.par_iter().map(one).collect();
    made.into_iter().flatten().collect()
}

/// A picture that cannot be read is left out: the view is none the worse for the others.
fn small_jpeg(path: &Path) -> Option<Vec<u8>> {
    let picture = vidar_dataset::decode::read_image(path).ok()?.to_rgb8();
    let (width, height) = (u32::try_from(picture.width()).ok()?, u32::try_from(picture.height()).ok()?);
    let full = image::RgbImage::from_raw(width, height, picture.data().as_flattened().to_vec())?;
    let columns = width.min(THUMBNAIL_COLUMNS as u32);
    let small = resize(&full, columns, (height * columns / width.max(1)).max(1), FilterType::Triangle);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY).encode_image(&small).ok()?;
    Some(jpeg)
}

fn small_depth(run: &Path, view: &StoredView, units_per_metre: Option<f64>) -> Option<DepthThumbnail> {
    let depth = depth_of(run, view, units_per_metre)?;
    vidar_view::depth_thumbnail(&depth, THUMBNAIL_COLUMNS).ok()
}

fn depth_of(run: &Path, view: &StoredView, units_per_metre: Option<f64>) -> Option<Image<f32>> {
    let png = read_up_to(&run.join(view.depth.as_ref()?), MAX_IMAGE_BYTES).ok()?;
    Some(vidar_export::read_depth_png(&png, units_per_metre?).ok()?.image().clone())
}

/// Values at places.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    /// Where, in the world of the view.
    pub positions: Vec<[f32; 3]>,
    /// One value each.
    pub values: Vec<f32>,
}

/// Standard deviation of depth (m) at the places that the keyframes saw; none where the run has none per pixel.
///
/// It is that of one view. Views are not averaged: neighbouring ones share images, so their errors are not independent.
pub(crate) fn depth_std(
    run: &Path,
    views: &[StoredView],
    units_per_metre: Option<f64>,
    pane_from_world: &Sim3,
) -> Option<Samples> {
    let of_view = |view: &StoredView| -> Option<Samples> {
        let png = read_up_to(&run.join(view.depth_std.as_ref()?), MAX_IMAGE_BYTES).ok()?;
        let steps = image::load_from_memory_with_format(&png, image::ImageFormat::Png).ok()?.into_luma8();
        let depth = depth_of(run, view, units_per_metre)?;
        let world_from_camera = pose_of(view)?;
        Some(samples_of(&depth, &steps, view, &world_from_camera, pane_from_world))
    };
    let every = views.len().div_ceil(MOST_SIGMA_VIEWS).max(1);
    let parts: Vec<Option<Samples>> = views.par_iter().step_by(every).map(of_view).collect();
    let mut all = Samples::default();
    for part in parts.into_iter().flatten() {
        all.positions.extend(part.positions);
        all.values.extend(part.values);
    }
    (!all.values.is_empty()).then_some(all)
}

fn samples_of(
    depth: &Image<f32>,
    steps: &image::GrayImage,
    view: &StoredView,
    world_from_camera: &Se3,
    pane_from_world: &Sim3,
) -> Samples {
    let mut samples = Samples::default();
    let k = &view.intrinsics;
    for y in (0..depth.height().min(steps.height() as usize)).step_by(SIGMA_STRIDE) {
        for x in (0..depth.width().min(steps.width() as usize)).step_by(SIGMA_STRIDE) {
            let z = f64::from(depth[(x, y)]);
            let step = steps.get_pixel(x as u32, y as u32)[0];
            if !(z > 0.0) || step == 0 {
                continue;
            }
            let ray = nalgebra::Vector3::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy, 1.0);
            let place = pane_from_world.act(&(*world_from_camera * (ray * z)));
            samples.positions.push([place.x as f32, place.y as f32, place.z as f32]);
            samples.values.push((z * pane_from_world.scale) as f32 * f32::from(step) * STD_STEP);
        }
    }
    samples
}

/// 0 and a round value that nearly all samples are below, at least `least`.
pub(crate) fn scale_range(values: &[f32], least: f32) -> (f32, f32) {
    // A million samples are enough for a quantile.
    let stride = (values.len() / 1_000_000).max(1);
    let mut finite: Vec<f32> = values.iter().step_by(stride).copied().filter(|v| v.is_finite()).collect();
    finite.sort_unstable_by(f32::total_cmp);
    let at = (finite.len() as f64 * SCALE_SHARE) as usize;
    let high = finite.get(at).or(finite.last()).copied().unwrap_or(least);
    (0.0, vidar_view::nice_step(f64::from(high.max(least)), 1) as f32)
}

/// Confidence where the surface carries it.
pub(crate) fn confidence_field(mesh: &TriangleMesh, cloud: &PointCloud) -> Field<'static> {
    let values = match mesh.confidences.is_empty() && cloud.confidences.is_empty() {
        true => FieldValues::Missing("the map carries none".into()),
        false => FieldValues::Own,
    };
    Field { kind: FieldKind::Confidence, label: "confidence".into(), values }
}

/// Standard deviation of depth, or that there is none.
pub(crate) fn sigma_field<'a>(samples: Option<&'a Samples>, unit: &str) -> Field<'a> {
    let values = match samples {
        Some(s) => FieldValues::Samples {
            positions: &s.positions,
            values: &s.values,
            // One centimetre: below it every surface would look uncertain.
            range: scale_range(&s.values, 0.01),
        },
        None => FieldValues::Missing("only --geometry auto states it per pixel".into()),
    };
    Field { kind: FieldKind::Sigma, label: format!("standard deviation of depth [{unit}]"), values }
}

/// What is stated of a scale, as the view shows it.
pub(crate) fn pane_scale(is_metric: bool, sigma: Option<f64>) -> PaneScale {
    match is_metric {
        true => PaneScale::Metric { log_std: sigma },
        false => PaneScale::Arbitrary,
    }
}

/// The unit of lengths on screen.
pub(crate) fn unit_name(is_metric: bool) -> &'static str {
    if is_metric { "m" } else { "units" }
}

/// A trajectory in another frame; none where the similarity makes it invalid.
pub(crate) fn moved_trajectory(trajectory: &Trajectory, a_from_b: &Sim3) -> Option<Trajectory> {
    let moved = |p: &StampedPose| StampedPose {
        time: p.time,
        world_from_body: a_from_b.transform_pose(&p.world_from_body),
    };
    Trajectory::new(trajectory.body(), trajectory.poses().iter().map(moved).collect()).ok()
}

/// Positions and normals of a surface in another frame.
pub(crate) fn move_surface(positions: &mut [[f32; 3]], normals: &mut [[f32; 3]], a_from_b: &Sim3) {
    let as_f32 = |v: nalgebra::Vector3<f64>| [v.x as f32, v.y as f32, v.z as f32];
    for p in positions {
        *p = as_f32(a_from_b.act(&nalgebra::Vector3::from(p.map(f64::from))));
    }
    for n in normals {
        *n = as_f32(a_from_b.rotation * nalgebra::Vector3::from(n.map(f64::from)));
    }
}

/// The inverse as a similarity.
pub(crate) fn inverse(a_from_b: &Se3) -> Sim3 {
    Sim3::from_se3(&a_from_b.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colour_scale_ends_at_a_round_value_above_nearly_all() {
        let values: Vec<f32> = (0..1000).map(|i| i as f32 * 1e-4).collect();
        let (low, high) = scale_range(&values, 0.01);
        assert!(low == 0.0 && (0.095..=0.2).contains(&high), "{high}");
        assert_eq!(scale_range(&[], 0.01).1, scale_range(&[f32::NAN, 0.0], 0.01).1);
    }
}
