//! Choice of stretches and points from tracked images.

use super::parameters::Parameters;
use super::path::GyroPath;
use super::window::{Node, NodeObservation, Point, Window};
use crate::gyro_alignment::{ImageFeatures, RateSample};
use nalgebra::Vector3;
use rustc_hash::FxHashMap;
use vidar_core::LandmarkId;

/// Images of a stretch: 1.5 s at ten a second. Longer ones tell structure from rotation better, and cost more.
const NODES: usize = 15;
/// Fewest images of a stretch.
const MIN_NODES: usize = 6;
/// A longer gap between images ends a stretch, s.
const MAX_GAP_SECS: f64 = 0.35;
/// Images that a point is seen in at least.
const MIN_OBSERVATIONS: usize = 4;
/// Points of a stretch.
const MAX_POINTS: usize = 70;
/// Points that a stretch needs.
const MIN_POINTS: usize = 15;
/// Stretches that are used: those in which the body turns most.
const MAX_WINDOWS: usize = 20;
/// Cells of the image, per axis, over which points are spread.
const CELLS: usize = 6;

/// The stretches of a recording, in the order of time.
pub(super) fn stretches(size: (f64, f64), images: &[ImageFeatures], samples: &[RateSample]) -> Vec<Window> {
    let mut all: Vec<(f64, usize, Window)> = Vec::new();
    let mut first = 0;
    while first < images.len() {
        let mut end = first + 1;
        while end < images.len()
            && end - first < NODES
            && images[end].secs - images[end - 1].secs < MAX_GAP_SECS
        {
            end += 1;
        }
        if end - first >= MIN_NODES
            && let Some(window) = stretch(size, &images[first..end])
        {
            all.push((turning(samples, images[first].secs, images[end - 1].secs), first, window));
        }
        first = end;
    }
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    all.truncate(MAX_WINDOWS);
    all.sort_by_key(|(_, first, _)| *first);
    all.into_iter().map(|(.., window)| window).collect()
}

/// Length of the means of which the angular rate is evaluated, s: noise averages out, motion hardly.
const MEAN_SECS: f64 = 0.1;

/// Root mean square of the angular rate about its mean, rad/s.
fn turning(samples: &[RateSample], from: f64, to: f64) -> f64 {
    let mut means: Vec<(i64, Vector3<f64>, f64)> = Vec::new();
    for sample in samples.iter().filter(|s| s.secs >= from && s.secs <= to) {
        let block = ((sample.secs - from) / MEAN_SECS) as i64;
        match means.last_mut() {
            Some((last, sum, count)) if *last == block => (*sum, *count) = (*sum + sample.rate, *count + 1.0),
            _ => means.push((block, sample.rate, 1.0)),
        }
    }
    let n = means.len().max(1) as f64;
    let mean = means.iter().map(|(_, sum, count)| sum / *count).sum::<Vector3<f64>>() / n;
    (means.iter().map(|(_, sum, count)| (sum / *count - mean).norm_squared()).sum::<f64>() / n).sqrt()
}

fn stretch(size: (f64, f64), images: &[ImageFeatures]) -> Option<Window> {
    let mut tracks: FxHashMap<LandmarkId, Vec<NodeObservation>> = FxHashMap::default();
    for (node, image) in images.iter().enumerate() {
        for (id, pixel) in &image.features {
            let row = pixel.y / (size.1 - 1.0) - 0.5;
            tracks.entry(*id).or_default().push(NodeObservation { node, pixel: *pixel, row });
        }
    }
    let mut tracks: Vec<(LandmarkId, Vec<NodeObservation>)> =
        tracks.into_iter().filter(|(_, seen)| seen.len() >= MIN_OBSERVATIONS).collect();
    // Longest first; of each cell of the image one after the other.
    tracks.sort_by_key(|(id, seen)| (std::cmp::Reverse(seen.len()), *id));
    let mut taken = [0_usize; CELLS * CELLS];
    let mut ranked: Vec<(usize, usize)> = Vec::with_capacity(tracks.len());
    for (k, (_, seen)) in tracks.iter().enumerate() {
        let middle = seen[seen.len() / 2].pixel;
        let cell = |at: f64, extent: f64| ((at / extent * CELLS as f64) as usize).min(CELLS - 1);
        let cell = cell(middle.y, size.1) * CELLS + cell(middle.x, size.0);
        ranked.push((taken[cell], k));
        taken[cell] += 1;
    }
    ranked.sort_unstable();
    let points: Vec<Point> = ranked
        .into_iter()
        .take(MAX_POINTS)
        .map(|(_, k)| Point {
            direction: Vector3::z(),
            inverse_distance: 1.0,
            observations: std::mem::take(&mut tracks[k].1).into(),
        })
        .collect();
    let nodes = images
        .iter()
        .map(|i| Node { secs: i.secs, drift: Vector3::zeros(), position: Vector3::zeros() })
        .collect();
    let reference = images.len() / 2;
    (points.len() >= MIN_POINTS).then_some(Window { nodes, points, reference, shakes: None })
}

impl Window {
    /// Root mean square of the angular rate about its mean, rad/s.
    pub fn turning(&self, samples: &[RateSample]) -> f64 {
        let time = |node: Option<&Node>| node.map_or(0.0, |n| n.secs);
        turning(samples, time(self.nodes.first()), time(self.nodes.last()))
    }

    /// Forgets positions and distances, and takes directions from the pixels next to the reference image.
    pub fn restart(&mut self, parameters: &Parameters, path: &GyroPath) {
        for node in &mut self.nodes {
            (node.drift, node.position) = (Vector3::zeros(), Vector3::zeros());
        }
        self.shakes = None;
        let at = |secs: f64| path.at(secs + parameters.offset_secs).rotation;
        let reference_from_first = at(self.nodes[self.reference].secs).transpose();
        for point in &mut self.points {
            let nearest = point.observations.iter().min_by_key(|o| o.node.abs_diff(self.reference));
            let Some(seen) = nearest else { continue };
            let body = at(self.nodes[seen.node].secs + seen.row * parameters.readout_secs);
            let in_body = parameters.body_from_camera * parameters.direction(&seen.pixel);
            point.direction = reference_from_first * body * in_body;
            point.inverse_distance = 1.0;
        }
    }
}
