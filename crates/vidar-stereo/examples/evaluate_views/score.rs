//! Scores of depth and of confidence.

use std::fmt::Write;
use vidar_core::{Image, ViewGeometry};
use vidar_stereo::{PixelFeatures, TOLERANCE_RATIO, ViewFeatures};

/// Relative step of the sensor's depth that makes an edge.
const EDGE_RATIO: f32 = 0.05;
/// Pixels beside an edge where a sensor at another position and time is not accurate.
const EDGE_PX: usize = 3;
/// One of this many pixels is sampled.
const SAMPLED: usize = 61;
const BINS: usize = 10;

/// A count of pixels in a bin of confidence.
#[derive(Clone, Copy, Default)]
struct Bin {
    count: usize,
    correct: usize,
    predicted: f64,
}

/// A pixel of the sample.
struct Row {
    view: usize,
    x: usize,
    y: usize,
    truth_m: f32,
    /// Relative, signed.
    error: f32,
    at_edge: bool,
    kept: bool,
    features: PixelFeatures,
}

#[derive(Default)]
pub struct Score {
    truths: usize,
    /// Relative errors, signed.
    errors: Vec<f32>,
    within_m: [usize; 2],
    bins: [Bin; BINS],
    bins_off_edges: [Bin; BINS],
    corrections: Vec<(f32, f32, f32)>,
    sample: Vec<Row>,
    views: usize,
}

impl Score {
    pub fn add(&mut self, view: &ViewGeometry, features: &ViewFeatures, truth: &Image<f32>) {
        let (w, depth, confidence) =
            (truth.width(), view.depth.image().data(), view.confidence.image().data());
        let edges = edges(truth);
        let mut own = Vec::new();
        for (i, &t) in truth.data().iter().enumerate().filter(|(_, t)| t.is_finite()) {
            self.truths += 1;
            let (z, features) = (depth[i], features.pixels[i]);
            if (i % w * 31 + i / w * 17) % SAMPLED == 0 && features.agreeing > 0 {
                let error = (1.0 / features.rho - t) / t;
                self.sample.push(Row {
                    view: self.views,
                    x: i % w,
                    y: i / w,
                    truth_m: t,
                    error,
                    at_edge: edges[i],
                    kept: z.is_finite(),
                    features,
                });
            }
            if z.is_nan() {
                continue;
            }
            let error = (z - t) / t;
            own.push(error);
            for (count, limit_m) in self.within_m.iter_mut().zip([0.05, 0.10]) {
                *count += usize::from((z - t).abs() < limit_m);
            }
            let bin = ((confidence[i] * BINS as f32) as usize).min(BINS - 1);
            let count = |bins: &mut [Bin; BINS]| {
                bins[bin].count += 1;
                bins[bin].correct += usize::from(error.abs() < TOLERANCE_RATIO);
                bins[bin].predicted += f64::from(confidence[i]);
            };
            count(&mut self.bins);
            if !edges[i] {
                count(&mut self.bins_off_edges);
            }
        }
        if let Some(e) = features.pixels.first() {
            self.corrections.push((e.shift_px, e.residual_px, quantile(&mut own, 0.5)));
        }
        self.errors.extend(own);
        self.views += 1;
    }

    pub fn print(&mut self) {
        let n = self.errors.len().max(1) as f64;
        let absolute: f64 = self.errors.iter().map(|e| f64::from(e.abs())).sum();
        let within = |limit: f32| self.errors.iter().filter(|e| e.abs() < limit).count() as f64 / n;
        let (within_3, within_10) = (within(0.03), within(0.10));
        println!(
            "  complete {:.3}, AbsRel {:.4}, bias {:+.4}, within 3 % {within_3:.3}, within 10 % {within_10:.3}, \
             0.05 m {:.3}, 0.10 m {:.3}",
            n / self.truths.max(1) as f64,
            absolute / n,
            quantile(&mut self.errors, 0.5),
            self.within_m[0] as f64 / n,
            self.within_m[1] as f64 / n,
        );
        let list = |of: fn(&(f32, f32, f32)) -> f32| {
            let mut values: Vec<f32> = self.corrections.iter().map(of).collect();
            [0.1, 0.5, 0.9].map(|share| quantile(&mut values, share))
        };
        println!(
            "  of the views (10, 50, 90 %): shift {:.2?} px, residual {:.2?} px, bias {:.4?}",
            list(|m| m.0),
            list(|m| m.1),
            list(|m| m.2)
        );
        for (name, bins) in [("all pixels", &self.bins), ("off depth edges", &self.bins_off_edges)] {
            let total: usize = bins.iter().map(|b| b.count).sum();
            let predicted: f64 = bins.iter().map(|b| b.predicted).sum();
            let correct: usize = bins.iter().map(|b| b.correct).sum();
            let gap: f64 = bins.iter().map(|b| (b.predicted - b.correct as f64).abs()).sum();
            let n = total.max(1) as f64;
            print!(
                "  {name}: calibration error {:.3}, predicted {:.3}, observed {:.3};",
                gap / n,
                predicted / n,
                correct as f64 / n
            );
            for bin in bins.iter().filter(|b| b.count > 0) {
                let count = bin.count as f64;
                print!(
                    "  {:.2}→{:.2} ({:.0} %)",
                    bin.predicted / count,
                    bin.correct as f64 / count,
                    100.0 * count / n
                );
            }
            println!();
        }
    }

    /// The sample: where, the sensor's depth, the relative error, whether at an edge, whether kept, the features.
    pub fn csv(&self) -> String {
        let mut out = String::from(
            "view,x,y,truth_m,error,edge,kept,rho,agreeing,compared,rms_difference,cost,margin,curvature,texture,\
             resolution_px,shift_px,residual_px,confidence\n",
        );
        for row in &self.sample {
            let Row { view, x, y, truth_m, error, at_edge, kept, features: e } = row;
            let _ = writeln!(
                out,
                "{view},{x},{y},{truth_m},{error},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
                u8::from(*at_edge),
                u8::from(*kept),
                e.rho,
                e.agreeing,
                e.compared,
                e.rms_difference,
                e.cost,
                e.margin,
                e.curvature,
                e.texture,
                e.resolution_px,
                e.shift_px,
                e.residual_px,
                e.confidence()
            );
        }
        out
    }
}

fn quantile(values: &mut [f32], share: f64) -> f32 {
    values.sort_unstable_by(f32::total_cmp);
    values.get(((values.len().max(1) - 1) as f64 * share) as usize).copied().unwrap_or(f32::NAN)
}

/// Pixels near a step of the sensor's depth.
fn edges(truth: &Image<f32>) -> Vec<bool> {
    let (w, h) = (truth.width(), truth.height());
    let mut out = vec![false; w * h];
    for y in 0..h {
        for x in 0..w {
            let t = truth[(x, y)];
            let step = |o: f32| (o - t).abs() > EDGE_RATIO * t.min(o);
            let right = x + 1 < w && step(truth[(x + 1, y)]);
            if right || (y + 1 < h && step(truth[(x, y + 1)])) {
                for qy in y.saturating_sub(EDGE_PX)..(y + EDGE_PX + 1).min(h) {
                    out[qy * w + x.saturating_sub(EDGE_PX)..qy * w + (x + EDGE_PX + 1).min(w)].fill(true);
                }
            }
        }
    }
    out
}
