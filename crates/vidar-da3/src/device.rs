//! Selection of the device that a model runs on.

use crate::arithmetic::Arithmetic;
use crate::config::Da3Config;
use crate::error::Da3Error;
use crate::model::{DeviceLoader, DevicePlan};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The device of backbone and dense head. Camera encoder and decoder, preprocessing and alignment always run on the CPU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// The CPU, with this project's own kernels.
    #[default]
    Cpu,
    /// A graphics processor; needs the feature `gpu`.
    Gpu {
        /// Its index in the list of devices; `None` is the best that does not emulate shaders on the CPU.
        adapter: Option<usize>,
    },
    /// A graphics processor if one can be opened, the CPU otherwise.
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

/// A name of no device.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown device {found:?}; expected cpu, gpu, gpu:N (N counted from 0) or auto")]
pub struct UnknownDevice {
    /// The name found.
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

impl Device {
    /// The memory that `views` views at `height` × `width` pixels need on the selected device; `None` for the CPU. The device
    /// is not opened.
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

    /// The memory that `views` views at `height` × `width` pixels need on the selected device; `None` for the CPU. The device
    /// is not opened.
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

    /// All graphics processors of this machine with their descriptions, the best first; `None` in builds without the feature
    /// `gpu`.
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

/// An open device.
#[cfg(feature = "gpu")]
pub(crate) struct OpenDevice(vidar_gpu::Gpu);

/// Without the feature `gpu` there is no device to open.
#[cfg(not(feature = "gpu"))]
pub(crate) enum OpenDevice {}

/// Opens the selected device; `None` for the CPU. At most `max_bytes` of its memory are held at a time.
#[cfg(feature = "gpu")]
pub(crate) fn open(device: Device, max_bytes: Option<u64>) -> Result<Option<OpenDevice>, Da3Error> {
    let open = |adapter| vidar_gpu::Gpu::open(&vidar_gpu::GpuOptions { adapter, memory_limit: max_bytes });
    match device {
        Device::Cpu => Ok(None),
        Device::Gpu { adapter } => Ok(Some(OpenDevice(open(adapter)?))),
        Device::Auto => Ok(open(None).ok().map(OpenDevice)),
    }
}

/// Opens the selected device; `None` for the CPU.
#[cfg(not(feature = "gpu"))]
pub(crate) fn open(device: Device, _max_bytes: Option<u64>) -> Result<Option<OpenDevice>, Da3Error> {
    match device {
        Device::Cpu | Device::Auto => Ok(None),
        Device::Gpu { .. } => Err(Da3Error::NoDeviceSupport { device }),
    }
}

impl OpenDevice {
    /// Loads networks to it.
    #[cfg(feature = "gpu")]
    pub fn loader(&self, arithmetic: Arithmetic) -> impl DeviceLoader + use<> {
        crate::gpu::Context::new(&self.0, arithmetic)
    }

    /// Loads networks to it.
    #[cfg(not(feature = "gpu"))]
    pub fn loader(&self, _arithmetic: Arithmetic) -> NoLoader {
        match *self {}
    }

    /// Memory of a run on it.
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

    /// The most bytes held in its buffers at a time so far.
    pub fn peak_bytes(&self) -> u64 {
        #[cfg(feature = "gpu")]
        return self.0.peak_bytes();
        #[cfg(not(feature = "gpu"))]
        match *self {}
    }

    /// The open device.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> &vidar_gpu::Gpu {
        &self.0
    }
}

/// The loader of builds without devices.
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
    fn names_of_devices_round_trip() {
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
