//! Depth for the pixels that stereo leaves empty, each with its source and its standard deviation.
//!
//! ```text
//! own stereo ─▶ the fused surface seen from here ─▶ planes on untextured regions ─▶ a network, or interpolation, bent onto
//!                                                                                   all of these
//! ```
//!
//! Every step fills only what those before it left. The first three are measured; the last is a guess, exact beside what is
//! measured and unknown far from it. How wrong each source is, is not derived but observed: [`ErrorStatistics`] compares, in
//! the pixels that stereo left empty and the fused surface knows, what planes and guesses would have said there.

mod bend;
mod planes;
mod regions;
mod spread;

pub use spread::{ErrorStatistics, Spread};

use crate::confidence::TOLERANCE_RATIO;
use crate::elementary;
use regions::{Regions, luminance};
use tracing::trace_span;
use vidar_core::{AlignedView, Confidence, DepthOrigin, DepthSource, GeometryError, Image, MetricDepth};

/// What is known of a view besides its own stereo, at the size of its depth.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// z-depth of the fused surface, metres; NaN where none is seen.
    pub map: &'a Image<f32>,
    /// z-depth by a network, in any unit; NaN where it says nothing.
    pub network: Option<&'a Image<f32>>,
}

/// The view with depth at every pixel, and the origin of each.
///
/// `view` holds its own stereo. The confidences of the added pixels are the probabilities of an error below
/// [`TOLERANCE_RATIO`], as those of stereo are. A view without any depth stays as it is. `evidence` has the view's size.
///
/// # Errors
/// The sizes differ.
pub fn complete(
    view: &AlignedView,
    evidence: &Evidence<'_>,
    spread: &Spread,
) -> Result<AlignedView, GeometryError> {
    let canvas = Canvas::of(view, Some(evidence.map), evidence.network)?;
    let mut filled = Filled::of_measured(&canvas);
    filled.add_planes(&canvas);
    let origin = filled.origins(&canvas, spread);
    filled.view(view, &canvas, origin)
}

/// What of `view` would have been filled how, had the fused surface not been known, against that surface.
///
/// # Errors
/// The sizes differ.
pub fn errors_where_hidden(
    view: &AlignedView,
    evidence: &Evidence<'_>,
) -> Result<ErrorStatistics, GeometryError> {
    let canvas = Canvas::of(view, None, evidence.network)?;
    let mut filled = Filled::of_measured(&canvas);
    filled.add_planes(&canvas);
    let distance = filled.distances(&canvas);
    let guess = filled.bent(&canvas);
    let mut statistics = ErrorStatistics::default();
    let map = Canvas::logarithms(evidence.map, canvas.width, canvas.height)?;
    for (i, truth) in map.iter().enumerate().filter(|(_, truth)| truth.is_finite()) {
        match filled.source[i] {
            DepthSource::Stereo => statistics.push_map(filled.log_depth[i] - truth),
            DepthSource::Plane => statistics.push_plane(filled.log_depth[i] - truth, filled.log_std[i]),
            _ => statistics.push_guess(guess[i] - truth, distance[i], canvas.width),
        }
    }
    Ok(statistics)
}

/// A view as the steps see it: rows of pixels, depths as logarithms, NaN for none.
struct Canvas {
    width: usize,
    height: usize,
    k: vidar_core::Pinhole,
    stereo: Vec<f32>,
    confidence: Vec<f32>,
    map: Option<Vec<f32>>,
    network: Option<Vec<f32>>,
    luminance: Vec<f32>,
}

impl Canvas {
    fn of(
        view: &AlignedView,
        map: Option<&Image<f32>>,
        network: Option<&Image<f32>>,
    ) -> Result<Self, GeometryError> {
        let k = *view.intrinsics();
        let (width, height) = (k.width, k.height);
        let logarithms = |image| Self::logarithms(image, width, height);
        Ok(Self {
            width,
            height,
            k,
            stereo: logarithms(view.depth().image())?,
            confidence: view.confidence().image().data().to_vec(),
            map: map.map(logarithms).transpose()?,
            network: network.map(logarithms).transpose()?,
            luminance: luminance(view.color(), width, height),
        })
    }

    fn logarithms(image: &Image<f32>, width: usize, height: usize) -> Result<Vec<f32>, GeometryError> {
        vidar_core::geometry::check_size("depth to complete from", image, width, height)?;
        let log = |z: &f32| if *z > 0.0 && z.is_finite() { elementary::ln(*z) } else { f32::NAN };
        Ok(image.data().iter().map(log).collect())
    }
}

/// A depth image that is being filled.
struct Filled {
    log_depth: Vec<f32>,
    source: Vec<DepthSource>,
    /// Of ln(depth); of stereo and map NaN until all is filled.
    log_std: Vec<f32>,
}

impl Filled {
    /// Own stereo, then the surface.
    fn of_measured(canvas: &Canvas) -> Self {
        let n = canvas.stereo.len();
        let mut filled = Self {
            log_depth: canvas.stereo.clone(),
            source: vec![DepthSource::None; n],
            log_std: vec![f32::NAN; n],
        };
        for i in 0..n {
            if filled.log_depth[i].is_finite() {
                filled.source[i] = DepthSource::Stereo;
            } else if let Some(map) = canvas.map.as_ref().filter(|m| m[i].is_finite()) {
                (filled.log_depth[i], filled.source[i]) = (map[i], DepthSource::Map);
            }
        }
        filled
    }

    fn add_planes(&mut self, canvas: &Canvas) {
        let _span = trace_span!("planes").entered();
        let regions = Regions::of(&canvas.luminance, canvas.width, canvas.height);
        for plane in planes::fit_all(&regions, &self.log_depth, &canvas.k) {
            for (i, log_depth, log_std) in plane.pixels {
                self.log_depth[i] = log_depth;
                self.log_std[i] = log_std;
                self.source[i] = DepthSource::Plane;
            }
        }
    }

    fn distances(&self, canvas: &Canvas) -> Vec<f32> {
        bend::distances(&self.log_depth, canvas.width, canvas.height)
    }

    fn bent(&self, canvas: &Canvas) -> Vec<f32> {
        let _span = trace_span!("bend").entered();
        let shape = canvas.network.as_deref();
        bend::bend(&self.log_depth, shape, &canvas.luminance, canvas.width, canvas.height)
    }

    /// Fills the rest by guesses and gives every pixel its standard deviation.
    fn origins(&mut self, canvas: &Canvas, spread: &Spread) -> Vec<DepthOrigin> {
        if self.log_depth.iter().all(|d| d.is_nan()) {
            return vec![DepthOrigin::NONE; self.source.len()];
        }
        let distance = self.distances(canvas);
        let bent = self.bent(canvas);
        let shared = spread.typical_of_stereo(&canvas.confidence);
        let guess = match canvas.network {
            Some(_) => DepthSource::Network,
            None => DepthSource::Interpolation,
        };
        let mut origins = Vec::with_capacity(bent.len());
        for (i, bent) in bent.into_iter().enumerate() {
            let log_std = match self.source[i] {
                DepthSource::Stereo => spread.stereo(canvas.confidence[i]),
                DepthSource::Map => spread.map(shared),
                DepthSource::Plane => spread.plane(self.log_std[i], shared),
                _ => {
                    (self.log_depth[i], self.source[i]) = (bent, guess);
                    spread.guess(distance[i], canvas.width)
                }
            };
            origins.push(DepthOrigin { source: self.source[i], log_std });
        }
        origins
    }

    fn view(
        self,
        view: &AlignedView,
        canvas: &Canvas,
        origins: Vec<DepthOrigin>,
    ) -> Result<AlignedView, GeometryError> {
        let (width, height) = (canvas.width, canvas.height);
        let own = view.depth().image().data();
        let depth = |i: usize| match self.source[i] {
            DepthSource::Stereo => own[i],
            DepthSource::None => f32::NAN,
            _ => elementary::exp(self.log_depth[i]),
        };
        let confidence = |i: usize| match self.source[i] {
            DepthSource::Stereo => canvas.confidence[i],
            DepthSource::None => 0.0,
            _ => spread::probability_within(TOLERANCE_RATIO, origins[i].log_std),
        };
        let image = |of: &dyn Fn(usize) -> f32| Image::from_fn(width, height, |x, y| of(y * width + x));
        let (depth, confidence) = (image(&depth), image(&confidence));
        let origins = Image::from_fn(width, height, |x, y| origins[y * width + x]);
        let completed = AlignedView::new(
            view.frame_id(),
            view.time(),
            *view.world_from_camera(),
            *view.intrinsics(),
            MetricDepth::new(depth),
            Confidence::new(confidence),
        )?;
        let completed = completed.with_origin(origins)?;
        match view.color() {
            Some(color) => completed.with_color(color.clone()),
            None => Ok(completed),
        }
    }
}

#[cfg(test)]
mod tests;
