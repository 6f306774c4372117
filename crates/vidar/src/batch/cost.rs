//! What a task took.

use serde::{Deserialize, Serialize};
use std::time::Instant;
use vidar_store::Traffic;

/// What a task took. Sums of the machine are null where it does not state them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cost {
    /// Wall time, s.
    pub seconds: f64,
    /// Time of all threads on processors, s; a decoder that is a program of its own is not counted.
    pub processor_seconds: Option<f64>,
    /// Read by the process from files and the store, bytes; files that are mapped into memory, such as weights, are not counted.
    pub read_bytes: Option<u64>,
    /// Written by the process to files and the store, bytes.
    pub written_bytes: Option<u64>,
    /// Of these, from the store.
    pub from_store_bytes: u64,
    /// Of these, to the store.
    pub to_store_bytes: u64,
    /// The most memory that the process held at a time, bytes.
    pub peak_memory_bytes: Option<u64>,
}

impl Cost {
    /// The costs of several tasks together: sums, and the largest memory.
    pub fn add(&mut self, other: &Self) {
        let sum = |a: Option<u64>, b: Option<u64>| match (a, b) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        };
        self.seconds += other.seconds;
        self.processor_seconds = match (self.processor_seconds, other.processor_seconds) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        };
        self.read_bytes = sum(self.read_bytes, other.read_bytes);
        self.written_bytes = sum(self.written_bytes, other.written_bytes);
        self.from_store_bytes += other.from_store_bytes;
        self.to_store_bytes += other.to_store_bytes;
        self.peak_memory_bytes = self.peak_memory_bytes.max(other.peak_memory_bytes);
    }
}

/// Runs while a task does.
pub(super) struct Meter {
    clock: Instant,
    processor_seconds: Option<f64>,
    bytes: Option<[u64; 2]>,
}

impl Meter {
    pub fn start() -> Self {
        Self { clock: Instant::now(), processor_seconds: processor_seconds(), bytes: bytes() }
    }

    /// What was taken since the start; `traffic` is all that went through the task's store.
    pub fn stop(&self, traffic: Traffic) -> Cost {
        let since = |which: usize| Some(bytes()?[which].saturating_sub(self.bytes?[which]));
        let processor_seconds = processor_seconds().zip(self.processor_seconds).map(|(now, then)| now - then);
        Cost {
            seconds: self.clock.elapsed().as_secs_f64(),
            processor_seconds,
            read_bytes: since(0),
            written_bytes: since(1),
            from_store_bytes: traffic.read,
            to_store_bytes: traffic.written,
            peak_memory_bytes: crate::system::peak_memory_bytes(),
        }
    }
}

/// Time of all threads of this process on processors so far, s.
fn processor_seconds() -> Option<f64> {
    #[cfg(unix)]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Some(time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64)
    }
    #[cfg(not(unix))]
    None
}

/// Bytes that this process read and wrote so far, as Linux counts them.
fn bytes() -> Option<[u64; 2]> {
    let text = std::fs::read_to_string("/proc/self/io").ok()?;
    let value = |key: &str| text.lines().find_map(|l| l.strip_prefix(key)?.trim().parse().ok());
    Some([value("rchar:")?, value("wchar:")?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_add_up_and_what_one_machine_does_not_state_is_left_out() {
        let a = Cost { seconds: 1.0, processor_seconds: Some(2.0), read_bytes: Some(10), ..Cost::default() };
        let b = Cost { seconds: 0.5, peak_memory_bytes: Some(7), from_store_bytes: 3, ..Cost::default() };
        for (first, second) in [(a, b), (b, a)] {
            let mut sum = Cost::default();
            sum.add(&first);
            sum.add(&second);
            assert_eq!((sum.seconds, sum.processor_seconds), (1.5, Some(2.0)));
            assert_eq!((sum.read_bytes, sum.peak_memory_bytes, sum.from_store_bytes), (Some(10), Some(7), 3));
        }
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn a_meter_counts_work_and_bytes() {
        let meter = Meter::start();
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("x"), vec![1; 1 << 20]).unwrap();
        let mut sum = 0_u64;
        while meter.stop(Traffic::default()).processor_seconds.unwrap() < 0.01 {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(meter.stop(Traffic::default()).written_bytes.unwrap() >= 1 << 20);
    }
}
