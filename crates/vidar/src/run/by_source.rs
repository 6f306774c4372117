//! Errors of depth by where it comes from.

use serde::Serialize;
use vidar_core::{AlignedView, DepthSource, GeometryError, MetricDepth};

/// Largest relative error that counts as right.
const RIGHT_RATIO: f64 = 0.05;

/// How good the depth of one source is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SourceScore {
    /// Where the depth comes from.
    pub source: DepthSource,
    /// Share of the pixels with true depth, 0…1.
    pub share: f64,
    /// Mean of |d − g| / g.
    pub abs_rel: f64,
    /// Share within 5 % of the true depth.
    pub within_5_percent: f64,
    /// Share within the stated standard deviation of ln(depth); 0.76 where the errors are as stated.
    pub within_std: f64,
}

/// Sums of the errors of one source.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    count: usize,
    abs_rel: f64,
    right: usize,
    within_std: usize,
}

/// Sums by source, in the order of [`DepthSource::ALL`].
#[derive(Clone, Debug, Default)]
pub struct BySource {
    truth_pixels: usize,
    sums: [Sums; DepthSource::ALL.len()],
}

impl BySource {
    /// Adds a view with its true depth, of the same size.
    pub fn add(&mut self, view: &AlignedView, truth: &MetricDepth) {
        let Some(origins) = view.origin() else { return };
        let depths = view.depth().image().data().iter().zip(truth.image().data());
        for ((d, g), origin) in depths.zip(origins.data()) {
            self.truth_pixels += usize::from(!g.is_nan());
            let Some(sums) = (origin.source as usize).checked_sub(1).and_then(|i| self.sums.get_mut(i))
            else {
                continue;
            };
            if d.is_nan() || g.is_nan() {
                continue;
            }
            let (d, g) = (f64::from(*d), f64::from(*g));
            let relative = (d - g).abs() / g;
            sums.count += 1;
            sums.abs_rel += relative;
            sums.right += usize::from(relative < RIGHT_RATIO);
            sums.within_std += usize::from((d / g).ln().abs() < f64::from(origin.log_std));
        }
    }

    /// The sources that gave depth.
    pub fn scores(&self) -> Vec<SourceScore> {
        let score = |(source, sums): (DepthSource, &Sums)| {
            let n = sums.count as f64;
            (sums.count > 0).then(|| SourceScore {
                source,
                share: n / self.truth_pixels.max(1) as f64,
                abs_rel: sums.abs_rel / n,
                within_5_percent: sums.right as f64 / n,
                within_std: sums.within_std as f64 / n,
            })
        };
        DepthSource::ALL.into_iter().zip(&self.sums).filter_map(score).collect()
    }
}

/// The view without the pixels that are guessed.
pub fn without_guesses(view: &AlignedView) -> Result<AlignedView, GeometryError> {
    let mut depth = view.depth().image().clone();
    if let Some(origins) = view.origin() {
        for (z, origin) in depth.data_mut().iter_mut().zip(origins.data()) {
            *z = if origin.source.is_guess() { f32::NAN } else { *z };
        }
    }
    let (pose, k) = (*view.world_from_camera(), *view.intrinsics());
    let confidence = view.confidence().clone();
    AlignedView::new(view.frame_id(), view.time(), pose, k, MetricDepth::new(depth), confidence)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{Confidence, DepthOrigin, FrameId, Image, Pinhole, Se3, Timestamp};

    #[test]
    fn errors_are_counted_with_their_source_and_guesses_taken_out() {
        let image = |values: [f32; 4]| MetricDepth::new(Image::from_vec(4, 1, values.to_vec()).unwrap());
        let sources = [DepthSource::Stereo, DepthSource::Stereo, DepthSource::Network, DepthSource::None];
        let origins = sources.map(|source| DepthOrigin { source, log_std: 0.03 }).to_vec();
        let k = Pinhole::new(4.0, 4.0, 1.5, 0.0, 4, 1).unwrap();
        let view = AlignedView::new(
            FrameId(0),
            Timestamp::default(),
            Se3::IDENTITY,
            k,
            image([2.0, 2.2, 3.0, f32::NAN]),
            Confidence::full(4, 1),
        );
        let view = view.unwrap().with_origin(Image::from_vec(4, 1, origins).unwrap()).unwrap();
        let mut by_source = BySource::default();
        by_source.add(&view, &image([2.0, 2.0, 2.0, 2.0]));
        let scores = by_source.scores();
        assert_eq!(scores.len(), 2);
        let (stereo, network) = (scores[0], scores[1]);
        assert_eq!((stereo.source, stereo.share, network.share), (DepthSource::Stereo, 0.5, 0.25));
        assert!((stereo.abs_rel - 0.05).abs() < 1e-6 && (network.abs_rel - 0.5).abs() < 1e-6);
        assert_eq!((stereo.within_5_percent, stereo.within_std, network.within_std), (0.5, 0.5, 0.0));
        let measured = without_guesses(&view).unwrap();
        let depth = measured.depth().image().data();
        assert!(depth[..2].iter().all(|z| z.is_finite()) && depth[2..].iter().all(|z| z.is_nan()));
    }
}
