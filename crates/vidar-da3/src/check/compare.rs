//! Comparison of a run with a reference.

use super::collect::{Collector, Thinning, without_thinning};
use super::golden::Golden;
use super::report::{CheckReport, CheckResult, Measure, Row, Tolerances};
use super::three_rows;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::infer::NetOutput;
use crate::model::backbone::ReferenceStrategy;

/// Distance from the sky threshold within which a pixel may fall on either side; in rounded arithmetic, twice the tolerance
/// of depth.
const SKY_MARGIN: f64 = 1e-4;
const SKY_THRESHOLD: f64 = 0.3;

/// A comparison in progress.
pub(super) struct Comparison<'a> {
    golden: &'a Golden,
    tolerances: Tolerances,
    rows: Vec<Row>,
}

impl<'a> Comparison<'a> {
    pub fn new(golden: &'a Golden, tolerances: Tolerances) -> Self {
        Self { golden, tolerances, rows: Vec::new() }
    }

    /// Compares one tensor, `[views…]`, if the reference has it.
    pub fn tensor(&mut self, name: &str, found: &[f64]) -> Result<(), Da3Error> {
        if self.golden.names().any(|n| n == name) {
            let (_, expected) = self.golden.tensor(name)?;
            self.push(name, &expected, found);
        }
        Ok(())
    }

    /// Compares bytes that must be equal.
    pub fn bytes(&mut self, name: &str, found: &[u8]) -> Result<(), Da3Error> {
        if self.golden.names().any(|n| n == name) {
            let expected = self.golden.bytes(name)?;
            let result = if expected == found { CheckResult::Passed } else { CheckResult::Failed };
            let differing = expected.iter().zip(found).filter(|(a, b)| a != b).count();
            let worst = expected.iter().zip(found).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
            let note = format!("{differing} bytes of {} differ", expected.len());
            self.rows.push(Row {
                tensor: name.into(),
                max_difference: f64::from(worst),
                p999_difference: f64::from(worst),
                rms_difference: (differing as f64 / expected.len().max(1) as f64).sqrt(),
                deviation: 1.0,
                tolerance: 0.0,
                measure: Measure::Largest,
                result,
                note,
            });
        }
        Ok(())
    }

    /// The reference view must be the same, except where two views have equal scores.
    pub fn reference(&mut self, expected: usize, found: usize, strategy: ReferenceStrategy) {
        let is_tie = strategy == ReferenceStrategy::SaddleSimRange;
        let result = match expected == found {
            true => CheckResult::Passed,
            false if is_tie => CheckResult::NotEvaluated,
            false => CheckResult::Failed,
        };
        let note = format!("view {found}, expected {expected}");
        self.rows.push(Row {
            tensor: "ref_idx".into(),
            max_difference: expected.abs_diff(found) as f64,
            p999_difference: expected.abs_diff(found) as f64,
            rms_difference: expected.abs_diff(found) as f64,
            deviation: 1.0,
            tolerance: 0.0,
            measure: Measure::Largest,
            result,
            note,
        });
    }

    /// Compares all collected intermediate results, in the order of computation.
    pub fn traced(&mut self, collector: &Collector) -> Result<(), Da3Error> {
        let mut found = Vec::new();
        for name in self.golden.names() {
            let (base, thinning) = without_thinning(name);
            if let Some(stack) = collector.take(base) {
                found.push((stack.order, name, thinning, stack));
            }
        }
        found.sort_by_key(|f| f.0);
        for (_, name, thinning, stack) in found {
            let values: Vec<f64> =
                stack.views.iter().flat_map(|view| thin(view, &stack.shape, thinning)).collect();
            self.tensor(name, &values)?;
        }
        Ok(())
    }

    /// Compares the network's output.
    pub fn output(&mut self, output: &NetOutput) -> Result<(), Da3Error> {
        let (rows, columns) = (self.golden.rows, self.golden.columns);
        let map = vec![rows, columns];
        let mut parts: Vec<(&str, Vec<usize>, Vec<f32>)> =
            vec![("out.depth", map.clone(), output.depth.clone())];
        if let Some(confidence) = &output.confidence {
            parts.push(("out.depth_conf", map.clone(), confidence.clone()));
        }
        if let Some(sky) = &output.sky {
            parts.push(("out.sky", map, sky.clone()));
        }
        if let Some(rays) = &output.rays {
            let (r, c) = rays.first().map_or((0, 0), |m| (m.rows, m.columns));
            let all = rays.iter().flat_map(|m| m.rays.iter().flatten().copied()).collect();
            parts.push(("out.ray", vec![r, c, 6], all));
            let confidence = rays.iter().flat_map(|m| m.confidence.iter().copied()).collect();
            parts.push(("out.ray_conf", vec![r, c], confidence));
        }
        for (base, shape, values) in parts {
            self.views(base, &shape, &values)?;
        }
        if let Some(poses) = &output.camera_from_world {
            let rows: Vec<f64> = poses.iter().flat_map(three_rows).collect();
            self.tensor("out.extrinsics", &rows)?;
        }
        if let Some(intrinsics) = &output.intrinsics {
            let rows: Vec<f64> =
                intrinsics.iter().flat_map(|k| k.transpose().iter().copied().collect::<Vec<_>>()).collect();
            self.tensor("out.intrinsics", &rows)?;
        }
        if let Some(scale) = output.scale_factor {
            // A single number has no deviation: it is compared relative to its magnitude.
            let name = "out.scale_factor_f64";
            if self.golden.names().any(|n| n == name) {
                let expected = self.golden.tensor(name)?.1[0];
                self.number(name, expected, scale);
            }
        }
        Ok(())
    }

    /// Compares a number relative to its magnitude.
    pub fn number(&mut self, name: &str, expected: f64, found: f64) {
        let (difference, tolerance) = ((expected - found).abs(), self.tolerances.of_output(name, None));
        let size = expected.abs().max(f64::MIN_POSITIVE);
        let result = self.evaluate(difference / size, tolerance);
        self.rows.push(Row {
            tensor: name.into(),
            max_difference: difference,
            p999_difference: difference,
            rms_difference: difference,
            deviation: size,
            tolerance: tolerance.unwrap_or(f64::INFINITY),
            measure: self.tolerances.measure,
            result,
            note: "relative".into(),
        });
    }

    fn views(&mut self, base: &str, shape: &[usize], values: &[f32]) -> Result<(), Da3Error> {
        let length: usize = shape.iter().product();
        for name in self.golden.names() {
            let (found, thinning) = without_thinning(name);
            if found == base && length > 0 {
                let thinned: Vec<f64> =
                    values.chunks_exact(length).flat_map(|view| thin(view, shape, thinning)).collect();
                self.tensor(name, &thinned)?;
            }
        }
        Ok(())
    }

    fn push(&mut self, name: &str, expected: &[f64], found: &[f64]) {
        let (base, _) = without_thinning(name);
        let rounding = self.golden.entry.f32_vs_f64.get(base.trim_start_matches("out."));
        let tolerance = self.tolerances.of_output(base, rounding.map(|r| r.max_abs_over_std));
        let deviation = deviation(expected);
        let is_near_threshold = self.pixels_near_threshold(base, expected.len());
        let (mut worst, mut squares) = (0.0f64, 0.0f64);
        let mut left_out = 0;
        let mut all = Vec::with_capacity(expected.len());
        for (i, (e, f)) in expected.iter().zip(found).enumerate() {
            if is_near_threshold.get(i).copied().unwrap_or(false) {
                left_out += 1;
                continue;
            }
            let difference = (e - f).abs();
            worst = if difference.is_nan() { f64::INFINITY } else { worst.max(difference) };
            squares += difference * difference;
            all.push(if difference.is_nan() { f64::INFINITY } else { difference });
        }
        let p999_difference = high_quantile(&mut all);
        let rms = (squares / (expected.len() - left_out).max(1) as f64).sqrt();
        let rms_difference = if worst.is_finite() { rms } else { f64::INFINITY };
        let has_all = expected.len() == found.len();
        let mut note = String::new();
        if !has_all {
            note = format!("{} numbers, expected {}", found.len(), expected.len());
        } else if left_out > 0 {
            note = format!("{left_out} pixels at the sky threshold left out");
        }
        // A constant tensor is compared relative to its magnitude, a zero tensor absolutely.
        let size = expected.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let deviation = if deviation > 1e-12 * size {
            deviation
        } else if size > 0.0 {
            size
        } else {
            1.0
        };
        let measure = self.tolerances.measure;
        let evaluated = match measure {
            Measure::Largest => worst,
            Measure::RootMeanSquare => rms_difference,
        };
        let result =
            if has_all { self.evaluate(evaluated / deviation, tolerance) } else { CheckResult::Failed };
        self.rows.push(Row {
            tensor: name.into(),
            max_difference: worst,
            p999_difference,
            rms_difference,
            measure,
            deviation,
            tolerance: tolerance.unwrap_or(f64::INFINITY),
            result,
            note,
        });
    }

    fn evaluate(&self, ratio: f64, tolerance: Option<f64>) -> CheckResult {
        match tolerance {
            Some(tolerance) if ratio <= tolerance => CheckResult::Passed,
            Some(_) => CheckResult::Failed,
            None => CheckResult::NotEvaluated,
        }
    }

    /// Pixels whose sky value is so close to the threshold that rounding decides.
    fn pixels_near_threshold(&self, base: &str, length: usize) -> Vec<bool> {
        let sky_name = match base {
            "out.depth" | "out.depth_conf" => ["metric.sky", "out.sky"],
            _ => return Vec::new(),
        };
        let sky = sky_name.iter().find_map(|name| self.golden.tensor(name).ok()).map(|t| t.1);
        let margin = |sky: &[f64]| match self.tolerances.others {
            Some(_) => SKY_MARGIN,
            None => SKY_MARGIN.max(2.0 * self.tolerances.depth * deviation(sky)),
        };
        let margin = sky.as_deref().map_or(SKY_MARGIN, margin);
        let is_near = |s: &f64| (s - SKY_THRESHOLD).abs() < margin;
        sky.filter(|s| s.len() == length).map(|s| s.iter().map(is_near).collect()).unwrap_or_default()
    }

    pub fn report(self, model: &Da3) -> CheckReport {
        CheckReport {
            file: self.golden.path().to_path_buf(),
            model: model.config().name.clone(),
            compute: model.describe_compute(),
            measure: self.tolerances.measure,
            rows: self.rows,
        }
    }
}

/// The 99.9 % quantile; the largest of fewer than a thousand values.
fn high_quantile(values: &mut [f64]) -> f64 {
    let Some(last) = values.len().checked_sub(1) else { return 0.0 };
    let at = last - values.len() / 1000;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

fn deviation(values: &[f64]) -> f64 {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Thins one view's tensor as the reference is thinned.
fn thin(values: &[f32], shape: &[usize], thinning: Thinning) -> Vec<f64> {
    let keep = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    match (thinning, shape) {
        (Thinning::Tokens(n), &[_, channels]) => {
            values.chunks_exact(channels).step_by(n).flat_map(keep).collect()
        }
        (Thinning::Pixels(n), &[_, columns, ref rest @ ..]) => {
            let channels: usize = rest.iter().product();
            let row = |row: &[f32]| row.chunks_exact(channels).step_by(n).flat_map(keep).collect::<Vec<_>>();
            values.chunks_exact(columns * channels).step_by(n).flat_map(row).collect()
        }
        _ => keep(values),
    }
}
