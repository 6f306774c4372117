//! Open devices.

use crate::adapter::{Adapter, GpuOptions, chosen};
use crate::buffer::{Account, Buffer, FLOAT};
use crate::error::GpuError;
use crate::kernel::{IMMEDIATES, Kernel, Layouts};
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};

/// An open device with an account of its own of what is held; cheap to clone.
#[derive(Clone)]
pub struct Gpu {
    pub(crate) shared: Arc<Shared>,
    pub(crate) account: Arc<Account>,
}

/// The driver's device, its compiled kernels, and what went wrong on it.
pub(crate) struct Shared {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
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

/// The open devices of the process, by the place of their adapter. They are shared and never closed: programs of twelve
/// threads, each with a device of its own, hung in NVIDIA's Vulkan driver 580.159 (H200) in 17 of 21 runs, all waiting for
/// one that closed its device; with one thread none of 10 did.
fn opened(adapter: Adapter, raw: &wgpu::Adapter) -> Result<Arc<Shared>, GpuError> {
    static OPENED: Mutex<BTreeMap<usize, Arc<Shared>>> = Mutex::new(BTreeMap::new());
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    // A device that failed is left to those who have it.
    match opened.get(&adapter.index).filter(|shared| shared.adapter == adapter && shared.check().is_ok()) {
        Some(shared) => Ok(Arc::clone(shared)),
        None => {
            let (index, shared) = (adapter.index, Arc::new(Shared::open(adapter, raw)?));
            opened.insert(index, Arc::clone(&shared));
            Ok(shared)
        }
    }
}

impl Shared {
    fn open(adapter: Adapter, raw: &wgpu::Adapter) -> Result<Self, GpuError> {
        let limits = required_limits(&adapter, raw)?;
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
        Ok(Self {
            layouts: Layouts::new(&device),
            limits,
            adapter,
            pipelines: Mutex::new(HashMap::new()),
            failure,
            device,
            queue,
        })
    }

    fn check(&self) -> Result<(), GpuError> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone().map_or(Ok(()), Err)
    }
}

impl Gpu {
    /// Opens a device, or shares it if the process has it open. The account of bytes is the caller's own; a failure of the device is everybody's.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] when there is none of the kind asked for, [`GpuError::Unsuitable`] when it lacks something,
    /// [`GpuError::NotOpened`] when the driver refuses.
    pub fn open(options: &GpuOptions) -> Result<Self, GpuError> {
        let (adapter, raw) = chosen(options)?;
        Ok(Self { shared: opened(adapter, &raw)?, account: Arc::new(Account::new(options.memory_limit)) })
    }

    /// Which device this is.
    pub fn adapter(&self) -> &Adapter {
        &self.shared.adapter
    }

    /// Bytes held in buffers of this opening now.
    pub fn held_bytes(&self) -> u64 {
        self.account.held()
    }

    /// The most bytes held in buffers of this opening at a time, since it or since [`Gpu::reset_peak`] was called.
    pub fn peak_bytes(&self) -> u64 {
        self.account.peak()
    }

    /// Starts measuring [`Gpu::peak_bytes`] anew.
    pub fn reset_peak(&self) {
        self.account.reset_peak();
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
        self.account.allows(what, bytes)
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
        self.shared.check()
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
        let account = &gpu.account;
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
