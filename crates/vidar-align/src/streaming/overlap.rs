//! Two predictions of the same images, tied by the points they share.

use super::{AlignMethod, IrlsConfig, IrlsOutcome, StreamingError, fit_irls};
use nalgebra::Vector3;
use vidar_core::Sim3;

/// Points and confidences of the frames of an overlap, frame after frame, row-major.
#[derive(Clone, Debug, Default)]
pub struct PointMap {
    /// Points in chunk units.
    pub points: Vec<Vector3<f64>>,
    /// Confidence of each, 0 or more (the network's value less 1).
    pub confidence: Vec<f32>,
    /// Points per frame.
    pub frame_len: usize,
}

/// How an overlap fits.
#[derive(Clone, Debug)]
pub struct OverlapFit {
    /// Maps the source chunk to the target chunk.
    pub target_from_source: Sim3,
    /// Pairs that took part.
    pub pairs: usize,
    /// Share of them within the Huber width at the end.
    pub inlier_ratio: f64,
    /// Their weighted root-mean-square residual at the end, in units of the target chunk.
    pub rms: f64,
    /// How the fit came about.
    pub trace: IrlsOutcome,
}

/// Share of the smaller median that a confidence must exceed.
const CONFIDENCE_SHARE: f32 = 0.1;

/// Fits the source's points onto the target's, pixel for pixel.
///
/// A pixel takes part when its confidence in both exceeds a tenth of the smaller of the two medians; its weight is the
/// geometric mean of the two. Points that are not finite never take part (the reference passes them on, and its
/// decomposition fails). Frames beyond the shorter of the two maps are left out, though not out of the medians.
///
/// # Errors
/// [`StreamingError::NoPairs`], and those of the fit.
pub fn align_overlap(
    target: &PointMap,
    source: &PointMap,
    method: AlignMethod,
    source_scale: f64,
    config: &IrlsConfig,
) -> Result<OverlapFit, StreamingError> {
    let frames = |m: &PointMap| m.points.len().checked_div(m.frame_len).unwrap_or(0);
    let shared = frames(target).min(frames(source)) * target.frame_len.min(source.frame_len);
    for (what, map) in [("target confidences", target), ("source confidences", source)] {
        if map.confidence.len() != map.points.len() {
            let (found, expected) = (map.confidence.len(), map.points.len());
            return Err(StreamingError::WrongLength { what, found, expected });
        }
    }
    if target.frame_len != source.frame_len {
        let (found, expected) = (source.frame_len, target.frame_len);
        return Err(StreamingError::WrongLength { what: "source points per frame", found, expected });
    }
    let threshold = CONFIDENCE_SHARE * median(&target.confidence).min(median(&source.confidence));
    let (mut x, mut y, mut w) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..shared {
        let (ct, cs) = (target.confidence[i], source.confidence[i]);
        let finite = target.points[i].iter().chain(source.points[i].iter()).all(|v| v.is_finite());
        if ct > threshold && cs > threshold && finite {
            x.push(source.points[i] * source_scale);
            y.push(target.points[i]);
            w.push(f64::from((ct * cs).sqrt()));
        }
    }
    if x.is_empty() {
        return Err(StreamingError::NoPairs);
    }
    let trace = fit_irls(&x, &y, &w, method, config)?;
    let fit = trace.target_from_source;
    let (mut inside, mut squares) = (0usize, 0.0);
    for ((x, y), w) in x.iter().zip(&y).zip(&w) {
        let residual = (y - vidar_core::LieGroup::act(&fit, x)).norm();
        inside += usize::from(residual <= config.huber_delta);
        squares += w * residual * residual;
    }
    Ok(OverlapFit {
        // y = R (s₀ x) + t: the scale from the depth maps goes back into the similarity.
        target_from_source: Sim3 { scale: fit.scale * source_scale, ..fit },
        pairs: x.len(),
        inlier_ratio: inside as f64 / x.len() as f64,
        rms: (squares / w.iter().sum::<f64>()).sqrt(),
        trace,
    })
}

/// The median, the mean of the two central values for an even count; 0 for none. NaN counts as smallest.
pub(super) fn median(values: &[f32]) -> f32 {
    let mut values: Vec<f32> =
        values.iter().map(|v| if v.is_nan() { f32::NEG_INFINITY } else { *v }).collect();
    vidar_solve::statistics::median(&mut values).unwrap_or(0.0)
}
