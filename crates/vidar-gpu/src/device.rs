//! Adapters and open devices.

use crate::buffer::{Account, Buffer, FLOAT};
use crate::error::GpuError;
use crate::kernel::{IMMEDIATES, Kernel, Layouts};
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

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

/// An open device; cheap to clone.
#[derive(Clone)]
pub struct Gpu {
    pub(crate) shared: Arc<Shared>,
}

pub(crate) struct Shared {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub account: Arc<Account>,
    pub limits: wgpu::Limits,
    pub layouts: Layouts,
    adapter: Adapter,
    pipelines: Mutex<HashMap<String, Arc<wgpu::ComputePipeline>>>,
    failure: Arc<Mutex<Option<GpuError>>>,
}

/// Workgroup memory of the largest shader, bytes.
const WORKGROUP_BYTES: u32 = 16 << 10;
/// Invocations of the largest workgroup.
const INVOCATIONS: u32 = 256;

/// The driver's instance, one for the process and never given back: with one for each device, two of six test programs
/// that opened and closed devices in several threads hung in NVIDIA's Vulkan driver 580.159 (H200).
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
    choose(options, enumerate(instance())).map(|(adapter, _)| adapter)
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

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] when there is none of the kind asked for, [`GpuError::Unsuitable`] when it lacks something,
    /// [`GpuError::NotOpened`] when the driver refuses.
    pub fn open(options: &GpuOptions) -> Result<Self, GpuError> {
        let (adapter, raw) = choose(options, enumerate(instance()))?;
        let limits = required_limits(&adapter, &raw)?;
        let not_opened = |reason: String| GpuError::NotOpened { adapter: adapter.name.clone(), reason };
        let (device, queue) = pollster::block_on(raw.request_device(&wgpu::DeviceDescriptor {
            label: Some("vidar"),
            required_features: wgpu::Features::IMMEDIATES,
            required_limits: limits.clone(),
            experimental_features: wgpu::ExperimentalFeatures::disabled(),
            memory_hints: wgpu::MemoryHints::MemoryUsage,
            trace: wgpu::Trace::Off,
        }))
        .map_err(|error| not_opened(error.to_string()))?;
        let failure = Arc::new(Mutex::new(None));
        listen(&device, &adapter, &failure);
        let shared = Shared {
            layouts: Layouts::new(&device),
            account: Arc::new(Account::new(options.memory_limit)),
            limits,
            adapter,
            pipelines: Mutex::new(HashMap::new()),
            failure,
            device,
            queue,
        };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Which device this is.
    pub fn adapter(&self) -> &Adapter {
        &self.shared.adapter
    }

    /// Bytes held in buffers now.
    pub fn held_bytes(&self) -> u64 {
        self.shared.account.held()
    }

    /// The most bytes held in buffers at a time since the device was opened or [`Gpu::reset_peak`] was called.
    pub fn peak_bytes(&self) -> u64 {
        self.shared.account.peak()
    }

    /// Starts measuring [`Gpu::peak_bytes`] anew.
    pub fn reset_peak(&self) {
        self.shared.account.reset_peak();
    }

    /// The most bytes that one buffer may have.
    pub fn max_buffer_bytes(&self) -> u64 {
        self.shared.limits.max_buffer_size.min(self.shared.limits.max_storage_buffer_binding_size)
    }

    /// Refuses bytes that, beside those held, are more than allowed.
    ///
    /// # Errors
    /// [`GpuError::OverBudget`].
    pub fn allows(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        self.shared.account.allows(what, bytes)
    }

    /// A buffer of `len` numbers, of no certain content.
    ///
    /// # Errors
    /// [`GpuError::BufferTooLarge`], [`GpuError::OutOfMemory`], [`GpuError::OverBudget`].
    pub fn buffer(&self, what: &str, len: usize) -> Result<Buffer, GpuError> {
        Buffer::new(self, what, len)
    }

    /// A buffer with the given numbers.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(&self, what: &str, values: &[f32]) -> Result<Buffer, GpuError> {
        let buffer = self.buffer(what, values.len())?;
        buffer.write(self, 0, values);
        Ok(buffer)
    }

    /// What went wrong since the device was opened, if anything did.
    ///
    /// # Errors
    /// [`GpuError::Lost`], [`GpuError::OutOfMemory`] or [`GpuError::Refused`].
    pub fn check(&self) -> Result<(), GpuError> {
        match self.failure().clone() {
            Some(error) => Err(error),
            None => Ok(()),
        }
    }

    fn failure(&self) -> MutexGuard<'_, Option<GpuError>> {
        self.shared.failure.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until all submitted work is done.
    ///
    /// # Errors
    /// As [`Gpu::check`].
    pub fn wait(&self) -> Result<(), GpuError> {
        let poll = wgpu::PollType::Wait { submission_index: None, timeout: None };
        let waited = self.shared.device.poll(poll);
        self.check()?;
        waited.map(|_| ()).map_err(|error| self.refused(error.to_string()))
    }

    pub(crate) fn wait_for(&self, submission: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        let poll = wgpu::PollType::Wait { submission_index: Some(submission), timeout: None };
        let waited = self.shared.device.poll(poll);
        self.check()?;
        waited.map(|_| ()).map_err(|error| self.refused(error.to_string()))
    }

    pub(crate) fn refused(&self, reason: String) -> GpuError {
        GpuError::Refused { adapter: self.shared.adapter.name.clone(), reason }
    }

    /// The pipeline of a kernel, compiled when it is first asked for.
    pub(crate) fn pipeline(&self, kernel: &Kernel) -> Result<Arc<wgpu::ComputePipeline>, GpuError> {
        let mut pipelines = self.shared.pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(pipeline) = pipelines.get(&kernel.name) {
            return Ok(Arc::clone(pipeline));
        }
        let device = &self.shared.device;
        let scope = device.push_error_scope(wgpu::ErrorFilter::Validation);
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(&kernel.name),
            source: wgpu::ShaderSource::Wgsl(kernel.source().into()),
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(&kernel.name),
            layout: Some(self.shared.layouts.pipeline(device, kernel)),
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        if let Some(error) = pollster::block_on(scope.pop()) {
            return Err(self.refused(format!("shader {}: {error}", kernel.name)));
        }
        let pipeline = Arc::new(pipeline);
        pipelines.insert(kernel.name.clone(), Arc::clone(&pipeline));
        Ok(pipeline)
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

fn required_limits(adapter: &Adapter, raw: &wgpu::Adapter) -> Result<wgpu::Limits, GpuError> {
    let has = raw.limits();
    let immediates =
        if raw.features().contains(wgpu::Features::IMMEDIATES) { has.max_immediate_size } else { 0 };
    let needs = [
        ("immediate data", u64::from(immediates), u64::from(IMMEDIATES)),
        ("workgroup memory", u64::from(has.max_compute_workgroup_storage_size), u64::from(WORKGROUP_BYTES)),
        ("workgroup size", u64::from(has.max_compute_invocations_per_workgroup), u64::from(INVOCATIONS)),
        ("storage buffers", u64::from(has.max_storage_buffers_per_shader_stage), 6),
    ];
    if let Some((what, found, needed)) = needs.into_iter().find(|(_, found, needed)| found < needed) {
        return Err(GpuError::Unsuitable { adapter: adapter.name.clone(), what, found, needed });
    }
    Ok(wgpu::Limits {
        max_immediate_size: IMMEDIATES,
        max_buffer_size: has.max_buffer_size,
        max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
        ..wgpu::Limits::default()
    })
}

/// Keeps the first failure, which is what led to the others.
fn listen(device: &wgpu::Device, adapter: &Adapter, failure: &Arc<Mutex<Option<GpuError>>>) {
    let keep = |failure: &Mutex<Option<GpuError>>, error: GpuError| {
        failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    };
    let (name, kept) = (adapter.name.clone(), Arc::clone(failure));
    device.set_device_lost_callback(move |reason, message| {
        // A device that is dropped is "destroyed": nothing is wrong then.
        if reason != wgpu::DeviceLostReason::Destroyed {
            keep(&kept, GpuError::Lost { adapter: name.clone(), reason: message });
        }
    });
    let (name, kept) = (adapter.name.clone(), Arc::clone(failure));
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
        let adapter = name.clone();
        let error = match error {
            wgpu::Error::OutOfMemory { .. } => {
                GpuError::OutOfMemory { what: "the driver".into(), bytes: 0, held: 0, adapter }
            }
            other => GpuError::Refused { adapter, reason: other.to_string() },
        };
        keep(&kept, error);
    }));
}

/// Buffers are made and written by their device.
impl Buffer {
    pub(crate) fn new(gpu: &Gpu, what: &str, len: usize) -> Result<Self, GpuError> {
        // An empty buffer cannot be bound; whole vectors of four can always be read.
        let bytes = (len.max(1).next_multiple_of(4)) as u64 * FLOAT;
        let most = gpu.max_buffer_bytes();
        let adapter = || gpu.adapter().name.clone();
        if bytes > most {
            return Err(GpuError::BufferTooLarge { what: what.to_owned(), bytes, adapter: adapter(), most });
        }
        let account = &gpu.shared.account;
        let held = account.held();
        account.take(what, bytes)?;
        let scope = gpu.shared.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let raw = gpu.shared.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(what),
            size: bytes,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let buffer = Self { raw, len, account: Arc::clone(account) };
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory { what: what.to_owned(), bytes, held, adapter: adapter() }),
            None => Ok(buffer),
        }
    }

    /// Writes numbers from place `at` on, before anything that is recorded but not yet submitted.
    ///
    /// # Panics
    /// When they do not fit.
    pub fn write(&self, gpu: &Gpu, at: usize, values: &[f32]) {
        self.write_words(gpu, at, bytemuck::cast_slice(values));
    }

    pub(crate) fn write_words(&self, gpu: &Gpu, at: usize, words: &[u32]) {
        assert!(at + words.len() <= self.len, "{} numbers at {at} of {}", words.len(), self.len);
        if !words.is_empty() {
            gpu.shared.queue.write_buffer(&self.raw, at as u64 * FLOAT, bytemuck::cast_slice(words));
        }
    }
}
