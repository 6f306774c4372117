//! Decoupled hybrid (the paper's section III-D): the pose-free chain, then one similarity per chain onto the pose priors.
//! `S_vio = Umeyama({c_i^pred}, {c_i^VIO})`, `M ← S_vio(M)`. Where the chain has landmarks, the similarity's scale is that of
//! centres and landmarks together.

use super::super::chain::{Chains, chain, landmark_scale};
use super::super::chunk::Chunk;
use super::super::estimate::Estimate;
use super::super::history::History;
use super::super::pose_fit::CameraPair;
use super::super::report::RejectionReason;
use super::{Coupling, initialise_by_overlap};
use crate::landmark_scale::LogScale;
use nalgebra::Vector3;
use std::collections::BTreeMap;
use vidar_core::{FrameId, LieGroup, Sim3, umeyama_sim3};

/// The coupling.
#[derive(Debug)]
pub(in crate::aligner) struct Hybrid;

impl Coupling for Hybrid {
    fn initialise(&self, history: &History, chunk: &mut Chunk, _pairs: &[CameraPair]) {
        initialise_by_overlap(history, chunk);
    }

    fn estimate(&self, history: &History) -> Estimate {
        let loops = self.loops(history);
        let Chains { links, failures } = chain(&history.chunks, &history.loop_edges(&loops));
        let mut roots: Vec<usize> = links.iter().flatten().map(|l| l.root).collect();
        roots.sort_unstable();
        roots.dedup();
        let mut chunks: Vec<Option<Sim3>> = vec![None; links.len()];
        let mut rejections = Vec::new();
        let mut is_metric = true;
        let mut log_scale_std = vec![f64::INFINITY; links.len()];
        for root in &roots {
            let members =
                || (0..links.len()).filter_map(|k| Some((k, links[k].filter(|l| l.root == *root)?)));
            let mut centers: BTreeMap<FrameId, (Vector3<f64>, Vector3<f64>)> = BTreeMap::new();
            for (k, link) in members() {
                for view in &history.chunks[k].views {
                    if let Some(prior) = history.frames.pose_prior(view.frame_id) {
                        let placed = link.root_from_chunk.act(&view.chunk_from_camera.translation);
                        centers.insert(view.frame_id, (placed, prior.world_from_camera.translation));
                    }
                }
            }
            let (chained, metric): (Vec<_>, Vec<_>) = centers.into_values().unzip();
            let world_from_root = match umeyama_sim3(&chained, &metric) {
                Ok(similarity) => similarity,
                Err(_) => {
                    // Section III-F: identity. A second chain that nothing places is left out.
                    rejections.push(RejectionReason::RankDeficient);
                    is_metric = false;
                    if *root != roots[0] {
                        continue;
                    }
                    Sim3::IDENTITY
                }
            };
            let std = log_scale_std_of(&world_from_root, &chained, &metric);
            let by_landmarks = landmark_scale(&history.chunks, &links, *root);
            let (world_from_root, std) = match by_landmarks {
                Some(landmarks) => with_landmarks(&world_from_root, std, &landmarks, &chained),
                None => (world_from_root, std),
            };
            members().for_each(|(k, link)| {
                chunks[k] = Some(world_from_root * link.root_from_chunk);
                log_scale_std[k] = std;
            });
        }
        let estimate = Estimate::new(history, chunks, loops, is_metric);
        Estimate { rejections, log_scale_std, failures, ..estimate }
    }
}

/// The similarity with the scale from centres and landmarks by inverse variance, about the mean of the centres; and σ of its
/// ln(scale).
fn with_landmarks(
    world_from_root: &Sim3,
    std: f64,
    landmarks: &LogScale,
    chained: &[Vector3<f64>],
) -> (Sim3, f64) {
    let information = [if std.is_finite() { std.powi(-2) } else { 0.0 }, landmarks.std.powi(-2)];
    let sum = information[0] + information[1];
    let log = (information[0] * world_from_root.scale.ln() + information[1] * landmarks.log_scale) / sum;
    let mean = chained.iter().sum::<Vector3<f64>>() / chained.len().max(1) as f64;
    let scaled = Sim3 { scale: log.exp(), ..*world_from_root };
    let translation = world_from_root.translation + world_from_root.act(&mean) - scaled.act(&mean);
    (Sim3 { translation, ..scaled }, sum.powf(-0.5).hypot(landmarks.shared_std))
}

/// σ of ln(scale) of a similarity over correlated centres: their residual over their radius.
fn log_scale_std_of(world_from_root: &Sim3, chained: &[Vector3<f64>], metric: &[Vector3<f64>]) -> f64 {
    let n = metric.len().max(1) as f64;
    let mean = metric.iter().sum::<Vector3<f64>>() / n;
    let radius: f64 = metric.iter().map(|m| (m - mean).norm_squared()).sum();
    let residual: f64 =
        chained.iter().zip(metric).map(|(c, m)| (world_from_root.act(c) - m).norm_squared()).sum();
    (residual / radius).sqrt()
}
