//! Complete: depth for the pixels that stereo left empty, once the surface of all of them is known.
//!
//! The surface by stereo alone is seen from every keyframe, planes and a network's shape fill what it leaves
//! ([`vidar_stereo::complete`]). The surface that is rendered stays as it was: what is filled in one view never supports what
//! is filled in another, so the result depends on no order. Planes join the map; guesses do not, and what the map itself showed
//! is in it already.

use super::Sink;
use super::events::MapEvent;
use super::fuse::SurfaceFusion;
use super::placed::Shaped;
use super::views::blanked;
use crate::error::Error;
use rayon::prelude::*;
use vidar_core::{
    AlignedView, ChunkId, Confidence, DepthOrigin, DepthSource, GeometryError, Image, MetricDepth,
    TriangleMesh,
};
use vidar_fusion::SurfaceRenderer;
use vidar_stereo::StereoError;
use vidar_stereo::complete::{ErrorStatistics, Evidence, Spread, complete, errors_where_hidden};

/// Chunks, and views of each, at which errors are observed, spread over the recording: errors of a room's walls are much the
/// same in all of its views, and a long recording should not pay more.
const SAMPLED_CHUNKS: usize = 6;
const SAMPLED_VIEWS: usize = 2;

/// Completes the placed views of `chunks`, which `read` gives, from the surface so far, whose triangles are `mesh`, and adds to it what of that is sure.
/// Once stopped, the views that are left are told as the surface has them.
pub fn complete_chunks(
    chunks: &[ChunkId],
    read: &dyn Fn(ChunkId) -> Result<Vec<Shaped>, Error>,
    mesh: &TriangleMesh,
    surface: &mut SurfaceFusion,
    is_stopped: &dyn Fn() -> bool,
    sink: &mut Sink<'_>,
) -> Result<(), Error> {
    let mut done = 0;
    if !is_stopped() {
        let mut samples: Vec<Shaped> = Vec::new();
        for chunk in spread_over(chunks.to_vec(), SAMPLED_CHUNKS) {
            samples.extend(spread_over(read(chunk)?, SAMPLED_VIEWS));
        }
        let completion = Completion::new(mesh, &samples)?;
        drop(samples);
        while done < chunks.len() && !is_stopped() {
            let views = completion.complete(&read(chunks[done])?)?;
            let planes = views.iter().map(planes_alone).collect::<Result<Vec<_>, _>>()?;
            surface.fuse(&planes).into_iter().try_for_each(&mut *sink)?;
            sink(MapEvent::ViewsFused(views))?;
            done += 1;
        }
    }
    chunks[done..].iter().try_for_each(|chunk| {
        let views = read(*chunk)?.into_iter().map(|shaped| shaped.view).collect();
        sink(MapEvent::ViewsFused(views))
    })
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
        Ok(completion)
    }

    /// The views with depth at every pixel.
    fn complete(&self, views: &[Shaped]) -> Result<Vec<AlignedView>, Error> {
        let one = |v: &Shaped| {
            let completed = self.with_evidence(v, |evidence| complete(&v.view, evidence, &self.spread));
            let completed = completed.map_err(unfit)?;
            match &v.mask {
                Some(mask) => without(&completed, mask),
                None => Ok(completed),
            }
        };
        // Collected one by one, so that the error is that of the first bad view.
        let completed: Vec<_> = views.par_iter().map(one).collect();
        completed.into_iter().collect()
    }

    fn with_evidence<R>(&self, shaped: &Shaped, work: impl FnOnce(&Evidence<'_>) -> R) -> R {
        let (view, k) = (&shaped.view, shaped.view.intrinsics());
        let mut seen = self.renderer.render(view.world_from_camera(), k);
        // What is masked stands in front of what the map shows there.
        if let Some(mask) = &shaped.mask {
            for (z, _) in seen.depth.data_mut().iter_mut().zip(mask.data()).filter(|(_, masked)| **masked) {
                *z = f32::NAN;
            }
        }
        let network = shaped.shape.as_ref().map(|s| at_size(s, k.width, k.height));
        work(&Evidence { map: &seen.depth, network: network.as_ref() })
    }
}

/// A view without the pixels that are not to be used.
pub(super) fn without(view: &AlignedView, mask: &Image<bool>) -> Result<AlignedView, Error> {
    let k = view.intrinsics();
    let depth = MetricDepth::new(blanked(view.depth().image(), mask, f32::NAN));
    let confidence = Confidence::new(blanked(view.confidence().image(), mask, 0.0));
    let pose = *view.world_from_camera();
    let mut out =
        AlignedView::new(view.frame_id(), view.time(), pose, *k, depth, confidence).map_err(unfit)?;
    if let Some(color) = view.color() {
        out = out.with_color(color.clone()).map_err(unfit)?;
    }
    if let Some(origin) = view.origin() {
        out = out.with_origin(blanked(origin, mask, DepthOrigin::NONE)).map_err(unfit)?;
    }
    Ok(out)
}

/// Of completed views what the map does not hold yet: the planes. Other pixels keep their depth, so that slopes and free space
/// are right, and get no confidence.
fn planes_alone(view: &AlignedView) -> Result<AlignedView, Error> {
    let k = view.intrinsics();
    let own = view.confidence().image();
    let is_plane = |at: (usize, usize)| view.origin().is_some_and(|o| o[at].source == DepthSource::Plane);
    let confidence = |x: usize, y: usize| if is_plane((x, y)) { own[(x, y)] } else { 0.0 };
    let confidence = Confidence::new(Image::from_fn(k.width, k.height, confidence));
    let pose = *view.world_from_camera();
    let planes = AlignedView::new(view.frame_id(), view.time(), pose, *k, view.depth().clone(), confidence)
        .map_err(unfit)?;
    match view.color() {
        Some(color) => planes.with_color(color.clone()).map_err(unfit),
        None => Ok(planes),
    }
}

/// Images of one view differ in size.
fn unfit(error: GeometryError) -> Error {
    StereoError::Internal { what: error.to_string() }.into()
}

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
