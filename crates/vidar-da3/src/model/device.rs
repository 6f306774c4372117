//! The interface to networks on a device other than the CPU.

use super::backbone::{CameraTokens, Pixels};
use super::head::DenseView;
use crate::config::NetConfig;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{Residency, Scope};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ops::Range;

/// Output of backbone and dense head.
pub(crate) struct DenseOutput {
    /// Of the wanted views. Single-view networks put sky where others put confidence.
    pub views: Vec<DenseView>,
    /// Of the last stage, `[views, feature width]`.
    pub camera_tokens: Vec<f32>,
    /// By layer and view: normalised patch tokens.
    pub layers: BTreeMap<usize, Vec<Vec<f32>>>,
    /// The reference view.
    pub reference: usize,
}

/// Backbone and dense head of a network on a device other than the CPU.
pub(crate) trait DeviceNet: Send + Sync {
    /// Runs both. `layers` are the layers whose tokens are wanted; `wanted` holds the views whose maps are wanted, and whether
    /// rays are.
    fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        tokens: CameraTokens<'_>,
        layers: &[usize],
        wanted: (Range<usize>, bool),
    ) -> Result<DenseOutput, Da3Error>;
}

/// Loads networks to a device.
pub(crate) trait DeviceLoader {
    /// Loads the network whose keys begin at `scope`.
    fn load(
        &self,
        scope: &Scope,
        net: &NetConfig,
        residency: Residency,
    ) -> Result<Box<dyn DeviceNet>, Da3Error>;
}

/// Device memory that a run needs, computed before it starts, in bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DevicePlan {
    /// Description of the device.
    pub device: String,
    /// All weights in `f32`; the backbone's take half of that in bf16 or f16.
    pub weights: u64,
    /// Largest sum of buffers during a run, weights aside.
    pub working: u64,
    /// The largest single buffer, weights aside: devices bound these, some at 128 MiB.
    pub largest: u64,
    /// What the largest buffer is for.
    pub largest_is: &'static str,
}
