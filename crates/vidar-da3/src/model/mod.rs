//! The networks. The folders mirror the checkpoint's keys: `backbone` (`backbone.pretrained`), `cam_enc`, `cam_dec`,
//! `head` (with `scratch`); [`nested`] joins two networks.

mod any_view;
pub(crate) mod backbone;
mod cam_dec;
mod cam_enc;
pub(crate) mod head;
mod nested;
mod single_view;

pub(crate) use any_view::{AnyView, Request};
pub use nested::metres_per_canonical;
pub(crate) use nested::{Nested, scale_to_metres};
pub(crate) use single_view::{SingleAnswer, SingleView};

use crate::config::{Da3Config, NetConfig, Networks};
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::inventory::{NESTED_ANY_VIEW, NESTED_METRIC, SINGLE};
use crate::weights::{Residency, Scope};
use backbone::{CameraTokens, Pixels};
use head::DenseView;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use vidar_nn::WeightSource;

/// What backbone and dense head say.
pub(crate) struct Dense {
    /// Of the wanted views. A network of single views has sky where others have confidence.
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
    /// Runs both. `layers` are layers whose tokens are wanted, `wanted` the views whose maps are, and whether rays are.
    fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        tokens: CameraTokens<'_>,
        layers: &[usize],
        wanted: (Range<usize>, bool),
    ) -> Result<Dense, Da3Error>;
}

/// Puts networks on a device.
pub(crate) trait DeviceLoader {
    /// Puts the network on the device whose keys begin at `scope`.
    fn load(
        &self,
        scope: &Scope,
        net: &NetConfig,
        residency: Residency,
    ) -> Result<Box<dyn DeviceNet>, Da3Error>;
}

/// A model of any kind. There is one of these a model: its size does not matter.
#[allow(clippy::large_enum_variant)]
pub(crate) enum Model {
    AnyView(AnyView),
    SingleView(SingleView),
    Nested { any_view: AnyView, metric: SingleView },
}

impl Model {
    pub fn load(
        source: &Arc<dyn WeightSource>,
        config: &Da3Config,
        residency: Residency,
        device: Option<&dyn DeviceLoader>,
    ) -> Result<Self, Da3Error> {
        let scope = |root| Scope::new(Arc::clone(source), root);
        Ok(match &config.networks {
            Networks::Single(net) if net.is_any_view() => {
                Self::AnyView(AnyView::load(&scope(SINGLE), net, residency, device)?)
            }
            Networks::Single(net) => {
                Self::SingleView(SingleView::load(&scope(SINGLE), net, residency, device)?)
            }
            Networks::Nested { any_view, metric } => Self::Nested {
                any_view: AnyView::load(&scope(NESTED_ANY_VIEW), any_view, residency, device)?,
                metric: SingleView::load(&scope(NESTED_METRIC), metric, residency, device)?,
            },
        })
    }
}
