//! Where a model computes.

use crate::arithmetic::Arithmetic;
use crate::config::Da3Config;
use crate::error::Da3Error;
use crate::model::DeviceLoader;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Where backbone and dense head are computed. Camera parts, preprocessing and alignment are on the CPU in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// The CPU, with this project's own kernels.
    #[default]
    Cpu,
    /// A graphics processor; needs the feature `gpu`.
    Gpu {
        /// Its place in the list of devices; `None` is the best that does not run its shaders on the CPU.
        adapter: Option<usize>,
    },
    /// A graphics processor where one opens, the CPU otherwise.
    Auto,
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu { adapter: None } => f.write_str("gpu"),
            Self::Gpu { adapter: Some(index) } => write!(f, "gpu:{index}"),
            Self::Auto => f.write_str("auto"),
        }
    }
}

/// A word that names no device.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown device {found:?}; expected cpu, gpu, gpu:N (N counted from 0) or auto")]
pub struct UnknownDevice {
    /// The word.
    pub found: String,
}

impl FromStr for Device {
    type Err = UnknownDevice;
    fn from_str(word: &str) -> Result<Self, UnknownDevice> {
        let unknown = || UnknownDevice { found: word.to_owned() };
        match word {
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu { adapter: None }),
            "auto" => Ok(Self::Auto),
            _ => {
                let index = word.strip_prefix("gpu:").ok_or_else(unknown)?;
                Ok(Self::Gpu { adapter: Some(index.parse().map_err(|_| unknown())?) })
            }
        }
    }
}

impl TryFrom<String> for Device {
    type Error = UnknownDevice;
    fn try_from(word: String) -> Result<Self, UnknownDevice> {
        word.parse()
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
    }
}

/// A device and what a run takes there, before it starts. All in bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DevicePlan {
    /// The device in words.
    pub device: String,
    /// All weights, in `f32`; the backbone's take half of it in bf16 or f16.
    pub weights: u64,
    /// Largest sum of buffers during a run, weights aside.
    pub working: u64,
    /// The largest single buffer, weights aside: devices bound these, some at 128 MiB.
    pub largest: u64,
    /// What the largest buffer is for.
    pub largest_is: &'static str,
}

impl Device {
    /// The device of this machine that is meant, unless it is the CPU, and what `views` views at `height` × `width`
    /// pixels take there. Nothing is opened.
    ///
    /// # Errors
    /// [`Da3Error::NoDeviceSupport`], or [`Da3Error::Gpu`](crate::Da3Error) when there is no such device.
    #[cfg(feature = "gpu")]
    pub fn plan(
        self,
        config: &Da3Config,
        (views, height, width): (usize, usize, usize),
        wants_rays: bool,
    ) -> Result<Option<DevicePlan>, Da3Error> {
        let find = |adapter| vidar_gpu::find(&vidar_gpu::GpuOptions { adapter, memory_limit: None });
        let adapter = match self {
            Self::Cpu => None,
            Self::Gpu { adapter } => Some(find(adapter)?),
            Self::Auto => find(None).ok(),
        };
        let size = (views, height, width);
        Ok(adapter.map(|adapter| crate::gpu::device_plan(&adapter, config, size, wants_rays)))
    }

    /// The device of this machine that is meant, unless it is the CPU, and what `views` views at `height` × `width`
    /// pixels take there. Nothing is opened.
    ///
    /// # Errors
    /// [`Da3Error::NoDeviceSupport`].
    #[cfg(not(feature = "gpu"))]
    pub fn plan(
        self,
        _config: &Da3Config,
        (_views, _height, _width): (usize, usize, usize),
        _wants_rays: bool,
    ) -> Result<Option<DevicePlan>, Da3Error> {
        open(self, None).map(|_| None)
    }

    /// Every graphics processor of this machine by its word and its name, the best first; `None` when this program was
    /// built without them.
    #[must_use]
    pub fn list() -> Option<Vec<(Self, String)>> {
        #[cfg(feature = "gpu")]
        return Some(
            vidar_gpu::adapters()
                .into_iter()
                .map(|a| (Self::Gpu { adapter: Some(a.index) }, a.to_string()))
                .collect(),
        );
        #[cfg(not(feature = "gpu"))]
        None
    }
}

/// A device that was opened.
#[cfg(feature = "gpu")]
pub(crate) struct Opened(vidar_gpu::Gpu);

/// Nothing can be opened without the feature `gpu`.
#[cfg(not(feature = "gpu"))]
pub(crate) enum Opened {}

/// Opens the device asked for, unless it is the CPU. At most `max_bytes` of its memory are held at a time.
#[cfg(feature = "gpu")]
pub(crate) fn open(device: Device, max_bytes: Option<u64>) -> Result<Option<Opened>, Da3Error> {
    let open = |adapter| vidar_gpu::Gpu::open(&vidar_gpu::GpuOptions { adapter, memory_limit: max_bytes });
    match device {
        Device::Cpu => Ok(None),
        Device::Gpu { adapter } => Ok(Some(Opened(open(adapter)?))),
        Device::Auto => Ok(open(None).ok().map(Opened)),
    }
}

/// Opens the device asked for, unless it is the CPU.
#[cfg(not(feature = "gpu"))]
pub(crate) fn open(device: Device, _max_bytes: Option<u64>) -> Result<Option<Opened>, Da3Error> {
    match device {
        Device::Cpu | Device::Auto => Ok(None),
        Device::Gpu { .. } => Err(Da3Error::NoDeviceSupport { device }),
    }
}

impl Opened {
    /// What puts networks on it.
    #[cfg(feature = "gpu")]
    pub fn loader(&self, arithmetic: Arithmetic) -> impl DeviceLoader + use<> {
        crate::gpu::Context::new(&self.0, arithmetic)
    }

    /// What puts networks on it.
    #[cfg(not(feature = "gpu"))]
    pub fn loader(&self, _arithmetic: Arithmetic) -> NoLoader {
        match *self {}
    }

    /// What a run takes on it.
    pub fn plan(&self, config: &Da3Config, size: (usize, usize, usize), wants_rays: bool) -> DevicePlan {
        #[cfg(feature = "gpu")]
        return crate::gpu::device_plan(self.0.adapter(), config, size, wants_rays);
        #[cfg(not(feature = "gpu"))]
        {
            let _ = (config, size, wants_rays);
            match *self {}
        }
    }

    /// The device's name.
    pub fn name(&self) -> String {
        #[cfg(feature = "gpu")]
        return self.0.adapter().name.clone();
        #[cfg(not(feature = "gpu"))]
        match *self {}
    }

    /// The open device.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> &vidar_gpu::Gpu {
        &self.0
    }
}

/// What puts networks on no device.
#[cfg(not(feature = "gpu"))]
pub(crate) enum NoLoader {}

#[cfg(not(feature = "gpu"))]
impl DeviceLoader for NoLoader {
    fn load(
        &self,
        _: &crate::weights::Scope,
        _: &crate::config::NetConfig,
        _: crate::weights::Residency,
    ) -> Result<Box<dyn crate::model::DeviceNet>, Da3Error> {
        match *self {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_name_devices_and_back() {
        let all =
            [Device::Cpu, Device::Gpu { adapter: None }, Device::Gpu { adapter: Some(3) }, Device::Auto];
        for device in all {
            assert_eq!(device.to_string().parse(), Ok(device));
        }
        for word in ["", "gpu:", "gpu:-1", "cuda", "GPU"] {
            assert!(word.parse::<Device>().unwrap_err().to_string().contains(word));
        }
    }
}
