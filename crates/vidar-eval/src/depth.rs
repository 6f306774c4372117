//! Depth errors per pixel (Eigen et al., NeurIPS 2014, section 4.2).

use crate::error::EvalError;
use crate::stats::median_of_sorted;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use vidar_core::{AlignedView, MetricDepth};

/// Depth errors over a set of pixels; `d` predicted, `g` true.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthErrors {
    /// Mean of |d − g| / g.
    pub abs_rel: f64,
    /// Mean of (d − g)² / g, metres.
    pub sq_rel_m: f64,
    /// Root mean square of d − g, metres.
    pub rmse_m: f64,
    /// Mean of |d − g|, metres.
    pub mae_m: f64,
    /// Root mean square of ln d − ln g.
    pub rmse_log: f64,
    /// Share of pixels with max(d/g, g/d) < 1.25.
    pub delta_1: f64,
    /// Share of pixels with max(d/g, g/d) < 1.25².
    pub delta_2: f64,
    /// Share of pixels with max(d/g, g/d) < 1.25³.
    pub delta_3: f64,
}

/// Depth errors of one image, or of many.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthReport {
    /// Pixels with a true depth.
    pub truth_pixels: usize,
    /// Pixels with a predicted depth.
    pub predicted_pixels: usize,
    /// Pixels with both: the errors are over these.
    pub valid_pixels: usize,
    /// `valid_pixels / truth_pixels`, 0…1: the errors of a prediction with holes cover fewer pixels.
    pub completeness: f64,
    /// Errors as predicted; `None` without a valid pixel.
    pub metric: Option<DepthErrors>,
    /// Errors after multiplying the prediction by `median_scale`, which removes an error of scale.
    pub median_scaled: Option<DepthErrors>,
    /// median(g) / median(d) over valid pixels.
    pub median_scale: Option<f64>,
}

/// Sums from which errors follow.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    count: usize,
    abs_rel: f64,
    sq_rel: f64,
    square: f64,
    abs: f64,
    square_log: f64,
    within: [usize; 3],
}

impl Sums {
    fn push(&mut self, d: f64, g: f64) {
        let error = d - g;
        let ratio = (d / g).max(g / d);
        self.count += 1;
        self.abs_rel += error.abs() / g;
        self.sq_rel += error * error / g;
        self.square += error * error;
        self.abs += error.abs();
        self.square_log += (d / g).ln().powi(2);
        for (k, within) in self.within.iter_mut().enumerate() {
            // The paper's threshold is strict.
            *within += usize::from(ratio < [1.25, 1.5625, 1.953125][k]);
        }
    }

    fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.abs_rel += other.abs_rel;
        self.sq_rel += other.sq_rel;
        self.square += other.square;
        self.abs += other.abs;
        self.square_log += other.square_log;
        for k in 0..3 {
            self.within[k] += other.within[k];
        }
    }

    fn errors(&self) -> Option<DepthErrors> {
        let n = self.count as f64;
        (self.count > 0).then(|| DepthErrors {
            abs_rel: self.abs_rel / n,
            sq_rel_m: self.sq_rel / n,
            rmse_m: (self.square / n).sqrt(),
            mae_m: self.abs / n,
            rmse_log: (self.square_log / n).sqrt(),
            delta_1: self.within[0] as f64 / n,
            delta_2: self.within[1] as f64 / n,
            delta_3: self.within[2] as f64 / n,
        })
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct FrameSums {
    truth_pixels: usize,
    predicted_pixels: usize,
    metric: Sums,
    scaled: Sums,
    median_scale: Option<f64>,
}

impl FrameSums {
    fn report(&self) -> DepthReport {
        let valid_pixels = self.metric.count;
        DepthReport {
            truth_pixels: self.truth_pixels,
            predicted_pixels: self.predicted_pixels,
            valid_pixels,
            completeness: valid_pixels as f64 / self.truth_pixels.max(1) as f64,
            metric: self.metric.errors(),
            median_scaled: self.scaled.errors(),
            median_scale: self.median_scale,
        }
    }
}

fn frame_sums(predicted: &MetricDepth, truth: &MetricDepth) -> Result<FrameSums, EvalError> {
    let (predicted, truth) = (predicted.image(), truth.image());
    let (width, height) = (predicted.width(), predicted.height());
    if (width, height) != (truth.width(), truth.height()) {
        let (truth_width, truth_height) = (truth.width(), truth.height());
        return Err(EvalError::DepthSize { width, height, truth_width, truth_height });
    }
    let mut sums = FrameSums::default();
    let mut pairs = Vec::new();
    for (&d, &g) in predicted.data().iter().zip(truth.data()) {
        sums.predicted_pixels += usize::from(!d.is_nan());
        sums.truth_pixels += usize::from(!g.is_nan());
        if !d.is_nan() && !g.is_nan() {
            pairs.push((f64::from(d), f64::from(g)));
        }
    }
    let median = |values: Vec<f64>| {
        let mut values = values;
        values.sort_unstable_by(f64::total_cmp);
        median_of_sorted(&values)
    };
    let median_d = median(pairs.iter().map(|p| p.0).collect());
    let median_g = median(pairs.iter().map(|p| p.1).collect());
    sums.median_scale = median_d.zip(median_g).map(|(d, g)| g / d);
    let scale = sums.median_scale.unwrap_or(1.0);
    for (d, g) in pairs {
        sums.metric.push(d, g);
        sums.scaled.push(d * scale, g);
    }
    Ok(sums)
}

/// Depth errors over many frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthSummary {
    /// Frames added.
    pub frames: usize,
    /// Frames with at least one valid pixel: `frame_mean` is over these.
    pub frames_evaluated: usize,
    /// Over all pixels, each of equal weight; `median_scale` is `None`, as each frame has its own.
    pub pixel_weighted: DepthReport,
    /// Mean of the frames' errors, each frame of equal weight, as benchmarks report it.
    pub frame_mean: DepthErrors,
    /// The same after each frame's own median scaling.
    pub frame_mean_median_scaled: DepthErrors,
    /// Mean over frames of the median scale.
    pub mean_median_scale: f64,
}

/// Accumulates depth errors frame by frame in constant memory.
#[derive(Clone, Debug, Default)]
pub struct DepthAccumulator {
    frames: usize,
    evaluated: usize,
    total: FrameSums,
    metric: [f64; 8],
    scaled: [f64; 8],
    scales: f64,
}

impl DepthAccumulator {
    /// An empty accumulator.
    pub fn new() -> Self {
        Self::default()
    }

    /// Evaluates one frame, adds it, and returns its own report; fails when the sizes differ.
    pub fn push(&mut self, predicted: &MetricDepth, truth: &MetricDepth) -> Result<DepthReport, EvalError> {
        Ok(self.add(&frame_sums(predicted, truth)?))
    }

    /// Evaluates those of `views` for which `truth_of` gives a true depth image at the view's size.
    ///
    /// `truth_of` is called and the pixels are compared in parallel; sums are taken in the order of `views`, so that
    /// the result has the same bits for any number of threads. Fails when the sizes of a pair differ.
    pub fn push_views(
        &mut self,
        views: &[AlignedView],
        truth_of: impl Fn(&AlignedView) -> Option<MetricDepth> + Sync,
    ) -> Result<(), EvalError> {
        let compared: Vec<Option<FrameSums>> = views
            .par_iter()
            .map(|view| truth_of(view).map(|truth| frame_sums(view.depth(), &truth)).transpose())
            .collect::<Result<_, _>>()?;
        for sums in compared.iter().flatten() {
            self.add(sums);
        }
        Ok(())
    }

    fn add(&mut self, sums: &FrameSums) -> DepthReport {
        let report = sums.report();
        self.frames += 1;
        self.total.truth_pixels += sums.truth_pixels;
        self.total.predicted_pixels += sums.predicted_pixels;
        self.total.metric.add(&sums.metric);
        self.total.scaled.add(&sums.scaled);
        if let (Some(metric), Some(scaled), Some(scale)) =
            (report.metric, report.median_scaled, report.median_scale)
        {
            self.evaluated += 1;
            add_errors(&mut self.metric, &metric);
            add_errors(&mut self.scaled, &scaled);
            self.scales += scale;
        }
        report
    }

    /// The errors over all frames so far; `None` while no frame had a valid pixel.
    pub fn summary(&self) -> Option<DepthSummary> {
        if self.evaluated == 0 {
            return None;
        }
        let n = self.evaluated as f64;
        Some(DepthSummary {
            frames: self.frames,
            frames_evaluated: self.evaluated,
            pixel_weighted: self.total.report(),
            frame_mean: mean_errors(&self.metric, n),
            frame_mean_median_scaled: mean_errors(&self.scaled, n),
            mean_median_scale: self.scales / n,
        })
    }
}

fn add_errors(sums: &mut [f64; 8], e: &DepthErrors) {
    let values = [e.abs_rel, e.sq_rel_m, e.rmse_m, e.mae_m, e.rmse_log, e.delta_1, e.delta_2, e.delta_3];
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value;
    }
}

fn mean_errors(sums: &[f64; 8], n: f64) -> DepthErrors {
    let [abs_rel, sq_rel_m, rmse_m, mae_m, rmse_log, delta_1, delta_2, delta_3] = sums.map(|s| s / n);
    DepthErrors { abs_rel, sq_rel_m, rmse_m, mae_m, rmse_log, delta_1, delta_2, delta_3 }
}

#[cfg(test)]
mod tests;
