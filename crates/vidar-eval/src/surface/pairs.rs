//! Pairs of an ICP: points of the estimate and their nearest points of the reference.

use super::cloud::{moved, subset};
use crate::nearest::{Followed, NearestIndex, along_curve};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::Sim3;

/// Points of one task.
const TASK: usize = 2048;

/// The points that take part in refinements, and what they are matched with.
pub(super) struct Matching<'a> {
    /// In the estimate's own world frame, along a curve.
    points: Vec<[f32; 3]>,
    reference: &'a NearestIndex,
}

/// Points of the estimate (in its own world frame) with their nearest points of the reference.
pub(super) struct Pairs {
    pub source: Vec<Vector3<f64>>,
    pub target: Vec<Vector3<f64>>,
    pub rms_m: f64,
}

impl<'a> Matching<'a> {
    /// At most `count` of the estimated points.
    pub(super) fn new(estimated: &[[f32; 3]], reference: &'a NearestIndex, count: usize) -> Self {
        Self { points: along_curve(&subset(estimated, count)), reference }
    }

    /// Where the neighbours of every point are followed to, for one refinement.
    pub(super) fn followed(&self) -> Vec<Followed> {
        vec![Followed::NEW; self.points.len()]
    }

    /// The pairs under a placement: the nearest `keep_ratio` of them, in the order of the points.
    pub(super) fn trimmed_pairs(&self, followed: &mut [Followed], t: &Sim3, keep_ratio: f64) -> Pairs {
        let place = moved(t);
        let found: Vec<Option<(f64, [f32; 3])>> = self
            .points
            .par_iter()
            .zip(followed)
            .with_min_len(TASK)
            .map(|(point, known)| self.reference.follow(&place(point), known))
            .collect();
        let mut distances: Vec<f64> = found.iter().flatten().map(|(d, _)| *d).collect();
        let keep = ((distances.len() as f64 * keep_ratio).ceil() as usize).min(distances.len());
        let (largest, mut equal) = largest_kept(&mut distances, keep);
        let mut pairs =
            Pairs { source: Vec::with_capacity(keep), target: Vec::with_capacity(keep), rms_m: 0.0 };
        let mut sum = 0.0;
        for (point, pair) in self.points.iter().zip(found) {
            let Some((distance, target)) = pair.filter(|(d, _)| *d <= largest) else { continue };
            // Of equal distances the first ones are kept.
            if distance == largest {
                if equal == 0 {
                    continue;
                }
                equal -= 1;
            }
            sum += distance * distance;
            pairs.source.push(Vector3::from(*point).cast());
            pairs.target.push(Vector3::from(target).cast());
        }
        pairs.rms_m = (sum / keep.max(1) as f64).sqrt();
        pairs
    }
}

/// The largest of the `keep` smallest distances, and how many of them equal it.
fn largest_kept(distances: &mut [f64], keep: usize) -> (f64, usize) {
    if keep == 0 {
        return (f64::NEG_INFINITY, 0);
    }
    let (smaller, largest, _) = distances.select_nth_unstable_by(keep - 1, f64::total_cmp);
    let largest = *largest;
    (largest, 1 + smaller.iter().filter(|d| **d == largest).count())
}
