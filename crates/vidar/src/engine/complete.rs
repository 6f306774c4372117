//! Complete: depth for the pixels that stereo left empty, once the surface of all of them is known.
//!
//! The surface by stereo alone is seen from every keyframe, planes and a network's shape fill what it leaves
//! ([`vidar_stereo::complete`]). The surface that is rendered stays as it was: what is filled in one view never supports what
//! is filled in another, so the result depends on no order. Into the map go planes, and of the guesses those that views of
//! other directions confirm.

use super::Sink;
use super::events::MapEvent;
use super::fuse::SurfaceFusion;
use super::placed::{Shaped, placed_and_shaped};
use super::setup::{PredictionId, PredictionStore};
use crate::error::Error;
use rayon::prelude::*;
use vidar_align::Placement;
use vidar_core::{
    AlignedView, ChunkId, Confidence, DepthSource, GeometryError, Image, LieGroup, TriangleMesh,
};
use vidar_fusion::SurfaceRenderer;
use vidar_stereo::StereoError;
use vidar_stereo::complete::{ErrorStatistics, Evidence, Spread, complete, errors_where_hidden};

/// Views that confirm a guess, and the relative difference up to which they do: stereo's own `agreement_ratio`.
const CONFIRMING_VIEWS: usize = 2;
const CONFIRMED_RATIO: f64 = 0.02;
/// Least angle between the rays of two views that confirm each other: guesses from one place err alike.
const LEAST_ANGLE_COS: f64 = 0.996_194_698;
/// Confidence of a confirmed guess: just above what fusion takes by default, so that it never outweighs a measurement.
const CONFIRMED: f32 = 0.35;

/// Chunks, and views of each, at which errors are observed, spread over the recording: errors of a room's walls are much the
/// same in all of its views, and a long recording should not pay more.
const SAMPLED_CHUNKS: usize = 6;
const SAMPLED_VIEWS: usize = 2;

/// Completes the placed views of `chunks` from the surface so far, and adds to it what of that is sure.
pub fn complete_chunks(
    placement: &Placement,
    chunks: &[ChunkId],
    store: &dyn PredictionStore,
    surface: &mut SurfaceFusion,
    is_stopped: &dyn Fn() -> bool,
    sink: &mut Sink<'_>,
) -> Result<(), Error> {
    let read = |chunk: ChunkId| placed_and_shaped(placement, store.read(PredictionId::Chunk(chunk))?);
    let mesh = surface.mesh();
    let mut samples: Vec<Shaped> = Vec::new();
    for chunk in spread_over(chunks.to_vec(), SAMPLED_CHUNKS) {
        samples.extend(spread_over(read(chunk)?, SAMPLED_VIEWS));
    }
    let completion = Completion::new(&mesh, &samples)?;
    drop(samples);
    for chunk in chunks {
        if is_stopped() {
            break;
        }
        let views = completion.complete(&read(*chunk)?)?;
        surface.fuse(&confirmed(&views)?).into_iter().try_for_each(&mut *sink)?;
        sink(MapEvent::ViewsFused(views))?;
    }
    Ok(())
}

/// At most `most` of the items, evenly spread.
fn spread_over<T>(items: Vec<T>, most: usize) -> Vec<T> {
    let (n, most) = (items.len(), most.min(items.len()));
    let is_taken = |i: usize| (0..most).any(|k| (2 * k + 1) * n / (2 * most) == i);
    items.into_iter().enumerate().filter(|(i, _)| is_taken(*i)).map(|(_, item)| item).collect()
}

/// Completes views from one surface.
pub struct Completion<'m> {
    renderer: SurfaceRenderer<'m>,
    spread: Spread,
}

impl<'m> Completion<'m> {
    /// From the surface by stereo alone; `samples` are views at which errors are observed.
    fn new(mesh: &'m TriangleMesh, samples: &[Shaped]) -> Result<Self, Error> {
        let mut completion = Self { renderer: SurfaceRenderer::new(mesh), spread: Spread::default() };
        let observe = |sample: &Shaped| {
            let errors =
                completion.with_evidence(sample, |evidence| errors_where_hidden(&sample.view, evidence));
            errors.map_err(unfit)
        };
        let observed: Vec<_> = samples.par_iter().map(observe).collect();
        let mut statistics = ErrorStatistics::default();
        for one in observed {
            statistics.add(&one?);
        }
        completion.spread = statistics.spread(&completion.spread);
        #[allow(clippy::print_stderr)]
        { eprintln!("DBG {:?}", completion.spread); }
        Ok(completion)
    }

    /// The views with depth at every pixel.
    fn complete(&self, views: &[Shaped]) -> Result<Vec<AlignedView>, Error> {
        let one = |v: &Shaped| {
            let completed = self.with_evidence(v, |evidence| complete(&v.view, evidence, &self.spread));
            completed.map_err(unfit)
        };
        // Collected one by one, so that the error is that of the first bad view.
        let completed: Vec<_> = views.par_iter().map(one).collect();
        completed.into_iter().collect()
    }

    fn with_evidence<R>(&self, shaped: &Shaped, work: impl FnOnce(&Evidence<'_>) -> R) -> R {
        let (view, k) = (&shaped.view, shaped.view.intrinsics());
        let seen = self.renderer.render(view.world_from_camera(), k);
        let network = shaped.shape.as_ref().map(|s| at_size(s, k.width, k.height));
        work(&Evidence { map: &seen.depth, network: network.as_ref() })
    }
}

/// Of completed views what the map does not hold yet: planes, and guesses that other views confirm. Other pixels keep their
/// depth, so that slopes and free space are right, and get no confidence.
fn confirmed(views: &[AlignedView]) -> Result<Vec<AlignedView>, Error> {
    let one = |(number, view): (usize, &AlignedView)| {
        let others: Vec<&AlignedView> =
            views.iter().enumerate().filter(|(i, _)| *i != number).map(|(_, v)| v).collect();
        newly_known(view, &others)
    };
    let found: Vec<_> = views.par_iter().enumerate().map(one).collect();
    found.into_iter().collect()
}

fn newly_known(view: &AlignedView, others: &[&AlignedView]) -> Result<AlignedView, Error> {
    let k = view.intrinsics();
    let own = view.confidence().image();
    let confidence = |x: usize, y: usize| match view.origin().map(|o| o[(x, y)].source) {
        Some(DepthSource::Plane) if std::env::var("DA_NOPLANE").is_ok() => 0.0,
        Some(DepthSource::Plane) => own[(x, y)],
        Some(source) if std::env::var("DA_NOCONF").is_err() && source.is_guess() && is_confirmed(view, (x, y), others) => CONFIRMED,
        _ => 0.0,
    };
    let confidence = Confidence::new(Image::from_fn(k.width, k.height, confidence));
    let pose = *view.world_from_camera();
    let found =
        AlignedView::new(view.frame_id(), view.time(), pose, *k, view.depth().clone(), confidence)
            .map_err(unfit)?;
    match view.color() {
        Some(color) => found.with_color(color.clone()).map_err(unfit),
        None => Ok(found),
    }
}

/// Images of one view differ in size.
fn unfit(error: GeometryError) -> Error {
    StereoError::Internal { what: error.to_string() }.into()
}

/// Whether enough other views, from other directions, have the same depth where this pixel is.
fn is_confirmed(view: &AlignedView, (x, y): (usize, usize), others: &[&AlignedView]) -> bool {
    let (k, z) = (view.intrinsics(), f64::from(view.depth().image()[(x, y)]));
    let ray = nalgebra::Vector3::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy, 1.0);
    let point = *view.world_from_camera() * (ray * z);
    let agrees = |other: &&&AlignedView| {
        let in_other = other.world_from_camera().inverse() * point;
        let Some(pixel) = other.intrinsics().project(&in_other) else { return false };
        let (u, v) = (pixel.x.round(), pixel.y.round());
        let k = other.intrinsics();
        if !(u >= 0.0 && v >= 0.0 && u < k.width as f64 && v < k.height as f64) {
            return false;
        }
        let there = f64::from(other.depth().image()[(u as usize, v as usize)]);
        let towards = point - other.world_from_camera().translation;
        let from_here = point - view.world_from_camera().translation;
        let cos = towards.dot(&from_here) / (towards.norm() * from_here.norm());
        (there / in_other.z - 1.0).abs() < dbg_env("DA_R", CONFIRMED_RATIO) && cos < dbg_env("DA_A", LEAST_ANGLE_COS)
    };
    let n = dbg_env("DA_V", CONFIRMING_VIEWS as f64) as usize;
    f64::from(view.origin().map_or(0.0, |o| o[(x, y)].log_std)) < dbg_env("DA_S", 9.0) && others.iter().filter(agrees).take(n).count() == n
}
fn dbg_env(name: &str, default: f64) -> f64 { std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default) }

/// An image at another size, pixel centres kept (`c' = (c + 0.5)·s − 0.5`): bilinear, or the nearest where one of the four
/// pixels is NaN.
fn at_size(image: &Image<f32>, width: usize, height: usize) -> Image<f32> {
    let place = |at: usize, size: usize, of: usize| {
        let c = ((at as f32 + 0.5) * of as f32 / size as f32 - 0.5).clamp(0.0, of as f32 - 1.0);
        let low = (c as usize).min(of.saturating_sub(2));
        (low, (low + 1).min(of - 1), c - low as f32)
    };
    Image::from_fn(width, height, |x, y| {
        let (x0, x1, fx) = place(x, width, image.width());
        let (y0, y1, fy) = place(y, height, image.height());
        let row = |y: usize| image[(x0, y)] * (1.0 - fx) + image[(x1, y)] * fx;
        let value = row(y0) * (1.0 - fy) + row(y1) * fy;
        let nearest = (if fx < 0.5 { x0 } else { x1 }, if fy < 0.5 { y0 } else { y1 });
        if value.is_nan() { image[nearest] } else { value }
    })
}
