//! Device memory and what is held of it.

use crate::device::Gpu;
use crate::error::GpuError;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

const FLOAT: u64 = 4;

/// How many bytes are held, and how many may be.
#[derive(Debug)]
pub(crate) struct Account {
    held: AtomicU64,
    peak: AtomicU64,
    allowed: Option<u64>,
}

impl Account {
    pub fn new(allowed: Option<u64>) -> Self {
        Self { held: AtomicU64::new(0), peak: AtomicU64::new(0), allowed }
    }

    pub fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    pub fn peak(&self) -> u64 {
        self.peak.load(Ordering::Relaxed)
    }

    pub fn reset_peak(&self) {
        self.peak.store(self.held(), Ordering::Relaxed);
    }

    pub fn allows(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let held = self.held();
        match self.allowed.filter(|allowed| held + bytes > *allowed) {
            Some(allowed) => Err(GpuError::OverBudget { what: what.to_owned(), bytes, held, allowed }),
            None => Ok(()),
        }
    }

    fn take(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let held = self.held.fetch_add(bytes, Ordering::Relaxed);
        match self.allowed.filter(|allowed| held + bytes > *allowed) {
            Some(allowed) => {
                self.give_back(bytes);
                Err(GpuError::OverBudget { what: what.to_owned(), bytes, held, allowed })
            }
            None => {
                self.peak.fetch_max(held + bytes, Ordering::Relaxed);
                Ok(())
            }
        }
    }

    fn give_back(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// Numbers in device memory.
pub struct Buffer {
    pub(crate) raw: wgpu::Buffer,
    len: usize,
    account: Arc<Account>,
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.account.give_back(self.raw.size());
    }
}

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

    /// Numbers in it.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it has no number.
    pub fn is_empty(&self) -> bool {
        self.len == 0
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
