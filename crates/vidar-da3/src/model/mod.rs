//! The networks. The folders mirror the checkpoint's keys: `backbone` (`backbone.pretrained`), `cam_enc`, `cam_dec`,
//! `head` (with `scratch`); [`nested`] joins two networks.

mod any_view;
pub(crate) mod backbone;
mod cam_dec;
mod cam_enc;
mod device;
pub(crate) mod head;
mod nested;
mod single_view;

pub(crate) use any_view::{AnyView, Request};
#[cfg(feature = "gpu")]
pub(crate) use device::DenseOutput;
pub use device::DevicePlan;
pub(crate) use device::{DeviceLoader, DeviceNet};
pub use nested::metres_per_canonical;
pub(crate) use nested::{Nested, scale_to_metres};
pub(crate) use single_view::{SingleView, SingleViewOutput};

use crate::config::{Da3Config, Networks};
use crate::error::Da3Error;
use crate::weights::inventory::{NESTED_ANY_VIEW, NESTED_METRIC, SINGLE};
use crate::weights::{Residency, Scope};
use std::sync::Arc;
use vidar_nn::WeightSource;

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
