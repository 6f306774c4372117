//! Device memory and what is held of it.

use crate::error::GpuError;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

pub(crate) const FLOAT: u64 = 4;

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

    pub fn take(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
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
    pub(crate) len: usize,
    pub(crate) account: Arc<Account>,
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.account.give_back(self.raw.size());
    }
}

impl Buffer {
    /// Numbers in it.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it has no number.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}
