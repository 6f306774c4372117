//! Adapters: the devices that can be opened.

use crate::error::GpuError;
use std::fmt;
use std::sync::OnceLock;

/// What stands behind an adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// A processor with memory of its own.
    Discrete,
    /// A processor that shares the machine's memory.
    Integrated,
    /// Lent by a host to a virtual machine.
    Virtual,
    /// Nobody says.
    Unknown,
    /// Shaders run on the CPU: for tests, slower than this project's own CPU kernels.
    Software,
}

/// A device that could be opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Adapter {
    /// Its place in the list, by which it can be asked for.
    pub index: usize,
    /// Its name.
    pub name: String,
    /// What stands behind it.
    pub kind: AdapterKind,
    /// The interface: vulkan, metal, dx12.
    pub interface: String,
    /// The driver and its version.
    pub driver: String,
}

/// As people are told of it: name, kind, interface and driver.
impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, kind, interface, driver, .. } = self;
        write!(f, "{name} ({kind}, {interface}, {driver})")
    }
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Discrete => "discrete",
            Self::Integrated => "integrated",
            Self::Virtual => "virtual",
            Self::Unknown => "of unknown kind",
            Self::Software => "software: shaders run on the CPU",
        })
    }
}

/// Which device, and how much of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// A place in [`adapters`], software included; `None` is the best that is no software.
    pub adapter: Option<usize>,
    /// Bytes of device memory that may be held at a time; `None` is whatever the device gives.
    pub memory_limit: Option<u64>,
}

/// The driver's instance, one for the process.
fn instance() -> &'static wgpu::Instance {
    static INSTANCE: OnceLock<wgpu::Instance> = OnceLock::new();
    INSTANCE.get_or_init(|| {
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
        wgpu::Instance::new(descriptor)
    })
}

fn enumerate(instance: &wgpu::Instance) -> Vec<(Adapter, wgpu::Adapter)> {
    let found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
    let mut all: Vec<(Adapter, wgpu::Adapter)> = found.into_iter().map(|a| (describe(&a), a)).collect();
    // Stable: the driver's order within a kind.
    all.sort_by_key(|(adapter, _)| adapter.kind);
    for (index, (adapter, _)) in all.iter_mut().enumerate() {
        adapter.index = index;
    }
    all
}

fn describe(adapter: &wgpu::Adapter) -> Adapter {
    let info = adapter.get_info();
    let kind = match info.device_type {
        wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
        wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
        wgpu::DeviceType::VirtualGpu => AdapterKind::Virtual,
        wgpu::DeviceType::Cpu => AdapterKind::Software,
        wgpu::DeviceType::Other => AdapterKind::Unknown,
    };
    Adapter {
        index: 0,
        name: info.name,
        kind,
        interface: info.backend.to_string(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
    }
}

/// All devices of this machine, the best first.
pub fn adapters() -> Vec<Adapter> {
    enumerate(instance()).into_iter().map(|(adapter, _)| adapter).collect()
}

/// The adapter that options name, without opening it.
///
/// # Errors
/// [`GpuError::NoAdapter`] when there is none of the kind asked for.
pub fn find(options: &GpuOptions) -> Result<Adapter, GpuError> {
    chosen(options).map(|(adapter, _)| adapter)
}

/// The adapter that options name, and the driver's.
pub(crate) fn chosen(options: &GpuOptions) -> Result<(Adapter, wgpu::Adapter), GpuError> {
    choose(options, enumerate(instance()))
}

fn choose(
    options: &GpuOptions,
    mut all: Vec<(Adapter, wgpu::Adapter)>,
) -> Result<(Adapter, wgpu::Adapter), GpuError> {
    let wanted = match options.adapter {
        Some(index) => (index < all.len()).then_some(index),
        None => all.iter().position(|(a, _)| a.kind != AdapterKind::Software),
    };
    match wanted {
        Some(index) => Ok(all.swap_remove(index)),
        None => Err(no_adapter(options, &all)),
    }
}

fn no_adapter(options: &GpuOptions, all: &[(Adapter, wgpu::Adapter)]) -> GpuError {
    let names: Vec<String> = all.iter().map(|(a, _)| a.to_string()).collect();
    let advice = if all.is_empty() {
        "Install the graphics driver with its Vulkan part, or compute on the CPU".to_owned()
    } else if options.adapter.is_some() {
        "Name one of these by its place, counted from 0".to_owned()
    } else {
        "These run shaders on the CPU: name one by its place to use it all the same, or compute on the CPU"
            .to_owned()
    };
    GpuError::NoAdapter {
        wanted: match options.adapter {
            Some(index) => format!("number {index}"),
            None => "that is no software".to_owned(),
        },
        found: if names.is_empty() { "none".to_owned() } else { names.join(", ") },
        advice,
    }
}
