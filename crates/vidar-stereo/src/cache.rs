//! What was worked out for a stream so far: in overlapping chunks, each view is placed and estimated once.
//!
//! A view is known again by a fingerprint of what was given: pixels, pose and intrinsics. Anything else under the same
//! frame number is another view and starts afresh. Only the last call's views and those they were matched with are
//! kept, so memory does not grow with the stream.

use crate::estimate::{Estimate, Probe};
use crate::prepare::Prepared;
use std::collections::{HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use vidar_core::{FrameId, Pinhole, Se3};

/// Depth of one view before the checks, with all that the checks of others need.
#[derive(Debug)]
pub(crate) struct ViewDepth {
    /// The pose it was estimated at.
    pub world_from_camera: Se3,
    /// By how much the correction of the poses shifted what it shares with others, working pixels.
    pub shift_px: f32,
    /// Intrinsics at the working size.
    pub intrinsics: Pinhole,
    pub estimate: Estimate,
    /// The views it was matched with, best first.
    pub neighbours: Vec<FrameId>,
}

/// What is known of one view.
#[derive(Debug)]
struct Known {
    fingerprint: u64,
    probe: Option<Arc<Probe>>,
    depth: Option<Arc<ViewDepth>>,
}

/// What is known of a stream's latest views.
#[derive(Debug, Default)]
pub(crate) struct Cache {
    of: HashMap<FrameId, Known>,
}

impl Cache {
    /// Begins a call: forgets what is neither one of these views nor a neighbour of one, and what was given otherwise.
    pub fn begin(&mut self, views: &[Prepared], fingerprints: &[u64]) {
        let given: HashMap<FrameId, u64> =
            views.iter().map(|v| v.frame_id).zip(fingerprints.iter().copied()).collect();
        let near: HashSet<FrameId> = (self.of.iter())
            .filter(|(frame, _)| given.contains_key(frame))
            .filter_map(|(_, known)| known.depth.as_ref())
            .flat_map(|depth| depth.neighbours.iter().copied())
            .collect();
        self.of.retain(|frame, known| match given.get(frame) {
            Some(fingerprint) => known.fingerprint == *fingerprint,
            None => near.contains(frame),
        });
        for (frame_id, fingerprint) in given {
            self.of.entry(frame_id).or_insert(Known { fingerprint, probe: None, depth: None });
        }
    }

    pub fn probe(&self, frame: FrameId) -> Option<Arc<Probe>> {
        self.of.get(&frame)?.probe.clone()
    }

    pub fn depth(&self, frame: FrameId) -> Option<Arc<ViewDepth>> {
        self.of.get(&frame)?.depth.clone()
    }

    pub fn put_probe(&mut self, frame: FrameId, probe: Arc<Probe>) {
        if let Some(known) = self.of.get_mut(&frame) {
            known.probe = Some(probe);
        }
    }

    pub fn put_depth(&mut self, frame: FrameId, depth: Arc<ViewDepth>) {
        if let Some(known) = self.of.get_mut(&frame) {
            known.depth = Some(depth);
        }
    }
}

/// Fingerprint of a view as it was given.
pub(crate) fn fingerprint(view: &Prepared) -> u64 {
    let mut hasher = DefaultHasher::new();
    view.world_from_camera.matrix().iter().for_each(|v| v.to_bits().hash(&mut hasher));
    let level = &view.levels[0];
    let k = &level.intrinsics;
    [k.fx, k.fy, k.cx, k.cy].map(f64::to_bits).hash(&mut hasher);
    (level.width, level.height).hash(&mut hasher);
    level.gray.iter().for_each(|v| v.to_bits().hash(&mut hasher));
    hasher.finish()
}
